"""Runs what a preset lacks: independent processes, pinned threads, one progress line per run."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError
from benchmarks.plan import Cell, expand, settings, work_units
from benchmarks.presets import Preset
from benchmarks.store import RunFolder, Store

RUN_BYTES: Final = 20_000_000  # a run's small files, its TensorBoard events, its model twice
TRANSITION_BYTES: Final = 200  # of a checkpointed replay buffer, generously
POLL_SECONDS: Final = 0.3
GRACE_SECONDS: Final = 60.0  # for children to save their checkpoints after Ctrl-C
PINNED: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


@dataclass
class _Child:
    cell: Cell
    process: subprocess.Popen[bytes]
    task: TaskID
    log: Path
    started: float


@dataclass(frozen=True)
class Outcome:
    """What a run of the harness did."""

    trained: list[str]
    skipped: list[str]
    failed: dict[str, Path]
    interrupted: bool

    @property
    def complete(self) -> bool:
        return not self.failed and not self.interrupted


def missing(preset: Preset, store: Store) -> tuple[list[Cell], list[Cell]]:
    """The cells still to run and those complete; all are checked against their settings first.

    Raises:
        BenchmarkError: a stored run was made with other settings.
    """
    todo: list[Cell] = []
    done: list[Cell] = []
    for cell in expand(preset):
        folder = store.run(cell.id)
        folder.check_config(settings(preset, cell))
        (done if folder.is_done(cell.learns) else todo).append(cell)
    return todo, done


def check_disk(preset: Preset, store: Store, todo: Sequence[Cell]) -> None:
    """Refuse to start what would fill the disk: two checkpoints for each run, and its results.

    Raises:
        BenchmarkError: there is too little room.
    """
    needed = 0
    for cell in todo:
        needed += RUN_BYTES
        if cell.learns:
            h = preset.tracks[cell.track].hyperparameters
            needed += 2 * h.buffer_size * TRANSITION_BYTES
    free = shutil.disk_usage(store.folder).free
    if free < needed:
        raise BenchmarkError(
            f"{store.folder}: {needed / 1e9:.1f} GB may be needed for {len(todo)} runs, "
            f"{free / 1e9:.1f} GB are free; make room or use another --results folder"
        )


class Harness:
    """Runs cells in child processes.

    Args:
        preset: what to run.
        preset_argument: how a child is told of the preset (a name or a path).
        store: where results go; the caller holds its lock.
        results: the folder above the store, for the children.
        jobs: processes at a time.
        console: where progress goes.
    """

    def __init__(
        self,
        preset: Preset,
        preset_argument: str,
        store: Store,
        results: Path,
        jobs: int,
        console: Console,
    ) -> None:
        self.preset, self.preset_argument = preset, preset_argument
        self.store, self.results = store, results
        self.jobs = jobs
        self.console = console
        self._children: list[_Child] = []
        self._failed: dict[str, Path] = {}
        self._trained: list[str] = []

    def run(self) -> Outcome:
        """Run every missing cell; Ctrl-C lets the running ones save and stop."""
        todo, done = missing(self.preset, self.store)
        skipped = [cell.id for cell in done]
        if not todo:
            return Outcome([], skipped, {}, False)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            Remaining(),
            TextColumn("{task.fields[note]}"),
        )
        check_disk(self.preset, self.store, todo)
        interrupted = False
        with Progress(*columns, console=self.console, refresh_per_second=2) as progress:
            total = sum(work_units(self.preset, cell) for cell in todo)
            overall = progress.add_task(f"all {len(todo)} runs", total=total, note="")
            try:
                self._loop(todo, progress, overall)
            except KeyboardInterrupt:
                interrupted = True
                self.console.print("Stopping: the runs save their checkpoints")
                self._stop()
        return Outcome(self._trained, skipped, self._failed, interrupted)

    def _loop(self, todo: Sequence[Cell], progress: Progress, overall: TaskID) -> None:
        queue = list(todo)
        ended = 0.0
        while queue or self._children:
            while queue and len(self._children) < self.jobs:
                self._children.append(self._start(queue.pop(0), progress))
            time.sleep(POLL_SECONDS)
            under_way = 0.0
            for child in list(self._children):
                units = work_units(self.preset, child.cell)
                share, note = self.store.run(child.cell.id).progress()
                progress.update(child.task, completed=share, note=note)
                if child.process.poll() is None:
                    under_way += share * units
                    continue
                self._children.remove(child)
                progress.remove_task(child.task)
                self._report(child)
                ended += units
            progress.update(overall, completed=ended + under_way)

    def _start(self, cell: Cell, progress: Progress) -> _Child:
        log = self.store.run(cell.id).checkpoint / "log.txt"
        log.parent.mkdir(parents=True, exist_ok=True)
        command = [
            *(sys.executable, "-m", "benchmarks", "train"),
            *("--preset", self.preset_argument, "--results", str(self.results)),
            *("--cell", cell.id, "--parent", str(os.getpid())),
        ]
        with log.open("ab") as stream:
            # a session of its own: Ctrl-C reaches the harness alone, which then asks politely
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env={**os.environ, **PINNED},
                start_new_session=True,
            )
        task = progress.add_task(f"  {cell.id}", total=1.0, note="starting")
        return _Child(cell, process, task, log, time.perf_counter())

    def _report(self, child: _Child) -> None:
        folder = self.store.run(child.cell.id)
        if child.process.returncode == 0 and folder.is_complete():
            self._trained.append(child.cell.id)
            seconds = time.perf_counter() - child.started
            self.console.print(f"{child.cell.id}: done in {seconds:.0f} s{_verdict(folder)}")
        else:
            self._failed[child.cell.id] = child.log
            self.console.print(
                f"{child.cell.id}: failed with exit code {child.process.returncode}, "
                f"see {child.log}\n{_tail(child.log)}",
                style="red",
                markup=False,
            )

    def _stop(self) -> None:
        for child in self._children:
            child.process.send_signal(signal.SIGTERM)
        deadline = time.perf_counter() + GRACE_SECONDS
        for child in self._children:
            try:
                child.process.wait(max(0.1, deadline - time.perf_counter()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        self._children.clear()


def _verdict(folder: RunFolder) -> str:
    if not folder.has_rows("episodes"):
        return ""
    rows = folder.rows("episodes")
    clean = rows[rows["noise"] == 0.0]
    return f", success {100 * clean['success'].mean():.0f} % of {len(clean)} test episodes"


def _tail(log: Path, lines: int = 8) -> str:
    try:
        return "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:])
    except OSError:
        return ""


def default_jobs() -> int:
    """One process per core that this process may use."""
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
