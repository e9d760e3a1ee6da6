"""The setting in which the speed of Rainbow is measured, ours and others', and the stopwatch.

Rivals import it in an interpreter of their own, which has neither SB3 nor this house's packages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

N_INPUTS: Final = 12
N_ACTIONS: Final = 12
BATCH_SIZE: Final = 64
CAPACITY: Final = 1_000_000
NET_ARCH: Final = (256, 128, 64)
N_ATOMS: Final = 51
SUPPORT: Final = (-100.0, 100.0)
N_STEPS: Final = 3
GAMMA: Final = 0.99
ALPHA: Final = 0.6
BETA: Final = 0.4
SIGMA0: Final = 0.5
LEARNING_RATE: Final = 1e-4
TAU: Final = 1e-3
EPISODE: Final = 100
REWARD: Final = 0.1


class Seconds(NamedTuple):
    """What a call took."""

    cpu: float
    wall: float


class StubEnv(gym.Env[np.ndarray, np.int64]):
    """Random observations, episodes of 100 steps: only the learner's time counts."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0.0, 1.0, (N_INPUTS,), np.float32)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._rng = np.random.default_rng(0)
        self._time = 0

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """A random observation."""
        self._time = 0
        return self._rng.random(N_INPUTS, dtype=np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """A random observation, the same reward always."""
        self._time += 1
        obs = self._rng.random(N_INPUTS, dtype=np.float32)
        return obs, REWARD, False, self._time >= EPISODE, {}


def random_contents(capacity: int) -> dict[str, NDArray]:
    """What a full replay buffer holds of the :class:`StubEnv`, by name, ``(capacity, ...)``."""
    rng = np.random.default_rng(0)
    return {
        "obs": rng.random((capacity, N_INPUTS), dtype=np.float32),
        "next_obs": rng.random((capacity, N_INPUTS), dtype=np.float32),
        "action": rng.integers(0, N_ACTIONS, capacity),
        "priority": rng.uniform(0.5, 2.0, capacity),
    }


def seconds_of(action: Callable[[], Any], n_calls: int = 1) -> Seconds:
    """CPU and wall seconds of a call, the mean of so many in a row."""
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(n_calls):
        action()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Seconds(cpu / n_calls, wall / n_calls)
