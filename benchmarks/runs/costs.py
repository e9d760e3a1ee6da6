"""What runs cost: seconds per unit of work, as measured in the stored runs, and what is left."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell, expand, settings, units_of
from benchmarks.protocol.presets import Preset
from benchmarks.runs.store import RunFolder, Store

GUESSED_RATE: Final = 1.5e-3  # seconds per unit of work, where nothing was measured yet

Key = tuple[str, ...]


class Rates:
    """Seconds per unit of work, from complete runs; the nearest kind of run counts.

    Args:
        runs: complete runs.
    """

    def __init__(self, runs: Iterable[RunFolder]) -> None:
        self._totals: dict[Key, tuple[float, int]] = {}
        for run in runs:
            config = run.config()
            for key in _keys(config):
                seconds, units = self._totals.get(key, (0.0, 0))
                wall = float(run.meta()["wall_seconds"])
                self._totals[key] = seconds + wall, units + units_of(config)

    def rate(self, config: dict[str, Any]) -> float | None:
        """Seconds per unit of work of a run with these settings; None if none like it ran."""
        for key in _keys(config):
            if key in self._totals:
                seconds, units = self._totals[key]
                return seconds / units
        return None


def _keys(config: dict[str, Any]) -> Iterator[Key]:
    """Kinds of run, the closest first."""
    cell = config["cell"]
    if "track" in config:
        h = config["track"]["hyperparameters"]
        work = tuple(str(h[name]) for name in ("updates_per_step", "batch_size", "net_arch"))
        yield (cell["method"], cell["ablation"], *work)
        yield (cell["method"], *work)
    else:
        yield (cell["method"], cell["geometry"])
    yield (cell["method"],)


@dataclass(frozen=True)
class Cost:
    """A cell, how far it is, and what it cost or will cost."""

    cell: Cell
    complete: bool
    share: float
    seconds: float  # measured if complete, else estimated to its end
    guessed: bool

    @property
    def state(self) -> str:
        if self.complete:
            return "complete"
        return f"{100 * self.share:.0f} %" if self.share else "missing"


def costs(preset: Preset, store: Store, others: Sequence[Store] = ()) -> list[Cost]:
    """Each cell's state and cost.

    Args:
        preset: the experiment.
        store: its results.
        others: results of other presets, asked where this one has no run of the kind yet.

    Raises:
        BenchmarkError: a stored run was made with other settings.
    """
    own = Rates(store.completed())
    found = []
    elsewhere: Rates | None = None
    for cell in expand(preset):
        folder, config = store.run(cell.id), settings(preset, cell)
        folder.check_config(config)
        if folder.is_done(cell.learns):
            found.append(Cost(cell, True, 1.0, float(folder.meta()["wall_seconds"]), False))
            continue
        share = 0.0 if folder.is_complete() else folder.progress()[0]
        rate = own.rate(config)
        if rate is None:
            if elsewhere is None:
                elsewhere = Rates(_readable(others))
            rate = elsewhere.rate(config)
        seconds = (1.0 - share) * units_of(config) * (GUESSED_RATE if rate is None else rate)
        found.append(Cost(cell, False, share, seconds, rate is None))
    return found


def _readable(stores: Sequence[Store]) -> Iterator[RunFolder]:
    """Runs of other presets, without those that this version cannot read."""
    for store in stores:
        for run in store.completed():
            try:
                run.meta(), units_of(run.config())
            except (BenchmarkError, KeyError, TypeError):
                continue
            yield run


def wall_seconds(found: Sequence[Cost], jobs: int) -> float:
    """Time until all cells are complete with ``jobs`` processes, each taking the next in the list.

    Args:
        found: what :func:`costs` says, in the order in which the cells are started.
        jobs: processes at a time.
    """
    free = [0.0] * jobs
    for cost in found:
        if not cost.complete:
            index = free.index(min(free))
            free[index] += cost.seconds
    return max(free)


def duration(seconds: float) -> str:
    """Seconds as a person says them: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    if seconds < 172_800.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 86_400.0:.1f} days"
