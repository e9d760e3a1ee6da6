"""Costs of runs: seconds per unit of work, as measured in the stored runs, and what is left."""

import heapq
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.table import Column, Table

from benchmarks.errors import BenchmarkError
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.store import Store

GUESSED_RATE: Final = 1.5e-3  # seconds per unit of work, where nothing was measured yet
STARTING: Final = 8.0  # seconds of each process before its work: Python, torch, compiled kernels
Kind = tuple[str, ...]
Measured = list[tuple[Kind, float, int]]  # kind of a run, its seconds, its units of work


def measure(experiment: Experiment, stores: Iterable[Store]) -> Measured:
    """The complete runs, without those that this version cannot read."""
    result: Measured = []
    for run in (run for store in stores for run in store.completed()):
        with suppress(BenchmarkError, AttributeError, KeyError, TypeError, ValueError):
            config = run.config()
            result.append((experiment.kind(config), run.seconds(), experiment.units(config)))
    return result


def rate(kind: Kind, measured: Measured) -> float | None:
    """Seconds per unit of work of the nearest runs; None if there are none of the kind."""
    for length in range(len(kind), 0, -1):
        near = [(took, work) for other, took, work in measured if other[:length] == kind[:length]]
        if near:
            return sum(took for took, _ in near) / sum(work for _, work in near)
    return None


@dataclass(frozen=True)
class Cost:
    """A cell, how far it is, and what it cost or will cost."""

    id: str
    complete: bool
    share: float
    seconds: float  # measured if complete, else estimated to its end
    guessed: bool

    @property
    def state(self) -> str:
        if self.complete:
            return "complete"
        return f"{100 * self.share:.0f} %" if self.share else "missing"


def costs(experiment: Experiment, store: Store, others: Sequence[Store] = ()) -> list[Cost]:
    """Each cell's state and cost; ``others`` are used where the store has no run of the kind."""
    own = measure(experiment, [store])
    elsewhere = cache(lambda: measure(experiment, others))
    result = []
    for cell in experiment.cells:
        folder, config = store.run(cell.id), experiment.settings(cell)
        folder.check_config(config)
        if folder.is_complete():
            result.append(Cost(cell.id, True, 1.0, folder.seconds(), False))
            continue
        kind = experiment.kind(config)
        known = rate(kind, own) or rate(kind, elsewhere())
        share = folder.progress()[0]
        left = (1.0 - share) * experiment.units(config)
        seconds = STARTING + left * (GUESSED_RATE if known is None else known)
        result.append(Cost(cell.id, False, share, seconds, known is None))
    return result


def wall_seconds(result: Sequence[Cost], jobs: int) -> float:
    """Time until all cells are complete with ``jobs`` processes, each taking the next one."""
    free = [0.0] * jobs
    for cost in result:
        if not cost.complete:
            heapq.heapreplace(free, free[0] + cost.seconds)
    return max(free)


def print_plan(experiment: Experiment, results: Path, jobs: int, console: Console) -> None:
    """Print the cells of an experiment, whether they are complete, and what they cost."""
    place = results / experiment.place
    store = Store(place, experiment.name)
    if store.folder.is_dir() and any(store.folder.iterdir()):
        store = experiment.open_store(results)
    others = [
        Store(place, path.parent.name)
        for path in sorted(place.glob("*/store.json"))
        if path.parent != store.folder
    ]
    result = costs(experiment, store, others)
    name = Column("cell", no_wrap=True, min_width=max(len(cost.id) for cost in result))
    table = Table(name, "state", Column("took", no_wrap=True), Column("left", no_wrap=True))
    for cost in result:
        times = (duration(cost.seconds), "") if cost.complete else ("", duration(cost.seconds))
        table.add_row(cost.id, cost.state, *times)
    console.print(table)
    todo = [cost for cost in result if not cost.complete]
    console.print(
        f"{len(result)} cells of preset '{experiment.name}' in {store.folder}, {len(todo)} to run"
    )
    if not todo:
        return
    alone = duration(sum(cost.seconds for cost in todo))
    text = f"About {alone} of one core left, {duration(wall_seconds(result, jobs))} with "
    text += f"{jobs} process{'es' if jobs > 1 else ''}"
    if guessed := sum(cost.guessed for cost in todo):
        text += f"; a guess for {guessed} cells of a kind that never ran here"
    console.print(text)


def duration(seconds: float) -> str:
    """Seconds as a person says them: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    if seconds < 172_800.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 86_400.0:.1f} days"
