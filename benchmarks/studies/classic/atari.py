"""Atari's games as data-efficient Rainbow plays them, through ale-py and SB3's wrappers."""

from __future__ import annotations

import warnings
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FrameStackObservation, ReshapeObservation
from numpy.typing import NDArray

from benchmarks.errors import BenchmarkError

FRAMES: Final = 4  # stacked
EPISODE_STEPS: Final = 27_000  # half an hour of play at 60 frames a second, 4 of them a step
NOOPS: Final = 30  # at most, at the start of an episode
EPSILON: Final = 0.001  # of the actions of a test, Dopamine's: else at most 30 episodes differ


class NowAndThenRandom(gym.Wrapper[NDArray[np.uint8], Any, NDArray[np.uint8], Any]):
    """Takes a random action with a probability of :data:`EPSILON`, drawn from the reset's seed."""

    def __init__(self, env: gym.Env[NDArray[np.uint8], Any]) -> None:
        super().__init__(env)
        self._rng = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """As the game's, with a generator of this seed's own."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[NDArray[np.uint8], Any, bool, bool, dict[str, Any]]:
        """As the game's, but now and then by another action."""
        assert isinstance(self.action_space, gym.spaces.Discrete)
        if self._rng.random() < EPSILON:
            action = self._rng.integers(self.action_space.n)
        return self.env.step(action)


def make_atari(name: str, training: bool = False) -> gym.Env[NDArray[np.uint8], Any]:
    """A game of Atari, ``ALE/<Game>-v5``: no sticky actions, four frames a step, up to 30 no-ops.

    Observations are the last four grey frames, (4, 84, 84), uint8; at first all are the first. No
    game is begun by FIRE, as in Dopamine.

    Args:
        name: Gymnasium's id.
        training: rewards are cut to their signs, and a life lost ends the episode; otherwise now
            and then an action is random.

    Raises:
        BenchmarkError: there is no such game, or ale-py or OpenCV are not installed.
    """
    try:
        import ale_py
        import cv2  # noqa: F401  which SB3's wrapper needs
    except ImportError as error:
        raise BenchmarkError(f"{name} needs {error.name}: pip install -e '.[classic]'") from error
    from stable_baselines3.common import atari_wrappers as sb3

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
    wrapped: gym.Env[Any, Any] = sb3.MaxAndSkipEnv(sb3.NoopResetEnv(env, NOOPS), FRAMES)
    if training:
        wrapped = sb3.EpisodicLifeEnv(wrapped)
    wrapped = sb3.WarpFrame(wrapped)
    wrapped = sb3.ClipRewardEnv(wrapped) if training else NowAndThenRandom(wrapped)
    stacked = FrameStackObservation(wrapped, FRAMES)
    return ReshapeObservation(stacked, (FRAMES, *wrapped.observation_space.shape[:2]))  # type: ignore[index]
