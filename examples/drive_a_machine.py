"""A trained Rainbow drives a machine through three methods: here the simulated one.
A real one is a class with the same three; `python -m examples.drive_a_machine 5` takes start 5.
"""

import sys
from pathlib import Path

from benchmarks.evaluation.model_files import load_model
from coop_env import CoopInsertionEnv
from coop_env.physics.driver import TwinDriver, replay

ROOT = Path(__file__).resolve().parent.parent
model = load_model(ROOT / "results/cut/runs/rainbow-optimized-safe-s0/policy.zip")


def policy(observation, action_masks):  # type: ignore[no-untyped-def]
    return model.predict(observation, action_masks=action_masks, deterministic=True)[0]


env = CoopInsertionEnv()
_, info = env.reset(seed=int(sys.argv[1]) if len(sys.argv) > 1 else 0)
driver = TwinDriver(configuration=env.configuration)
report = replay(policy, driver, target=info["target"], holes=1, mask_singularities=True)
print(f"{report.stopped}: {report.moves} moves in {report.seconds:.2f} s, "
      f"largest force {report.force:.1f} N, error {1000 * report.error:.2f} mrad")  # fmt: skip
distance, angle = driver.miss(info["target"])
print(f"tip {1000 * distance:.1f} mm from the mouth it aimed at, {angle:.3f} rad off its axis")
