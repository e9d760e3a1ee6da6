"""Runs what an experiment lacks: a process for each cell, one progress line per run."""

import shutil
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rich.console import Console, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell
from benchmarks.runs import cell as cells
from benchmarks.runs.backends import GRACE_SECONDS, Backend, Job
from benchmarks.runs.costs import duration
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.store import RunFolder, Store, digest

POLL_SECONDS: Final = 0.3
PER_SECOND: Final = 2  # times that a bar is drawn


@dataclass
class _Child:
    folder: RunFolder
    job: Job
    task: TaskID
    started: float | None = None


@dataclass
class Outcome:
    """What a run of the harness did."""

    trained: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: dict[str, Path] = field(default_factory=dict)
    interrupted: bool = False

    def close(self, store: Store, console: Console, write: Callable[[], object]) -> int:
        """Print the outcome, and ``write`` unless interrupted; returns the exit code."""
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


def check_disk(experiment: Experiment, store: Store, todo: Sequence[Cell], slots: int) -> None:
    """Refuse to start if results, and checkpoints of parallel runs, would fill the disk."""
    # a checkpoint is written beside the last one
    sizes = sorted((2 * experiment.checkpoint_bytes(cell) for cell in todo), reverse=True)
    needed = experiment.run_bytes * len(todo) + sum(sizes[:slots])
    free = shutil.disk_usage(store.folder).free
    if free < needed:
        raise BenchmarkError(
            f"{store.folder}: {needed / 1e6:,.0f} MB may be needed (runs: {len(todo)}), "
            f"{free / 1e6:,.0f} MB are free; make room, or use another --results folder"
            f"{' or fewer --jobs' if slots > 1 else ''}"
        )


def check_settings(experiment: Experiment, store: Store, todo: Sequence[Cell]) -> None:
    """Refuse cells that the store holds, for this or another seed, with other settings."""
    alike = {run.id.rpartition("-s")[0]: run for run in store.completed()}
    for cell in todo:
        config = experiment.settings(cell)
        store.run(cell.id).check_config(config)
        if kept := alike.get(cell.id.rpartition("-s")[0]):
            kept.check_alike(cell.id, config)


class Harness:
    """Runs the cells of an experiment in processes of a backend; the caller holds the store's lock.

    Networks live on ``device``, cpu or cuda.
    """

    def __init__(
        self,
        experiment: Experiment,
        store: Store,
        backend: Backend,
        console: Console,
        device: str = "cpu",
    ) -> None:
        self.experiment, self.store, self.backend = experiment, store, backend
        self.console, self.device = console, device
        self._queue: deque[Cell] = deque()
        self._children: list[_Child] = []
        self._units: dict[str, int] = {}
        self._shares: dict[str, float] = {}
        self._outcome = Outcome()

    def run(self) -> Outcome:
        """Run every missing cell; Ctrl-C or SIGTERM lets the running ones save and stop."""
        self._admit(self.experiment.cells)
        if not self._queue:
            return self._outcome
        todo = list(self._queue)
        check_disk(self.experiment, self.store, todo, self.backend.slots)
        self.experiment.check(todo)
        more = TextColumn("{task.percentage:>3.0f} %"), TextColumn("{task.fields[note]}")
        with bar(self.console, *more) as progress:
            overall = progress.add_task("", note="")
            self._show(progress, overall)
            # a batch system ends a job with SIGTERM
            before = signal.signal(signal.SIGTERM, signal.default_int_handler)
            try:
                self._loop(progress, overall)
            except KeyboardInterrupt:
                self.console.print("Stopping: the runs save their checkpoints")
                self._stop()
                self._outcome.interrupted = True
            finally:
                signal.signal(signal.SIGTERM, before)
        return self._outcome

    def _admit(self, cells: Sequence[Cell]) -> None:
        """Queue the cells that are still to run; all are checked against their settings first."""
        check_settings(self.experiment, self.store, cells)
        for cell in cells:
            folder, config = self.store.run(cell.id), self.experiment.settings(cell)
            if folder.is_complete():
                folder.drop_checkpoint()  # left by a process that was killed at its very end
                self._outcome.skipped.append(cell.id)
                continue
            self._queue.append(cell)
            self._units[cell.id] = self.experiment.units(config)
            # work of earlier calls counts as done, not as fast work
            self._shares[cell.id] = folder.progress()[0]

    def _loop(self, progress: Progress, overall: TaskID) -> None:
        while True:
            while self._queue and len(self._children) < self.backend.slots:
                self._children.append(self._start(self._queue.popleft(), progress))
            if not self._children:
                return
            time.sleep(POLL_SECONDS)
            for child in list(self._children):
                self._look_after(child, progress)
            self._show(progress, overall)

    def _start(self, cell: Cell, progress: Progress) -> _Child:
        argv = [
            *cells.argv(self.experiment, self.store),
            *("--cell", cell.id, "--device", self.device),
            *("--settings", digest(self.experiment.settings(cell))),
            # the process of a harness that was killed may still be saving
            *("--wait", f"{GRACE_SECONDS:g}"),
        ]
        folder = self.store.run(cell.id)
        task = progress.add_task(f"  {cell.id}", start=False, total=1.0, visible=False, note="")
        return _Child(folder, self.backend.start(argv, folder), task)

    def _look_after(self, child: _Child, progress: Progress) -> None:
        folder, name = child.folder, child.folder.id
        for sentence in child.job.news():
            self._say(folder, sentence)
        place = child.job.place()
        if place is not None:
            if child.started is None:  # until now it waited for its turn
                child.started = time.perf_counter()
                progress.start_task(child.task)
            share, note = folder.progress()
            self._shares[name] = share
            note = f"{note} on {place}" if place else note
            progress.update(child.task, completed=share, note=note, visible=True)
        if child.job.poll() is not None:
            self._children.remove(child)
            progress.remove_task(child.task)
            self._shares[name] = 1.0
            self._report(child)

    def _show(self, progress: Progress, overall: TaskID) -> None:
        """Update the bar of all runs together."""
        waiting = len(self._queue) + sum(child.job.place() is None for child in self._children)
        progress.update(
            overall,
            description=f"all {len(self._units)} runs",
            total=sum(self._units.values()),
            completed=sum(share * self._units[name] for name, share in self._shares.items()),
            note=f"{waiting} wait" if waiting else "",
        )

    def _report(self, child: _Child) -> None:
        folder, code, log = child.folder, child.job.poll(), child.job.log
        if code != 0 or not folder.is_complete():
            self._outcome.failed[folder.id] = log
            how = f"failed with exit code {code}"
            if code is not None and code < 0:
                how = f"was killed by signal {-code}, perhaps out of memory"
            self._say(folder, f"{how}, see {log}\n{_tail(log)}", "red")
            return
        seconds = 0.0 if child.started is None else time.perf_counter() - child.started
        try:
            verdict = self.experiment.verdict(folder)
            set_aside = folder.meta()["training"].get("set_aside", [])
        except (BenchmarkError, KeyError) as error:  # deleted or damaged: the others go on
            self._outcome.failed[folder.id] = log
            self._say(folder, str(error), "red")
            return
        self._outcome.trained.append(folder.id)
        self._say(folder, f"done in {duration(seconds)}{verdict}")
        for name in set_aside:
            kept = folder.checkpoint / name
            self._say(folder, f"a checkpoint could not be read and is kept as {kept}", "yellow")

    def _say(self, folder: RunFolder, text: str, style: str | None = None) -> None:
        self.console.print(f"{folder.id}: {text}", style=style)

    def _stop(self) -> None:
        for child in self._children:
            child.job.stop()
        deadline = time.perf_counter() + GRACE_SECONDS
        for child in self._children:
            child.job.wait(deadline - time.perf_counter())
        self._children.clear()


def bar(console: Console, *more: ProgressColumn) -> Progress:
    """The progress display of all that runs; ``more`` columns stand at its end."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
    return Progress(*columns, Remaining(), *more, console=console, refresh_per_second=PER_SECOND)


@contextmanager
def shown(folder: RunFolder, console: Console) -> Iterator[None]:
    """A bar of a run in this process."""
    progress = bar(console, TextColumn("{task.fields[note]}"))
    task = progress.add_task(folder.id, total=1.0, note="")

    def look() -> RenderableType:
        done, note = folder.progress()
        progress.update(task, completed=done, note=note)
        return progress.get_renderable()

    with Live(console=console, refresh_per_second=PER_SECOND, get_renderable=look):
        yield


def _tail(log: Path, lines: int = 8) -> str:
    try:
        return "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:])
    except OSError:
        return ""
