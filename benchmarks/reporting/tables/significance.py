"""The table of comparisons, which the paper has not."""

from __future__ import annotations

import math

from benchmarks.protocol.plan import LEARNERS
from benchmarks.reporting.compared import Comparison, comparisons
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import AS_TRAINED, Row
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.table import Table, TableCell


def signed(number: float, digits: int = 1) -> str:
    """The number with its sign, or a dash."""
    return "-" if math.isnan(number) else f"{number:+.{digits}f}"


def difference(value: Value) -> str:
    """``+3.1 [1.0, 5.2]``: a difference in points with its interval."""
    interval = value.interval_text(1)
    return signed(value.mean) + ("" if interval == "-" else f" {interval}")


def p_text(value: float) -> str:
    """A p, or a dash."""
    return "-" if math.isnan(value) else "< 0.001" if value < 0.001 else f"{value:.2g}"


def acting(row: Row) -> str:
    """A row's way of acting, in words."""
    if row.level != AS_TRAINED:
        return "greedily"
    return "as trained" if row.method in LEARNERS else "5 % random moves"


def significance(results: Results) -> Table:
    """Table "significance": every comparison that a sentence rests on, by question."""
    header = ["Question", "Method", "Against", "Difference (points)", "p", "p (Holm)", "Seeds"]
    made = [_row(each) for each in comparisons(results)]
    notes = [
        "Success rates, one difference per seed on the same starts (of the geometries: on their "
        "own): mean with Student's 95 % interval, two-sided paired t-test, Holm within a question.",
    ]
    return Table("significance", "Comparisons", header, made, notes, left=(0, 1, 2))


def _row(each: Comparison) -> list[TableCell]:
    ours, theirs = (acting(row) for row in (each.ours, each.theirs))
    return [
        each.question, f"{each.name}, {ours}", f"{each.theirs.name}, {theirs}",
        difference(each.difference), p_text(each.p), p_text(each.p_holm), str(each.difference.n),
    ]  # fmt: skip
