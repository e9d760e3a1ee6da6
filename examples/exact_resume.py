"""A run that goes on from a checkpoint ends with the very weights that it would have ended with.
Some 30,000 steps, about a minute; `python -m examples.exact_resume 1000` takes fewer.
"""

import sys
from pathlib import Path

import torch
from stable_baselines3.common.callbacks import BaseCallback

from coop_env import CoopInsertionVecEnv
from sb3_rainbow import Rainbow

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
CHECKPOINT = Path("build/half.ckpt")


class SaveOnce(BaseCallback):
    """Saves all of a run when half of it is done."""

    model: Rainbow

    def _on_rollout_start(self) -> None:  # between rounds; in _on_step a transition is open
        if self.num_timesteps >= steps // 2 and not CHECKPOINT.exists():
            self.model.save_checkpoint(CHECKPOINT)

    def _on_step(self) -> bool:
        return True


def make_env() -> CoopInsertionVecEnv:
    """Eight robots in one batch, which can tell and take its state; most environments cannot."""
    return CoopInsertionVecEnv(8, seed=0, reward="progress")


CHECKPOINT.parent.mkdir(exist_ok=True)
CHECKPOINT.unlink(missing_ok=True)
whole = Rainbow("MlpPolicy", make_env(), seed=0).learn(steps, callback=SaveOnce())
resumed = Rainbow.load_checkpoint(CHECKPOINT, make_env())
print(f"goes on at step {resumed.num_timesteps} of {steps}")
resumed.learn(steps - resumed.num_timesteps, reset_num_timesteps=False)

pairs = zip(whole.policy.parameters(), resumed.policy.parameters(), strict=True)
print(f"weights equal to the bit: {all(torch.equal(a, b) for a, b in pairs)}")
