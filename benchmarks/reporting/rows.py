"""Which methods stand in a table or a figure, in which order, and what each of them knew."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from benchmarks.protocol import labels
from benchmarks.protocol.knowledge import Knowledge, knowledge
from benchmarks.protocol.metrics import HOLES, PAPER_MASKS, Metric
from benchmarks.protocol.plan import CONTROLS, LEARNERS, METHODS, OPTIMUM_AT_ONCE
from benchmarks.reporting.results import MAIN, Group, Level, Results, excess_over_optimum
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.table import Cell, Number

# of a policy that is tested under the paper's own masks, which remember nothing
PAPERS: Final = {"mask_singularities": False, "mask_visited": 0, "mask_refused": False}
KNOWS: Final = ("Masks", "Memory")  # headers of what stands behind a method's name


@dataclass(frozen=True)
class Row:
    """A method on a track (or none), its runs, and the level of tests that is meant."""

    method: str
    track: str
    group: Group
    settings: dict[str, Any] | None
    level: Level = MAIN

    @property
    def knows(self) -> Knowledge:
        """Its masks and memory."""
        settings = self.settings
        if settings is not None and self.level.masks == PAPER_MASKS:
            settings = settings | PAPERS
        return knowledge(self.method, settings)

    @property
    def name(self) -> str:
        """The method and its track in words."""
        name = labels.METHODS[self.method]
        if self.track:
            name += f", {labels.track(self.track)}"
        return f"{name}, the paper's masks" if self.level.masks == PAPER_MASKS else name

    @property
    def head(self) -> list[Cell]:
        """The first cells of the row: its name, masks and memory."""
        return [self.name, self.knows.masks, self.knows.memory]

    def value(self, metric: Metric) -> Value:
        """A metric of its tests."""
        return self.group.value(metric, self.level)

    def success(self) -> Value:
        """Success rate in %."""
        return self.group.success(self.level)

    def excess(self, results: Results) -> Value:
        """Moves to the first insertion above the optimum's on the same machines, in %."""
        return excess_over_optimum(self.group, optimum_of(results, self.track), self.level)

    def cell(self, value: Value, digits: int = 1, paper: str = "", suffix: str = "") -> Cell:
        """A value of the row, or the word for its absence."""
        return cell(self.group, value, digits, paper, suffix)


def cell(group: Group, value: Value, digits: int = 1, paper: str = "", suffix: str = "") -> Cell:
    """A value of a group, or the word for its absence."""
    return Number(value, digits, suffix, paper) if group.n else group.absent


def row_of(
    results: Results, method: str, track: str = "", geometry: str = "optimized",
    ablation: str = "full", level: Level = MAIN,
) -> Row:  # fmt: skip
    """The row of one configuration, whether it was run or not."""
    group = results.group(method, geometry, track, ablation)
    return Row(method, track, group, results.settings(track) if track else None, level)


def rows(
    results: Results, among: Sequence[str] = METHODS, uncertain: bool = False,
    geometry: str = "optimized",
) -> list[Row]:  # fmt: skip
    """All methods that are planned or were run, track by track, then the planners of none.

    Of robots that move one at a time: those that move at once have a table of their own.
    A learner that was also tested under the paper's own masks has a second row for it.
    """
    found, in_turn = [], [method for method in among if method != OPTIMUM_AT_ONCE]
    for track in [t for t in results.tracks() if results.uncertain(t) == uncertain]:
        for method, _ in results.methods(track, among, geometry):
            row = row_of(results, method, track, geometry)
            found.append(row)
            papers = row_of(results, method, track, geometry, level=Level(masks=PAPER_MASKS))
            if method in LEARNERS and papers.success().n:
                found.append(papers)
    if uncertain:  # a method on all tracks of the machine together, the ceiling last
        found.sort(key=lambda row: (row.method == "optimum", METHODS.index(row.method)))
    else:
        for method, _ in results.methods("", in_turn, geometry):
            found.append(row_of(results, method, "", geometry))
    return found


def complete(found: Iterable[Row]) -> list[Row]:
    """Those of which there are runs."""
    return [row for row in found if row.group.n]


def optimum_of(results: Results, track: str, geometry: str = "optimized") -> Group:
    """The ceiling of a track: the optimum that knows its machines, or the one of the nominal."""
    if not results.uncertain(track):
        return results.group("optimum", geometry)
    found = [row.group for row in rows(results, ("optimum",), uncertain=True)]
    return next((group for group in found if group.n), Group())


def best(found: Iterable[Row]) -> Row | None:
    """The complete row with the highest success rate, then with the most holes."""
    return max(
        complete(found),
        key=lambda row: (row.success().mean, row.value(HOLES).mean),
        default=None,
    )


def control_of(results: Results, row: Row, geometry: str = "optimized") -> Row | None:
    """The best control that knows just what a learner knows; None where none is complete."""
    found = rows(results, CONTROLS, results.uncertain(row.track), geometry)
    return best(control for control in found if control.knows == row.knows)


def references(results: Results, track: str) -> list[Row]:
    """What bounds the learners of a track: the best control that knows as much, and the optimum."""
    control = control_of(results, row_of(results, "rainbow", track))
    of = track if results.uncertain(track) else ""
    optimum = Row("optimum", of, optimum_of(results, track), results.settings(of))
    return complete([*([control] if control else []), optimum])
