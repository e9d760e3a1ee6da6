"""Atari's games as data-efficient Rainbow plays them, through ale-py and SB3's wrapper."""

from __future__ import annotations

import warnings
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FrameStackObservation, ReshapeObservation
from numpy.typing import NDArray

from benchmarks.errors import BenchmarkError

PREFIX: Final = "ALE/"
FRAMES: Final = 4  # stacked
EPISODE_STEPS: Final = 27_000  # half an hour of play at 60 frames a second, 4 of them a step


def make_atari(name: str, training: bool = False) -> gym.Env[NDArray[np.uint8], Any]:
    """A game of Atari, ``ALE/<Game>-v5``: no sticky actions, four frames a step, up to 30 no-ops.

    Observations are the last four grey frames, (4, 84, 84), uint8; at first all are the first.

    Args:
        name: Gymnasium's id.
        training: rewards are cut to their signs, and a life lost ends the episode.

    Raises:
        BenchmarkError: there is no such game, or ale-py or OpenCV are not installed.
    """
    try:
        import ale_py
        import cv2  # noqa: F401  which SB3's wrapper needs
    except ImportError as error:
        raise BenchmarkError(f"{name} needs {error.name}: pip install -e '.[classic]'") from error
    from stable_baselines3.common.atari_wrappers import AtariWrapper

    gym.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            env = gym.make(
                name,
                frameskip=1,
                repeat_action_probability=0.0,
                max_episode_steps=4 * EPISODE_STEPS,
                disable_env_checker=True,
            )
        except gym.error.Error as error:
            raise BenchmarkError(f"unknown environment '{name}': {error}") from error
    wrapped = AtariWrapper(env, terminal_on_life_loss=training, clip_reward=training)
    stacked = FrameStackObservation(wrapped, FRAMES)
    return ReshapeObservation(stacked, (FRAMES, *wrapped.observation_space.shape[:2]))  # type: ignore[index]
