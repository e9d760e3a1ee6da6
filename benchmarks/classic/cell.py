"""One cell from start to end, in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Callable

from benchmarks import machine
from benchmarks.classic.plan import CLIFF, Cell, settings
from benchmarks.classic.presets import Preset
from benchmarks.store import Store


def run_cell(
    preset: Preset,
    cell: Cell,
    store: Store,
    stop_requested: Callable[[], bool] = lambda: False,
    wait: float = 0.0,
) -> bool:
    """Run a cell to its end, or until ``stop_requested``; a complete one is left as it is.

    Args:
        preset: the experiment.
        cell: a cell of it.
        store: where its results go.
        stop_requested: asked between rounds of training.
        wait: seconds to wait for another process that works on the cell.

    Returns:
        Whether the cell is complete.

    Raises:
        BenchmarkError: the cell's folder holds a run with other settings, or another process
            works on it.
    """
    from benchmarks.classic.cliff import run_cliff
    from benchmarks.classic.train import run_learner

    folder = store.run(cell.id)
    folder.check_config(settings(preset, cell))
    if folder.is_complete():
        return True
    with folder.lock(wait):
        if folder.is_complete():  # by the process that was waited for
            return True
        folder.begin(settings(preset, cell))
        began = time.perf_counter(), time.process_time()
        work = run_cliff if cell.kind == CLIFF else run_learner
        training = work(preset, cell, folder, stop_requested)
        if training is None:
            return False
        spent = {
            "wall_seconds": time.perf_counter() - began[0],
            "cpu_seconds": time.process_time() - began[1],
        }
        folder.write_meta({
            "cell": cell.id,
            "preset": preset.name,
            "training": {**spent, **training},
            **machine.describe(),
        })  # fmt: skip
        folder.drop_checkpoint()
    return True
