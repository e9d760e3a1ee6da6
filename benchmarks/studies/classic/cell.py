"""One cell from start to end, in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.runs.cell import Clock, run_once
from benchmarks.runs.store import Store
from benchmarks.studies.classic.plan import CLIFF, Cell, settings
from benchmarks.studies.classic.presets import Preset


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
    from benchmarks.studies.classic.cliff import run_cliff
    from benchmarks.studies.classic.train import run_learner

    folder = store.run(cell.id)

    def work() -> dict[str, Any] | None:
        clock = Clock()
        run = run_cliff if cell.kind == CLIFF else run_learner
        training = run(preset, cell, folder, stop_requested)
        if training is None:
            return None
        wall, cpu = clock.read()
        spent = {"wall_seconds": wall, "cpu_seconds": cpu}
        return {"cell": cell.id, "preset": preset.name, "training": {**spent, **training}}

    return run_once(folder, settings(preset, cell), work, learns=False, wait=wait)
