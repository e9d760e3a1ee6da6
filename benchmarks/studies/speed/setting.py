"""The setting in which the speed of learners is measured, and the stopwatch."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial
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


# what so many updates take, with the steps of the env between them ("learn") or alone ("train")
Contestant = Callable[[str, int], Seconds]


def ours(model: Any, batch_size: int) -> Contestant:
    """An algorithm of SB3's kind that makes an update after each step of all its envs.

    Args:
        model: trained for a moment, its replay buffer full.
        batch_size: transitions per update.
    """

    def act(kind: str, n: int) -> None:
        if kind == "learn":
            model.learn(n * model.n_envs, reset_num_timesteps=False)
        else:
            for _ in range(n):
                model.train(1, batch_size)
        if model.device.type == "cuda":
            from torch import cuda

            cuda.synchronize()

    act("train", 0)  # what the device still has to do ends before the first timing
    return lambda kind, n: seconds_of(partial(act, kind, n))


def measure_updates(
    contestants: Mapping[str, Contestant], n_updates: int, rounds: int
) -> dict[str, dict[str, float]]:
    """Updates per second of ``learn``, and of ``train`` alone: medians over rounds in turns."""
    rates: dict[str, dict[str, list[float]]] = {name: {} for name in contestants}
    for name in list(contestants) * rounds:
        for kind in ("learn", "train"):
            for clock, took in contestants[name](kind, n_updates)._asdict().items():
                rates[name].setdefault(f"{kind}_{clock}", []).append(n_updates / took)
    return {
        name: {kind: statistics.median(values) for kind, values in found.items()}
        for name, found in rates.items()
    }
