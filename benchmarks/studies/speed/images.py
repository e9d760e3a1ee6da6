"""Updates per second on images: frames of Atari's size, and MinAtar."""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from benchmarks.studies.classic.presets import load_preset
from benchmarks.studies.classic.train import build_model
from benchmarks.studies.speed.setting import EPISODE, REWARD, measure_updates, ours

BASELINE: Final = "SB3 DQN"
QUANTILES: Final = "sb3-contrib QR-DQN"
NATURE: Final = "NatureCNN"
MINATAR: Final = "MinAtar"
SETTINGS: Final = {
    NATURE: "random frames of 84 x 84, four of them stacked, 6 actions, batch 32, an update a "
    "step, a tenth of the steps in a round",
    MINATAR: "Breakout by preset `minatar` of the classic tasks, but that all have Rainbow's 128 "
    "units after the convolution: batch 32, an update for a step of each of four games",
}
# Least ratio of Rainbow to DQN that the project asks for; on MinAtar 1.1 times the minutes
TARGETS: Final = {NATURE: 0.9, MINATAR: 0.91}
N_ACTIONS: Final = 6
CAPACITY: Final = 2_000
SHAPE: Final = (4, 84, 84)


class FramesEnv(gym.Env[NDArray[np.uint8], np.int64]):
    """Random frames, of which few are drawn, episodes of 100 steps: the learner's time counts."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._frames = np.random.default_rng(0).integers(0, 256, (EPISODE, *SHAPE), np.uint8)
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
        "buffer_size": CAPACITY,
        "device": "cpu",
        "seed": 0,
    }
    same_network = {"features_extractor_class": NatureCNN}
    quantiles = {"n_quantiles": 51}
    nature: dict[str, Any] = {
        BASELINE: DQN("CnnPolicy", FramesEnv(), **settings),
        QUANTILES: QRDQN("CnnPolicy", FramesEnv(), policy_kwargs=quantiles, **settings),
        "Rainbow": Rainbow("CnnPolicy", FramesEnv(), policy_kwargs=same_network, **settings),
        "Rainbow, by default two streams of 512": Rainbow("CnnPolicy", FramesEnv(), **settings),
    }
    task = load_preset("minatar").tasks["breakout"]
    for arguments in task.methods.values():
        arguments["policy_kwargs"]["net_arch"] = [128]
    names = {BASELINE: "dqn", QUANTILES: "qrdqn", "Rainbow": "rainbow"}
    minatar: dict[str, Any] = {name: build_model(task, key, 0) for name, key in names.items()}
    models = {NATURE: nature, MINATAR: minatar}
    for found in models.values():
        for model in found.values():
            model.learn(model.learning_starts + 100)
    return models


def measure(n_steps: int, rounds: int) -> dict[str, dict[str, dict[str, float]]]:
    """Updates per second by setting and method, the methods of a setting in turns.

    Args:
        n_steps: of MinAtar's games together in a round; of the large frames a tenth of them.
        rounds: of which the median counts.
    """
    updates = {NATURE: max(1, n_steps // 10), MINATAR: max(1, n_steps // 4)}
    return {
        setting: measure_updates(
            {name: ours(model, model.batch_size) for name, model in found.items()},
            updates[setting],
            rounds,
        )
        for setting, found in make_models().items()
    }
