"""The comparisons behind the sentences: paired over seeds, corrected within a question."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.learners import LEARNERS
from benchmarks.reporting.results import Group, Results, complete
from benchmarks.reporting.stats import Value, holm, measured, paired_p


class Question(StrEnum):
    """What a comparison asks; p is corrected over the comparisons of one question."""

    CONTROL = "Best script"
    MASKED = "Other learners"
    ABLATION = "Components"
    GREEDILY = "Components, greedily"
    GEOMETRY = "Geometry"
    SCRIPT = "Uncertain machine"


@dataclass(frozen=True)
class Comparison:
    """Success rates of two methods: one difference per seed, in points, with Student's interval.

    ``p`` is two-sided, and ``p_holm`` corrected over the comparisons of the same question.
    """

    question: str
    ours: Group
    theirs: Group
    difference: Value
    p: float
    p_holm: float

    @property
    def name(self) -> str:
        """Our method, or its removed component; with the geometry if not the optimized one."""
        ours, name = self.ours, self.ours.name
        if ours.ablation not in labels.ALL_OR_NONE:
            name = labels.on_track(labels.ABLATIONS[ours.ablation], ours.track)
        return name if ours.geometry == "optimized" else f"{name}, {ours.geometry} geometry"


@lru_cache(maxsize=1)  # tables and sentences ask for the same ones
def comparisons(results: Results) -> list[Comparison]:
    """All comparisons of a store, each p corrected by Holm over those of its question."""
    asked: dict[str, list[tuple[Group, Group, list[float]]]] = {}
    for question, ours, theirs in _pairs(results):
        if theirs is not None and (points := differences(question, ours, theirs)):
            asked.setdefault(question, []).append((ours, theirs, points))
    result = []
    for question, pairs in asked.items():
        tests = [paired_p(points) for _, _, points in pairs]
        for (ours, theirs, points), p, p_holm in zip(pairs, tests, holm(tests), strict=True):
            value = measured(points)
            # Student's interval over few seeds may reach beyond what is possible
            value = replace(value, low=max(value.low, -100.0), high=min(value.high, 100.0))
            result.append(Comparison(question, ours, theirs, value, p, p_holm))
    return result


def find(compared: list[Comparison], question: str, ours: Group) -> Comparison | None:
    """The comparison of a method, if its runs are there."""
    return next((c for c in compared if (c.question, c.ours) == (question, ours)), None)


def differences(question: str, ours: Group, theirs: Group) -> list[float]:
    """Ours minus theirs in points, for each seed that both have, on the starts they share."""
    result = []
    for run, other, both in ours.beside(theirs):
        unequal = both[both["start"].astype(str) != both["start_other"].astype(str)]
        # either geometry has starts of its own
        if len(unequal) and question != Question.GEOMETRY:
            raise BenchmarkError(
                f"episode {unequal['episode'].iloc[0]} of seed {run.seed} began in one state in "
                f"{run.folder.path}, in another in {other.folder.path}: delete the older run and "
                "run it again"
            )
        if len(both):
            result.append(100.0 * float((both["success"] - both["success_other"]).mean()))
    return result


def _pairs(results: Results) -> Iterator[tuple[str, Group, Group | None]]:
    for row in complete(results.rows(LEARNERS)):
        for each in row.both():
            yield Question.CONTROL, each, results.control_of(each)
    track = results.scored
    full = results.group("rainbow", track)
    others = [results.group("rainbow", track, ablation="none")]
    others += [results.group(method, track) for method in LEARNERS if method != "rainbow"]
    for other in others:
        for ours, theirs in zip(full.both(), other.both(), strict=False):
            yield Question.MASKED, ours, theirs
    for ablation in labels.ABLATIONS:
        if ablation not in labels.ALL_OR_NONE:
            without = results.group("rainbow", track, ablation=ablation)
            yield Question.ABLATION, without.as_trained(), full.as_trained()
            if without.as_trained() != without:
                yield Question.GREEDILY, without, full
    initial = results.group("rainbow", track, "initial")
    yield Question.GEOMETRY, initial.as_trained(), full.as_trained()
    for row in complete(results.rows(LEARNERS, uncertain=True)):
        yield Question.SCRIPT, row, results.best_script(row)
