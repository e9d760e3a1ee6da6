"""Runs what a preset lacks: independent processes, pinned threads, one progress line per run."""

from __future__ import annotations

import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell, expand, settings, work_units
from benchmarks.protocol.presets import Preset
from benchmarks.runs.backends import GRACE_SECONDS, Backend, Job, LocalBackend
from benchmarks.runs.costs import duration
from benchmarks.runs.store import RunFolder, Store

RUN_BYTES: Final = 20_000_000  # a run's small files, its TensorBoard events, its model twice
TRANSITION_BYTES: Final = 200  # of a checkpointed replay buffer, generously
POLL_SECONDS: Final = 0.3


@dataclass
class _Child:
    cell: Any
    job: Job
    task: TaskID
    started: float | None = None


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

    def close(self, store: Store, console: Console, write: Callable[[], object]) -> int:
        """Say what came of it, and ``write`` tables and figures unless it was interrupted.

        Returns:
            The command's exit code.
        """
        if self.skipped:
            console.print(f"{len(self.skipped)} runs were complete already")
        if self.interrupted:
            console.print(f"Interrupted; the same command resumes. Results so far: {store.folder}")
            return 130
        write()
        console.print(f"Runs: {store.folder / 'runs'}")
        if self.failed:
            console.print(f"Failed: {', '.join(self.failed)}; the same command tries again")
            return 1
        return 0


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
        if folder.is_done(cell.learns):
            folder.drop_checkpoint()  # left by a process that was killed at its very end
            done.append(cell)
        else:
            todo.append(cell)
    return todo, done


def check_disk(preset: Preset, store: Store, todo: Sequence[Cell], slots: int) -> None:
    """Refuse to start what would fill the disk: results, and checkpoints of runs side by side.

    Raises:
        BenchmarkError: there is too little room.
    """
    buffers = [
        preset.tracks[cell.track].hyperparameters.buffer_size if cell.learns else 0 for cell in todo
    ]
    # a checkpoint is written beside the last one
    checkpoints = 2 * TRANSITION_BYTES * sum(sorted(buffers, reverse=True)[:slots])
    needed = RUN_BYTES * len(todo) + checkpoints
    free = shutil.disk_usage(store.folder).free
    if free < needed:
        raise BenchmarkError(
            f"{store.folder}: {needed / 1e9:.1f} GB may be needed for {len(todo)} runs, "
            f"{free / 1e9:.1f} GB are free; make room, use another --results folder or fewer --jobs"
        )


class Harness:
    """Runs cells in processes; other experiments override what a cell is and costs.

    Args:
        preset: what to run.
        preset_argument: how a process is told of the preset (a name or a path).
        store: where results go; the caller holds its lock.
        results: the folder above the store, for the processes.
        backend: where the processes live; a number stands for so many on this machine.
        console: where progress goes.
        options: words added to the command of each process.
    """

    #: the command that runs one cell
    train_words: tuple[str, ...] = ("train",)

    def __init__(
        self,
        preset: Any,
        preset_argument: str,
        store: Store,
        results: Path,
        backend: Backend | int,
        console: Console,
        options: Sequence[str] = (),
    ) -> None:
        self.preset, self.preset_argument = preset, preset_argument
        self.store, self.results = store, results
        self.console = console
        self.backend = LocalBackend(backend) if isinstance(backend, int) else backend
        self.options = options
        self._children: list[_Child] = []
        self._failed: dict[str, Path] = {}
        self._trained: list[str] = []

    def missing(self) -> tuple[list[Any], list[Any]]:
        """The cells still to run and those complete."""
        return missing(self.preset, self.store)

    def check_cells(self, todo: Sequence[Any]) -> None:
        """Refuse to start what cannot be built."""
        cells = [cell for cell in todo if isinstance(cell, Cell) and cell.learns]
        if cells:
            from benchmarks.methods.learners import check_cells

            check_cells(self.preset, cells)

    def check_disk(self, todo: Sequence[Any]) -> None:
        """Refuse to start what would fill the disk."""
        check_disk(self.preset, self.store, todo, self.backend.slots)

    def work_units(self, cell: Any) -> int:
        """A rough cost of a cell, for the progress bar."""
        return work_units(self.preset, cell)

    def verdict(self, folder: RunFolder) -> str:
        """What is said of a cell at its end."""
        return _verdict(folder)

    def run(self) -> Outcome:
        """Run every missing cell; Ctrl-C or SIGTERM lets the running ones save and stop."""
        todo, done = self.missing()
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
        self.check_disk(todo)
        self.check_cells(todo)
        interrupted = False
        with Progress(*columns, console=self.console, refresh_per_second=2) as progress:
            # what earlier calls have done counts as done, not as fast work
            shares = {cell.id: self.store.run(cell.id).progress()[0] for cell in todo}
            units = {cell.id: self.work_units(cell) for cell in todo}
            overall = progress.add_task(
                f"all {len(todo)} runs",
                total=sum(units.values()),
                completed=round(sum(shares[name] * units[name] for name in shares)),
                note="",
            )
            try:
                with terminable():
                    self._loop(todo, progress, overall, shares)
            except KeyboardInterrupt:
                interrupted = True
                self.console.print("Stopping: the runs save their checkpoints")
                self._stop()
        return Outcome(self._trained, skipped, self._failed, interrupted)

    def _loop(
        self, todo: Sequence[Any], progress: Progress, overall: TaskID, shares: dict[str, float]
    ) -> None:
        queue = list(todo)
        while queue or self._children:
            while queue and len(self._children) < self.backend.slots:
                cell = queue.pop(0)
                self._children.append(self._start(cell, progress, shares[cell.id]))
            time.sleep(POLL_SECONDS)
            for child in list(self._children):
                for sentence in child.job.news():
                    self.console.print(f"{child.cell.id}: {sentence}", markup=False)
                place = child.job.place()
                if place is not None:
                    if child.started is None:  # until now it waited for its turn
                        child.started = time.perf_counter()
                        progress.start_task(child.task)
                    share, note = self.store.run(child.cell.id).progress()
                    shares[child.cell.id] = share
                    note = f"{note} on {place}" if place else note
                    progress.update(child.task, completed=share, note=note, visible=True)
                if child.job.poll() is not None:
                    self._children.remove(child)
                    progress.remove_task(child.task)
                    self._report(child)
                    shares[child.cell.id] = 1.0
            done = sum(shares[cell.id] * self.work_units(cell) for cell in todo)
            waiting = len(queue) + sum(child.job.place() is None for child in self._children)
            progress.update(overall, completed=done, note=f"{waiting} wait" if waiting else "")

    def _start(self, cell: Any, progress: Progress, share: float) -> _Child:
        words = [
            *(*self.train_words, "--preset", self.preset_argument),
            *("--results", str(self.results), "--cell", cell.id, *self.options),
            # the process of a harness that was killed may still be saving
            *("--wait", f"{GRACE_SECONDS:g}"),
        ]
        job = self.backend.start(words, self.store.run(cell.id))
        task = progress.add_task(
            f"  {cell.id}", total=1.0, note="starting", visible=False, start=False
        )
        progress.update(task, completed=share)
        return _Child(cell, job, task)

    def _report(self, child: _Child) -> None:
        folder = self.store.run(child.cell.id)
        code = child.job.poll()
        if code == 0 and folder.is_complete():
            self._trained.append(child.cell.id)
            seconds = 0.0 if child.started is None else time.perf_counter() - child.started
            self.console.print(
                f"{child.cell.id}: done in {duration(seconds)}{self.verdict(folder)}"
            )
            for name in folder.meta()["training"].get("set_aside", []):
                self.console.print(
                    f"{child.cell.id}: a checkpoint could not be read and is kept as "
                    f"{folder.checkpoint / name}",
                    style="yellow",
                    markup=False,
                )
        else:
            self._failed[child.cell.id] = child.job.log
            self.console.print(
                f"{child.cell.id}: failed with exit code {code}, "
                f"see {child.job.log}\n{_tail(child.job.log)}",
                style="red",
                markup=False,
            )

    def _stop(self) -> None:
        for child in self._children:
            child.job.stop()
        deadline = time.perf_counter() + GRACE_SECONDS
        for child in self._children:
            child.job.wait(deadline - time.perf_counter())
        self._children.clear()


@contextmanager
def terminable() -> Iterator[None]:
    """Take SIGTERM, with which a batch system ends a job, as Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


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
