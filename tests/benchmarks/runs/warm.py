"""Speaks with ``warm_server.py``, of which runs are forked: their imports are paid once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from benchmarks.runs.machine import REPOSITORY

SERVER = "tests.benchmarks.runs.warm_server"


class Server:
    """A process that has run these cells of a preset."""

    def __init__(self, preset: str, *cells: str) -> None:
        self.process: Any = subprocess.Popen(
            [sys.executable, "-m", SERVER, preset, *cells],
            cwd=REPOSITORY,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"},
        )
        assert self._read() == "ready"

    def _read(self) -> str:
        return str(self.process.stdout.readline().strip())

    def ask(self, **request: Any) -> Any:
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return json.loads(self._read())

    def start(self, log: Path, *words: str, **crash: int) -> Forked:
        """Start ``python -m benchmarks`` with these words."""
        return Forked(self, self.ask(argv=words, log=str(log), **crash))

    @contextmanager
    def children(self) -> Iterator[None]:
        """Runs that a harness of this process starts are forked meanwhile."""

        def spawn(argv: Sequence[str], log: Path) -> Forked:
            log.parent.mkdir(parents=True, exist_ok=True)
            return self.start(log, *argv, "--parent", str(self.process.pid))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("benchmarks.runs.backends.spawn", spawn)
            patch.setattr("benchmarks.runs.harness.POLL_SECONDS", 0.1)
            yield

    def close(self) -> None:
        for left in psutil.Process(self.process.pid).children(recursive=True):
            left.kill()  # of a test that failed
        with self.process as process:
            process.kill()


class Forked:
    """A fork, as far as a harness needs a ``Popen``."""

    def __init__(self, server: Server, pid: int) -> None:
        self.server, self.pid = server, pid
        self.code: int | None = None

    def poll(self) -> int | None:
        if self.code is None:
            self.code = self.server.ask(poll=self.pid)
        return self.code

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, seconds: float = 250.0) -> int:
        end = time.monotonic() + seconds
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("fork", seconds)
            time.sleep(0.02)
        return code
