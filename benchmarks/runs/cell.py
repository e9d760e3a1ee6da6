"""One cell of an experiment from start to end. Runs in a process of its own, or in this one."""

import json
import os
import pkgutil
import signal
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell
from benchmarks.runs import machine
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.store import RunFolder, Store, digest


class Stopped(Exception):
    """A cell without checkpoints was asked to end; its work is quickly repeated."""


class ProgressReporter:
    """Reports a cell's progress to the harness; raises :class:`Stopped` when asked to end."""

    def __init__(self, folder: RunFolder, stop_requested: StopRequested) -> None:
        self.folder, self.stop_requested = folder, stop_requested

    def __call__(self, share: float, note: str = "") -> None:
        if self.stop_requested():
            raise Stopped
        self.folder.report(share, lambda: note)


def run_cell(
    experiment: Experiment,
    cell: Cell,
    store: Store,
    stop_requested: StopRequested = lambda: False,
    wait: float = 0.0,
    device: str = "cpu",
) -> bool:
    """Run a cell to its end, or until ``stop_requested``; a complete one is left as it is.

    Returns:
        Whether the cell is complete.

    Raises:
        BenchmarkError: the cell's folder holds a run with other settings, or another process
            works on it and did not end within ``wait`` seconds.
    """
    folder = store.run(cell.id)
    work = partial(experiment.run, cell, folder, stop_requested, device)
    return run_once(folder, experiment.settings(cell), experiment.name, work, wait)


def run_once(
    folder: RunFolder,
    config: Mapping[str, Any],
    name: str,
    work: Callable[[], dict[str, Any] | None],
    wait: float = 0.0,
) -> bool:
    """:func:`run_cell` for any ``work``, which is as :meth:`Experiment.run`, under a ``name``."""
    folder.check_config(config)
    if folder.is_complete():
        return True
    with folder.lock(wait):
        if folder.is_complete():  # the process that held it has completed it
            return True
        folder.begin(config)
        begun = folder.config()  # as begun: a learner's constructor cannot change it
        made_by = machine.describe()  # now: the sources may change while the run is on
        began = time.perf_counter(), time.process_time()
        try:
            record = work()
        except Stopped:
            folder.write_progress(0.0, "stopped")
            record = None
        if record is None:
            return False
        wall, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
        training = record["training"]
        if "wall_seconds" in training:  # of a resumed run, over all of its processes
            wall = max(wall, training["wall_seconds"] + training.get("test_seconds", 0.0))
            cpu = max(cpu, training["cpu_seconds"])
        spent = {"wall_seconds": wall, "cpu_seconds": cpu}
        folder.begin(begun)  # again, as somebody may have deleted the folder meanwhile
        folder.write_meta({"cell": folder.id, "preset": name, **spent, **record, **made_by})
        folder.drop_checkpoint()
        return True


def argv(experiment: Experiment, store: Store) -> list[str]:
    """The command that opens an experiment and its store in another process; :func:`opened`."""
    kind = type(experiment)
    recipe = json.dumps(experiment.recipe)
    return ["cell", f"{kind.__module__}:{kind.__name__}", recipe, str(store.folder.resolve())]


def opened(kind: str, recipe: str, folder: Path) -> tuple[Experiment, Store]:
    """What the command of :func:`argv` opens."""
    experiment = pkgutil.resolve_name(kind)(**json.loads(recipe))
    return experiment, Store(folder.parent, folder.name)


def check_gpu(device: str | None) -> None:
    """Raise BenchmarkError if networks are to live on a GPU and there is none."""
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise BenchmarkError("--device cuda: PyTorch finds no GPU here; use --device cpu")


def run_here(
    experiment: Experiment, store: Store, cell_id: str, parent: int | None, wait: float,
    device: str, admitted: str = "",
) -> int:  # fmt: skip
    """Run one cell in this process and say how it ended; returns the command's exit code.

    ``admitted`` is the :func:`~benchmarks.runs.store.digest` of the settings that the harness
    checked.
    """
    caught: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: caught.append(number))

    def stop_requested() -> bool:
        """Whether the process was asked to end, or its ``parent``, the harness, is gone."""
        return bool(caught) or (parent is not None and os.getppid() != parent)

    cell = experiment.find(cell_id)
    if admitted and admitted != digest(experiment.settings(cell)):
        raise BenchmarkError(
            f"preset '{experiment.name}' was edited after the run began: give the command again"
        )
    check_gpu(device)
    folder = store.run(cell.id).path
    if not run_cell(experiment, cell, store, stop_requested, wait, device):
        print(f"{cell.id}: stopped, {folder} keeps what was saved; the same command resumes")
        return 130
    print(f"{cell.id}: complete, see {folder}")
    return 0
