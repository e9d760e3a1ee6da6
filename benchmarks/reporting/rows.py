"""Which methods stand in a table or a figure, in which order, and what each of them knew."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from benchmarks.protocol import labels
from benchmarks.protocol.knowledge import Knowledge, knowledge
from benchmarks.protocol.metrics import EXPLORING, HOLES, Metric
from benchmarks.protocol.plan import CONTROLS, LEARNERS, METHODS, OPTIMUM_AT_ONCE
from benchmarks.reporting.results import MAIN, Group, Level, Results, excess_over_optimum
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.table import Number, TableCell

KNOWS: Final = ("Masks", "Memory")  # headers of what stands behind a method's name
AS_TRAINED: Final = Level(acting=EXPLORING)
SCORED: Final = ("repaired", "safe")  # tracks of the headline; the first that a store has


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
        return knowledge(self.method, self.settings)

    @property
    def name(self) -> str:
        """The method and its track in words; all six components off is a method of its own."""
        masked = self.group.n and self.group.runs[0].config["cell"]["ablation"] == "none"
        name = labels.MASKED_DQN if masked else labels.METHODS[self.method]
        return f"{name}, {labels.track(self.track)}" if self.track else name

    @property
    def acting_name(self) -> str:
        """The name, and of a script that makes random moves this."""
        explores = self.level == AS_TRAINED and self.method in CONTROLS
        return f"{self.name}, 5 % random moves" if explores else self.name

    @property
    def head(self) -> list[TableCell]:
        """The first cells of the row: its name, masks and memory."""
        return [self.name, self.knows.masks, self.knows.memory]

    def as_trained(self) -> Row:
        """The same runs as their method explores, where they were tested so; else the row."""
        other = replace(self, level=AS_TRAINED)
        return other if other.success().n else self

    def value(self, metric: Metric) -> Value:
        """A metric of its tests."""
        return self.group.value(metric, self.level)

    def success(self) -> Value:
        """Success rate in %."""
        return self.group.success(self.level)

    def excess(self, results: Results) -> Value:
        """Moves to the first insertion above the optimum's on the same machines, in %."""
        return excess_over_optimum(self.group, optimum_of(results, self.track), self.level)

    def cell(self, value: Value, digits: int = 1, paper: str = "", suffix: str = "") -> TableCell:
        """A value of the row, or the word for its absence."""
        return Number(value, digits, suffix, paper) if self.group.n else self.group.absent

    def tested(self, level: Level) -> TableCell:
        """The success rate at another level, or a dash if it was not tested there."""
        value = self.group.success(level)
        return self.cell(value) if value.n or not self.group.n else "-"


def scored(results: Results) -> str:
    """The track of a store's headline."""
    result = [track for track in SCORED if row_of(results, "rainbow", track).group.known]
    return result[0] if result else SCORED[0]


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
    """
    result, in_turn = [], [method for method in among if method != OPTIMUM_AT_ONCE]
    for track in [t for t in results.tracks() if results.uncertain(t) == uncertain]:
        for method in among:
            result.append(row_of(results, method, track, geometry))
            if method == "rainbow":
                result.append(row_of(results, method, track, geometry, "none"))
    if uncertain:  # a method on all tracks of the machine together, the ceiling last
        result.sort(key=lambda row: (row.method == "optimum", METHODS.index(row.method)))
    else:
        result += [row_of(results, method, "", geometry) for method in in_turn]
    return [row for row in result if row.group.known]


def complete(result: Iterable[Row]) -> list[Row]:
    """Those of which there are runs."""
    return [row for row in result if row.group.n]


def optimum_of(results: Results, track: str, geometry: str = "optimized") -> Group:
    """The ceiling of a track: the optimum that knows its machines, or the one of the nominal."""
    if not results.uncertain(track):
        return results.group("optimum", geometry)
    result = [row.group for row in rows(results, ("optimum",), uncertain=True)]
    return next((group for group in result if group.n), Group())


def best(result: Iterable[Row]) -> Row | None:
    """The complete row with the highest success rate, then with the most holes."""
    return max(
        complete(result),
        key=lambda row: (row.success().mean, row.value(HOLES).mean),
        default=None,
    )


def control_of(results: Results, row: Row, geometry: str = "optimized") -> Row | None:
    """The best control with a learner's masks, memory, ending and way of acting; None if none."""
    result = rows(results, CONTROLS, results.uncertain(row.track), geometry)
    alike = [each for each in result if each.knows == row.knows and _ends(each) == _ends(row)]
    return best(each.as_trained() if row.level == AS_TRAINED else each for each in alike)


def _ends(row: Row) -> str:
    return str((row.settings or {}).get("collision", "refuse"))


def best_script(results: Results) -> Row | None:
    """Of the uncertain machine: the best method that neither learns nor knows the machine."""
    scripts = [m for m in METHODS if m not in LEARNERS and m != "optimum"]
    return best(rows(results, scripts, uncertain=True))


def references(results: Results, track: str) -> list[Row]:
    """What bounds the learners of a track: the best control that knows as much, and the optimum.

    The control acts as learners do in training, with random moves, where it was tested so.
    """
    control = control_of(results, row_of(results, "rainbow", track).as_trained())
    of = track if results.uncertain(track) else ""
    optimum = Row("optimum", of, optimum_of(results, track), results.settings(of))
    return complete([*([control] if control else []), optimum])
