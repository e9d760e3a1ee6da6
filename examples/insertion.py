"""Rainbow learns to insert the peg, by nearly the settings of the benchmark's track `safe`.
100,000 steps, about four minutes; `python -m examples.insertion 500` takes fewer.
"""

import sys
from pathlib import Path

from sb3_contrib.common.maskable.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from coop_env import CoopInsertionVecEnv
from sb3_rainbow import Rainbow

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
scales = {"step_cost": 0.05, "distance_scale": 50, "angle_scale": 15, "insertion_bonus": 20}
task = {"reward": "progress", "reward_kwargs": scales, "mask_singularities": True}
model = Rainbow(
    "MlpPolicy",
    CoopInsertionVecEnv(16, seed=0, **task),
    learning_rate=lambda left: 1e-3 * left,
    buffer_size=100_000,
    learning_starts=1_000,
    batch_size=128,
    tau=5e-3,
    gamma=0.93,
    train_freq=1,
    gradient_steps=8,
    v_min=-5,
    v_max=25,
    sigma0=0.2,
    policy_kwargs={"net_arch": [256, 128, 64]},
    seed=0,
)
model.learn(steps)
Path("build").mkdir(exist_ok=True)
model.save("build/rainbow_insertion")

filled: list[int] = []
evaluate_policy(
    model,  # type: ignore[arg-type]
    VecMonitor(CoopInsertionVecEnv(1, seed=1_000_000, **task)),
    n_eval_episodes=20,
    callback=lambda local, _: filled.append(local["info"]["n_filled"]) if local["done"] else None,
)
print(f"episodes with an insertion: {sum(n > 0 for n in filled)} of {len(filled)}")
print(f"holes filled: {sum(filled) / len(filled):.2f} of 6")
