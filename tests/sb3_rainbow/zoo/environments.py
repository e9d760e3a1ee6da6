"""Environments that show what the zoo did with them."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tests.sb3_rainbow.small import Toy


class Masked(Toy):
    """Every other action of four is allowed, the even ones first; another is an error."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium has it
    tags: ClassVar[list[str]] = []

    def __init__(self, render_mode: str | None = None, n_masks: int = 4, tag: str = "") -> None:
        super().__init__(spaces.Box(-1.0, 1.0, (4,), np.float32), self.allowed, length=20)
        self.action_space = spaces.Discrete(4)
        self.tags.append(tag)
        self.render_mode = render_mode
        self.n_masks = n_masks

    def allowed(self, step: int) -> np.ndarray:
        return ((np.arange(4) + step) % 2 == 0).astype(np.float32)

    def action_masks(self) -> np.ndarray:
        return np.resize(self.allowed(self.steps), self.n_masks)

    def step(self, action: Any) -> Any:
        if not self.allowed(self.steps)[action]:
            raise RuntimeError("not under masks")
        return super().step(action)

    def render(self) -> Any:
        return np.zeros((16, 16, 3), np.uint8)


gym.register("MaskedZoo-v0", f"{__name__}:Masked")
gym.register(
    "BitsZoo-v0",
    "stable_baselines3.common.envs:BitFlippingEnv",
    kwargs={"n_bits": 4, "continuous": False},
)
