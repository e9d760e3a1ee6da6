"""Environments that show what the zoo did with them."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Masked(gym.Env):
    """Two actions of four are allowed in each state; another is an error."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as Gymnasium has it
    observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = spaces.Discrete(4)

    tags: ClassVar[list[str]] = []

    def __init__(self, render_mode: str | None = None, n_masks: int = 4, tag: str = "") -> None:
        self.tags.append(tag)
        self.render_mode = render_mode
        self.n_masks = n_masks

    def _draw(self) -> np.ndarray:
        self.allowed = self.np_random.permutation(4) < 2
        return self.allowed.astype(np.float32)

    def action_masks(self) -> np.ndarray:
        return np.resize(self.allowed, self.n_masks)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._draw(), {}

    def step(self, action: Any) -> Any:
        if not self.allowed[action]:
            raise RuntimeError("not under masks")
        return self._draw(), 1.0, False, False, {}

    def render(self) -> Any:
        return np.zeros((16, 16, 3), np.uint8)


gym.register("MaskedZoo-v0", f"{__name__}:Masked", max_episode_steps=20)
