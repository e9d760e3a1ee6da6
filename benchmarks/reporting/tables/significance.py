"""The table of paired tests, which the paper has not."""

from __future__ import annotations

import math

from benchmarks.reporting.compared import comparisons
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import KNOWS
from benchmarks.reporting.tables.table import Cell, Table


def signed(number: float, digits: int) -> str:
    """The number with its sign, or a dash."""
    return "-" if math.isnan(number) else f"{number:+.{digits}f}"


def significance(results: Results) -> Table:
    """Every comparison that a sentence rests on, paired over the same starts."""
    header = [
        *("Method", *KNOWS, "Against", *(f"Its {name.lower()}" for name in KNOWS), "Metric"),
        *("Difference", "t", "p (Holm)", "Effect d_z", "Pairs", "p over seeds (Holm)", "Seeds"),
    ]
    found = comparisons(results)
    made: list[list[Cell]] = []
    for each in found:
        test, digits = each.test, each.metric.digits
        made.append([
            each.name, *each.ours.head[1:], *each.theirs.head, each.metric.label,
            signed(test.difference, digits), signed(test.t, 2), _p(each.p), signed(test.effect, 2),
            str(test.n), _p(each.p_seeds), str(each.seeds.n),
        ])  # fmt: skip
    notes = [
        "Two-sided paired t-tests over test episodes with the same initial state; the time to the "
        "first insertion pairs only episodes in which both inserted. Holm over all rows.",
        "p over seeds: the same test on one mean difference per seed. Episodes of a seed share one "
        "trained network, so only this one speaks of training again; it needs two seeds.",
    ]
    title = "Learners against the best control with the same masks and memory, and other pairs"
    return Table("significance", title, header, made, notes, left=(0, 1, 2, 3, 4, 5, 6))


def _p(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2g}"
