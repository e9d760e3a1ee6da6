"""Methods measured in turns: those of this process, and rivals in processes of their own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from rich.console import Console
from rich.progress import track

from benchmarks.errors import BenchmarkError
from benchmarks.runs.machine import REPOSITORY
from benchmarks.studies.speed.setting import Contestant, Seconds, seconds_of

RIVALS_PYTHON: Final = Path(".venv-rivals/bin/python")
RIVALS: Final = ("tianshou", "AgileRL")


class Ours:
    """
    An algorithm of SB3's kind.

    :param model: trained for a moment, its replay buffer full
    :param batch_size: transitions per update
    """

    def __init__(self, model: Any, batch_size: int) -> None:
        self.model = model
        self.batch_size = batch_size

    def learn(self, n_steps: int) -> Seconds:
        """Steps of the env, each with one update."""
        return self._seconds(lambda: self.model.learn(n_steps, reset_num_timesteps=False))

    def train(self, n_updates: int) -> Seconds:
        """Updates alone."""

        def updates() -> None:
            for _ in range(n_updates):
                self.model.train(1, self.batch_size)

        return self._seconds(updates)

    def _seconds(self, action: Any) -> Seconds:
        if self.model.device.type != "cuda":
            return seconds_of(action)
        from torch import cuda

        def until_the_device_is_done() -> None:
            action()
            cuda.synchronize()

        cuda.synchronize()
        return seconds_of(until_the_device_is_done)


class Rival:
    """
    A library's Rainbow in its own interpreter; see :mod:`benchmarks.studies.speed.rivals`.

    :param name: one of ``RIVALS``
    :param capacity: transitions in its replay buffer
    :param python: interpreter that has it
    :raises BenchmarkError: if it does not start
    """

    def __init__(self, name: str, capacity: int, python: Path = RIVALS_PYTHON) -> None:
        self.name = name
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed with the process
        self._process = subprocess.Popen(
            [
                str(python),
                "-W",
                "ignore",
                "-m",
                "benchmarks.studies.speed.rivals",
                name,
                str(capacity),
            ],
            cwd=REPOSITORY,
            env={**os.environ, "OMP_NUM_THREADS": "1", "WANDB_MODE": "disabled"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        try:
            found = self._read()
        except BaseException:
            self.close()
            raise
        self.version, self.net = str(found["version"]), str(found["net"])
        self.parameters = int(found["parameters"])

    def learn(self, n_steps: int) -> Seconds:
        """Steps of the env, each with one update."""
        return self._ask("learn", n_steps)

    def train(self, n_updates: int) -> Seconds:
        """Updates alone."""
        return self._ask("train", n_updates)

    def _ask(self, request: str, n: int) -> Seconds:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([request, n]) + "\n")
        self._process.stdin.flush()
        return Seconds(*self._read())

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._errors.seek(0)
            lines = self._errors.read().strip().splitlines() or ["no message"]
            raise BenchmarkError(f"{self.name} stopped: {lines[-1]}; renew it with: make rivals")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def __enter__(self) -> Rival:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def measure_updates(
    contestants: Mapping[str, Contestant], n_steps: int, rounds: int
) -> dict[str, dict[str, float]]:
    """Updates per second of ``learn``, and of ``train`` alone: medians over rounds in turns."""
    kinds = ("learn_cpu", "learn_wall", "train_cpu", "train_wall")
    rates: dict[str, dict[str, list[float]]] = {
        name: {kind: [] for kind in kinds} for name in contestants
    }
    turns = [name for _ in range(rounds) for name in contestants]
    for name in track(turns, "measuring updates", console=Console(stderr=True)):
        contestant = contestants[name]
        learn, train = contestant.learn(n_steps), contestant.train(n_steps)
        for kind, seconds in zip(kinds, (*learn, *train), strict=True):
            rates[name][kind].append(n_steps / seconds)
    return {
        name: {kind: statistics.median(values) for kind, values in found.items()}
        for name, found in rates.items()
    }
