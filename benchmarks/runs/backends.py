"""Where a run's process lives: a child of the harness here, or a worker of a cluster.

A backend starts ``python -m benchmarks <argv>``. The process does the same everywhere, and reports
to the harness only through the run's folder.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from benchmarks.runs.machine import REPOSITORY
from benchmarks.runs.store import RunFolder

BACKENDS: Final = ("local", "ray")
PINNED: Final = {
    # one thread per process, so that as many processes as cores do not compete
    **dict.fromkeys(
        ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
    ),
    # glibc would give every batch of images back to the kernel, and fault its pages in again
    **{"MALLOC_MMAP_THRESHOLD_": str(2**25), "MALLOC_TRIM_THRESHOLD_": str(2**28)},
}
GRACE_SECONDS: Final = 60.0  # for a run to save its checkpoint after it was asked to stop


class Job:
    """A run under way, whose output goes to ``log``: a child process."""

    def __init__(self, argv: Sequence[str], log: Path) -> None:
        self.log, self.process = log, spawn(argv, log)

    def poll(self) -> int | None:
        """The process's exit code; None while it runs or waits."""
        return self.process.poll()

    def place(self) -> str | None:
        """Where it runs (empty: here); None while it waits."""
        return ""

    def news(self) -> list[str]:
        """Events since the last call, a sentence each."""
        return []

    def stop(self) -> None:
        """Ask it to save and end."""
        self.process.send_signal(signal.SIGTERM)

    def wait(self, seconds: float) -> None:
        """Wait at most ``seconds`` for its end; kill it if it still runs then."""
        try:
            self.process.wait(max(0.1, seconds))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Backend:
    """Starts runs: child processes, by default one for each core that this process may use."""

    def __init__(self, jobs: int | None = None) -> None:
        self.slots = default_jobs() if jobs is None else jobs  # runs under way at a time

    def describe(self) -> str:
        """What each run gets, in a sentence."""
        return f"{self.slots} processes of one thread on {os.cpu_count()} cores"

    def start(self, argv: Sequence[str], folder: RunFolder) -> Job:
        """Start ``python -m benchmarks <argv>``, which works on ``folder``."""
        return Job(argv, folder.log)

    def close(self) -> None:
        """Release what the backend holds."""


def spawn(argv: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a run's process: pinned to one thread, its output in ``log``."""
    log.parent.mkdir(parents=True, exist_ok=True)
    # benchmarks is not installed, and a cluster's node starts in another folder
    found_in = os.pathsep.join(filter(None, [str(REPOSITORY), os.environ.get("PYTHONPATH")]))
    with log.open("ab") as stream:
        # a session of its own: Ctrl-C reaches the harness alone, which then asks politely
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks", *argv, "--parent", str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env={**os.environ, **PINNED, "PYTHONPATH": found_in},
            start_new_session=True,
        )


def default_jobs() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
