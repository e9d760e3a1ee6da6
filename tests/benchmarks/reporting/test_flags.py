"""Flags on cells where the paper's number lies outside our interval."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.reporting.tables.table import FLAG, Number, Table, printed_range
from tests.benchmarks import fabricated_store

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("95 ± 2", (94.5, 95.5)),
        ("0.1 ± 0.05", (0.05, 0.15)),
        ("-7", (-7.5, -6.5)),
        ("0", (-0.5, 0.5)),
        ("-", None),
        ("", None),
    ],
)
def test_a_printed_number_stands_for_all_that_round_to_it(
    text: str, expected: tuple[float, float] | None
) -> None:
    assert printed_range(text) == expected


@given(st.floats(-500, 500), st.integers(0, 3))
def test_every_number_is_in_the_range_of_its_own_print(number: float, digits: int) -> None:
    printed = printed_range(f"{number:.{digits}f}")
    assert printed is not None
    assert printed[0] - 1e-9 <= number <= printed[1] + 1e-9


@given(st.floats(-9, 9), st.floats(0, 5), st.floats(-9, 9))
def test_outside_means_that_no_rounding_reconciles(low: float, width: float, paper: float) -> None:
    text = f"{paper:.1f}"
    value = Value(low, low=low, high=low + width)
    candidates = [float(text) + 0.05 * k / 50 for k in range(-50, 51)]
    inside = any(low - 1e-9 <= x <= low + width + 1e-9 for x in candidates)
    if Number(value, paper=text).flagged:
        assert not any(low + 1e-6 < x < low + width - 1e-6 for x in candidates)
    elif width > 0.01:
        assert inside
    assert not Number(Value(paper + 100.0), paper=text).flagged  # no interval, no verdict


def table(value: Value, paper: str) -> Table:
    return Table("performance", "T", ["M", "Ours"], [["Speed", Number(value, 1, paper=paper)]])


def test_the_flag_is_printed() -> None:
    flagged = table(Value(76.0, low=66.0, high=83.0), "95 ± 2")
    assert flagged.texts() == [["Speed", f"76.0 {FLAG}"]]
    assert r"76.0 $^\dagger$" in flagged.latex()
    agreeing = table(Value(76.0, low=66.0, high=94.6), "95 ± 2")
    assert agreeing.texts() == [["Speed", "76.0"]]


def test_flags_over_seeds_follow_students_interval(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0, 1, 2])
    tables = {table.name: table for table in build_tables(store)}
    planner = tables["performance"].rows[0][2]
    assert isinstance(planner, Number)
    # 50, 40 and 30 %, whose interval is [15.2, 64.8], which holds the paper's 55
    assert planner.value.high == pytest.approx(64.84, abs=0.01)
    assert not planner.flagged
    steps = tables["geometry"].rows[0][4]
    assert isinstance(steps, Number)
    # 0.3, 0.3 and never within its steps: more than that cannot be excluded
    assert steps.value.high == math.inf
    assert not steps.flagged
    assert steps.plain() == "0.30 ± 0.00 (1 of 3 never)"


def test_a_budget_below_the_papers_number_proves_nothing(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [2])  # solves 7 of 10: never at 75 %
    table = next(table for table in build_tables(store) if table.name == "geometry")
    cell = table.rows[0][4]
    assert isinstance(cell, Number)
    assert cell.text() == "not reached"
    assert not cell.flagged  # the quick preset has fewer steps than the paper needs
    assert Number(cell.value, paper=f"{cell.value.low / 2:.2f}").flagged
