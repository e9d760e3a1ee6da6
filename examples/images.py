"""Images as observations, in an environment of one's own: a paddle has to catch a falling ball.
10,000 steps, about a minute; `python -m examples.images 300` takes fewer.
"""

import sys
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_rainbow import Rainbow

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
SIZE, PIXELS = 10, 4  # squares along a side, pixels along a square's


class Catch(gym.Env[np.ndarray, np.int64]):
    """Left, stay, right; 1 for a ball that lands on the paddle, 0 for one that does not."""

    observation_space = spaces.Box(0, 255, (1, SIZE * PIXELS, SIZE * PIXELS), np.uint8)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.row, self.paddle = 0, SIZE // 2
        self.column = int(self.np_random.integers(SIZE))
        return self._image(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.row += 1
        self.paddle = min(max(self.paddle + int(action) - 1, 0), SIZE - 1)
        landed = self.row == SIZE - 1
        caught = landed and self.column == self.paddle
        return self._image(), float(caught), landed, False, {}

    def _image(self) -> np.ndarray:
        board = np.zeros((SIZE, SIZE), np.uint8)
        board[self.row, self.column] = board[-1, self.paddle] = 255
        return np.kron(board, np.ones((PIXELS, PIXELS), np.uint8))[None]


model = Rainbow(
    "CnnPolicy", Catch(), learning_rate=3e-4, buffer_size=20_000, gradient_steps=1, seed=0
)
model.learn(steps)
share, _ = evaluate_policy(model, Monitor(Catch()), n_eval_episodes=100)
print(f"share of balls caught: {share:.2f}")
