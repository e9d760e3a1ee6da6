"""Methods that learn: those of this process, and rivals in processes of their own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, Final

from benchmarks.errors import BenchmarkError
from benchmarks.runs.machine import REPOSITORY
from benchmarks.studies.speed.setting import Seconds, seconds_of

RIVALS_PYTHON: Final = Path(".venv-rivals/bin/python")
RIVALS: Final = ("tianshou", "AgileRL")
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


class Rival:
    """A library's Rainbow in its own interpreter; see :mod:`benchmarks.studies.speed.rivals`.

    ``about`` is what it says of itself: version, net, number of parameters.

    Raises:
        BenchmarkError: if it stops, with its last words.
    """

    def __init__(self, name: str, process: subprocess.Popen[str], errors: IO[str]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self.name, self._process, self._errors = name, process, errors
        self._requests, self._answers = process.stdin, process.stdout
        self.about: dict[str, Any] = self._read()

    def __call__(self, kind: str, n: int) -> Seconds:
        """What so many of a kind take."""
        print(json.dumps([kind, n]), file=self._requests, flush=True)
        return Seconds(*self._read())

    def _read(self) -> Any:
        """Its next answer; a pipe that is closed has none."""
        if line := self._answers.readline():
            return json.loads(line)
        self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines() or ["no message"]
        raise BenchmarkError(f"{self.name} stopped: {lines[-1]}; renew it with: make rivals")


@contextmanager
def start_rival(name: str, capacity: int, python: Path = RIVALS_PYTHON) -> Iterator[Rival]:
    """One of ``RIVALS``, until the context ends.

    Args:
        capacity: transitions in its replay buffer.
        python: interpreter that has it.
    """
    module = ("-W", "ignore", "-m", "benchmarks.studies.speed.rivals")
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [str(python), *module, name, str(capacity)],
            cwd=REPOSITORY,
            env={**os.environ, "OMP_NUM_THREADS": "1", "WANDB_MODE": "disabled"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        yield Rival(name, process, errors)


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
