"""What measurements of speed share: the stopwatch, taking turns, loops over an environment."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, TypeVar

from benchmarks.studies.base import Option, count

Name = TypeVar("Name", bound=Hashable)


def seconds_of(action: Callable[[], Any]) -> float:
    """CPU seconds of a call."""
    began = time.process_time()
    action()
    return time.process_time() - began


def in_turns(actions: Mapping[Name, Callable[[], Any]], rounds: int) -> dict[Name, float]:
    """CPU seconds of a call: medians over rounds in turns; the first is not counted."""
    times: dict[Name, list[float]] = {name: [] for name in actions}
    for _ in range(rounds + 1):
        for name, action in actions.items():
            times[name].append(seconds_of(action))
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def stepping(env: Any, actions: Iterable[Any], masks: bool = False) -> Callable[[], None]:
    """A loop of so many steps, each followed by the action masks; one that is over begins anew."""
    env.reset(seed=0)
    look = env.unwrapped.action_masks if masks else bool

    def loop() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            look()
            if terminated or truncated:
                env.reset()

    return loop


def batch_stepping(env: Any, actions: Iterable[Any], masks: bool = False) -> Callable[[], None]:
    """The same for a batch of environments, which begin anew by themselves."""
    env.reset()

    def loop() -> None:
        for row in actions:
            env.step(row)
            if masks:
                env.env_method("action_masks")

    return loop


def options(steps: int, rounds: int) -> dict[str, Option]:
    """How long each measurement takes."""
    return {
        "--steps": count(steps, "steps per round and method"),
        "--rounds": count(rounds, "rounds, of which the median"),
    }
