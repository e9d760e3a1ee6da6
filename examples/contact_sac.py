"""SAC learns to insert the peg by feel; a script that yields to the force fills its memory first.
25,000 steps, five minutes or more; `python -m examples.contact_sac 300` takes fewer.
"""

import sys

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

import coop_env  # noqa: F401 - registers the task

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 25_000

env = gym.make("CoopInsertionContact-v0", level="standard")
model = SAC("MlpPolicy", env, learning_rate=lambda left: 1e-3 * left, gamma=0.95, tau=0.01, seed=0,
            ent_coef="auto_0.02", learning_starts=100, train_freq=2, device="cpu")  # fmt: skip
buffer = model.replay_buffer
assert buffer is not None
rng, done = np.random.default_rng(0), True
for _ in range(steps // 5):  # the script: down, and away from where the peg bears
    if done:
        seen = env.reset(seed=int(rng.integers(2**31)))[0]
    (fx, fy, fz), (mx, my) = 10 * seen[11:14], 0.05 * seen[14:16]  # N, N m
    guide = 250 * np.array([my, -mx]) / fz if fz > 2 else np.zeros(2)
    down = -1 if fz < 1 else 0.1 * (fz - 3)
    script = np.array([0.15 * fx + guide[0], 0.15 * fy + guide[1], down, 0, 0, 0])
    action = np.clip(script + 0.3 * rng.normal(size=6), -1, 1).astype(np.float32)
    new, reward, terminated, truncated, info = env.step(action)
    done = terminated or truncated
    buffer.add(seen, new, action, np.array([reward]), np.array([terminated]), [info])
    seen = new
model.learn(steps)

inserted: list[bool] = []
evaluate_policy(
    model,
    Monitor(env),
    n_eval_episodes=20,
    callback=lambda local, _: inserted.append(local["info"]["success"]) if local["done"] else None,
)
print(f"episodes with the peg inserted: {sum(inserted)} of {len(inserted)}")
