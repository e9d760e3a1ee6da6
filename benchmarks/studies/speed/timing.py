"""What the measurements of speed share: the stopwatch, taking turns, learners that take turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, TypeVar

import psutil

from benchmarks.errors import at_least
from benchmarks.studies.base import Option

Name = TypeVar("Name", bound=Hashable)


class Seconds(NamedTuple):
    """What a call took."""

    cpu: float
    wall: float


# what so many updates take, with the steps of the env between them ("learn") or alone ("train")
Contestant = Callable[[str, int], Seconds]


def seconds_of(action: Callable[[], Any], n_calls: int = 1) -> Seconds:
    """CPU and wall seconds of a call, the mean of so many in a row."""
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(n_calls):
        action()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Seconds(cpu / n_calls, wall / n_calls)


def in_turns(
    actions: Mapping[Name, Callable[[], Any]], rounds: int, n_calls: int = 1, unit: float = 1.0
) -> dict[Name, float]:
    """CPU time of a call, in ``unit`` s: medians over rounds in turns; the first is not counted."""
    times: dict[Name, list[float]] = {name: [] for name in actions}
    for _ in range(rounds + 1):
        for name, action in actions.items():
            times[name].append(seconds_of(action, n_calls).cpu / unit)
    return {name: statistics.median(values[1:]) for name, values in times.items()}


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
        name: {kind: statistics.median(values) for kind, values in result.items()}
        for name, result in rates.items()
    }


def learner(model: Any, batch_size: int) -> Contestant:
    """An algorithm of SB3's kind with a full replay buffer; each step of its envs has an update."""

    def act(kind: str, n: int) -> None:
        if kind == "learn":
            model.learn(n * model.n_envs, reset_num_timesteps=False)
        else:
            for _ in range(n):
                model.train(1, batch_size)

    return lambda kind, n: seconds_of(lambda: act(kind, n))


def resident_mb() -> float:
    """Memory of this process."""
    return float(psutil.Process().memory_info().rss) / 1e6


def options(steps: int, rounds: int) -> dict[str, Option]:
    """How long each measurement takes."""
    return {
        "--steps": {"type": at_least(1), "default": steps, "help": "steps per round and method"},
        "--rounds": {"type": at_least(1), "default": rounds, "help": "rounds, of which the median"},
    }
