"""Updates per second on images: NatureCNN on frames of Atari's size, and MinAtar's own task."""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from benchmarks.studies.classic.presets import Task, load_preset
from benchmarks.studies.classic.train import build_model
from benchmarks.studies.speed.setting import EPISODE, REWARD

NATURE: Final = "NatureCNN"
MINATAR: Final = "MinAtar"
#: of each setting, what the methods learn and how
SETTINGS: Final = {
    NATURE: "frames of 84 x 84, four of them stacked, 6 actions, batch 32, one env step an update",
    MINATAR: "Breakout as preset `full` of the classic tasks learns it, evaluations left out",
}
_N_ACTIONS: Final = 6
_CAPACITY: Final = 2_000
_SHAPE: Final = (4, 84, 84)


class FramesEnv(gym.Env[NDArray[np.uint8], np.int64]):
    """Random frames, of which few are drawn, episodes of 100 steps: the learner's time counts."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, _SHAPE, np.uint8)
        self.action_space = spaces.Discrete(_N_ACTIONS)
        self._frames = np.random.default_rng(0).integers(0, 256, (EPISODE, *_SHAPE), np.uint8)
        self._time = 0

    def reset(self, **_: Any) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """The first frames."""
        self._time = 0
        return self._frames[0], {}

    def step(self, action: np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """The next frames, the same reward always."""
        self._time += 1
        return self._frames[self._time % EPISODE], REWARD, False, self._time >= EPISODE, {}


def make_models() -> dict[str, dict[str, Any]]:
    """The methods by setting and name, trained for a moment."""
    from sb3_contrib import QRDQN
    from stable_baselines3 import DQN
    from stable_baselines3.common.torch_layers import NatureCNN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        "train_freq": 1,
        "gradient_steps": 1,
        "batch_size": 32,
        "learning_starts": 50,
        "buffer_size": _CAPACITY,
        "device": "cpu",
        "seed": 0,
    }
    same = {"features_extractor_class": NatureCNN}  # instead of Hessel et al.'s streams
    nature = {
        "SB3 DQN": DQN("CnnPolicy", FramesEnv(), **settings),
        "sb3-contrib QR-DQN": QRDQN("CnnPolicy", FramesEnv(), **settings),
        "Rainbow": Rainbow("CnnPolicy", FramesEnv(), **settings, policy_kwargs=same),
        "Rainbow, its own network": Rainbow("CnnPolicy", FramesEnv(), **settings),
    }
    task: Task = load_preset("full").tasks["breakout"]
    names = {"SB3 DQN": "dqn", "sb3-contrib QR-DQN": "qrdqn", "Rainbow": "rainbow"}
    minatar = {name: build_model(task, method, 0) for name, method in names.items()}
    for model in nature.values():
        model.learn(200)
    for model in minatar.values():
        model.learn(model.learning_starts + 400)
    return {NATURE: nature, MINATAR: minatar}
