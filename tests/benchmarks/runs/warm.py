"""Processes of the command without the seconds of their imports, which tests may kill.

They are forks of one that has imported and compiled everything.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import forkserver, get_context
from pathlib import Path
from typing import Any

import pytest

OPERATIONS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree"}
PATIENCE = 400.0  # seconds; only what hangs takes so long, on a slow and busy machine too


class FileOperations:
    """Counts operations that change files of runs, and kills the process at one of them."""

    def __init__(self, crash: int) -> None:
        self.crash, self.count = crash, 0

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, mode, flags = arguments
            writes = set("wax+") & set(mode or "") or (flags or 0) & (os.O_WRONLY | os.O_RDWR)
        elif event in OPERATIONS:
            path, writes = arguments[0], True
        else:
            return
        if writes and isinstance(path, (str, os.PathLike)) and "/runs/" in os.fspath(path):
            if self.count == self.crash:
                os.kill(os.getpid(), signal.SIGKILL)
            self.count += 1


def run(argv: Sequence[str], log: str, crash: int | None) -> None:
    """In the fork: the command, its output in ``log``.

    With ``crash`` it kills itself before its n-th operation on files (counted from 0), and without
    being killed writes how many there were to ``<log>.count``.
    """
    from benchmarks.cli import main

    with open(log, "ab") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a run before may have left its own
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if crash is None:
        sys.exit(main(argv))
    operations = FileOperations(crash)
    sys.addaudithook(operations)
    code = main(argv)
    Path(f"{log}.count").write_text(str(operations.count), encoding="utf-8")
    sys.exit(code)


class Forked:
    """The command with these words in a fork, as far as a harness needs a ``Popen``."""

    def __init__(self, log: Path, words: Sequence[str], crash: int | None = None) -> None:
        arguments = (words, str(log), crash)
        self.process = get_context("forkserver").Process(target=run, args=arguments, daemon=True)
        self.process.start()
        self.kill = self.process.kill

    def poll(self) -> int | None:
        return self.process.exitcode

    def send_signal(self, number: int) -> None:
        with suppress(ProcessLookupError):  # it has ended
            os.kill(int(str(self.process.pid)), number)

    def wait(self, seconds: float = PATIENCE) -> int:
        self.process.join(seconds)
        if (code := self.process.exitcode) is None:
            raise subprocess.TimeoutExpired("fork", seconds)
        return code


def wait_for(condition: Callable[[], Any], log: Path) -> Any:
    """What a condition gives once it holds; a process writes the log meanwhile."""
    deadline = time.monotonic() + PATIENCE
    while not (result := condition()):
        assert time.monotonic() < deadline, log.read_text(encoding="utf-8")
        time.sleep(0.02)
    return result


def warm_up() -> None:
    """Start the process that is forked from now on."""
    context = get_context("forkserver")
    forkserver._forkserver._stop()  # type: ignore[attr-defined] # another's lacks our imports
    context.set_forkserver_preload(["tests.benchmarks.runs.warmed"])
    first = context.Process(target=int)  # once it has ended all is compiled
    first.start()
    first.join()


@contextmanager
def children() -> Iterator[None]:
    """Runs that a harness of this process starts are forked meanwhile."""

    def spawn(argv: Sequence[str], log: Path) -> Forked:
        log.parent.mkdir(parents=True, exist_ok=True)
        return Forked(log, argv)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.runs.backends.spawn", spawn)
        patch.setattr("benchmarks.runs.harness.POLL_SECONDS", 0.1)
        yield
