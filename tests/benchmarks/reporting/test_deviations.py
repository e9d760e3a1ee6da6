"""Flags on cells where the paper's number lies outside our interval, and the reasons for them."""

from __future__ import annotations

import math
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.compare import outside, printed_range
from benchmarks.reporting.tables.deviations import (
    UNKNOWN,
    Reason,
    compared_cells,
    deviations,
    load_reasons,
    stale_reasons,
)
from benchmarks.reporting.tables.paper import PRINTED, build_tables
from benchmarks.reporting.tables.table import FLAG, Number, Table
from benchmarks.runs.store import Store
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
    if outside(value, text):
        assert not any(low + 1e-6 < x < low + width - 1e-6 for x in candidates)
    elif width > 0.01:
        assert inside
    assert not outside(Value(paper + 100.0), text)  # no interval, no verdict


def table(value: Value, paper: str) -> Table:
    return Table("performance", "T", ["M", "Ours"], [["Speed", Number(value, 1, paper=paper)]])


def test_the_flag_is_printed_and_collected_with_its_reason() -> None:
    flagged = table(Value(76.0, low=66.0, high=83.0), "95 ± 2")
    assert flagged.texts() == [["Speed", f"76.0 {FLAG}"]]
    assert r"76.0 $^\dagger$" in flagged.latex()
    reasons = [Reason("performance", "Sp*", ["Ours"], "a reason")]
    (row,) = deviations([flagged], "quick", reasons).texts()
    expected = [
        "performance",
        "Speed",
        "-",
        "-",
        "Ours",
        "95 ± 2",
        "76.0",
        "[66.00, 83.00]",
        "a reason",
    ]
    assert row == expected
    (row,) = deviations([flagged], "quick", []).texts()
    assert row[-1] == UNKNOWN
    elsewhere = [Reason("performance", "Sp*", ["Ours"], "a reason", ["paper"])]
    assert deviations([flagged], "quick", elsewhere).texts()[0][-1] == UNKNOWN
    assert deviations([flagged], "paper", elsewhere).texts()[0][-1] == "a reason"
    agreeing = table(Value(76.0, low=66.0, high=94.6), "95 ± 2")
    assert agreeing.texts() == [["Speed", "76.0"]]
    assert deviations([agreeing], "quick", reasons).rows == []


def test_a_reason_that_explains_nothing_is_stale() -> None:
    flagged = table(Value(76.0, low=66.0, high=83.0), "95 ± 2")
    agreeing = table(Value(94.0, low=90.0, high=98.0), "95 ± 2")
    unknown = table(Value(math.nan, n=0), "95 ± 2")
    reason = Reason("performance", "Speed", ["Ours"], "a reason")
    assert stale_reasons([flagged], "quick", [reason]) == []
    (problem,) = stale_reasons([agreeing], "quick", [reason])
    assert "take it out" in problem
    # a run that is not there says nothing
    assert stale_reasons([unknown], "quick", [reason]) == []
    (problem,) = stale_reasons([flagged], "quick", [Reason("performance", "Size", ["*"], "why")])
    assert "no such table or row" in problem
    other = Reason("performance", "Speed", ["Ours"], "a reason", ["paper"])
    assert stale_reasons([agreeing], "quick", [other]) == []


def stored_presets() -> list[str]:
    return sorted(path.parent.name for path in (ROOT / "results").glob("*/store.json"))


@pytest.mark.parametrize("preset", stored_presets())
def test_no_reason_on_record_is_stale(preset: str) -> None:
    store = Store.open(ROOT / "results", preset)
    assert stale_reasons(build_tables(store), preset) == []


@pytest.mark.parametrize("preset", ["cut"])
def test_every_flag_has_its_reason(preset: str) -> None:
    tables = build_tables(Store.open(ROOT / "results", preset))
    table = next(table for table in tables if table.name == "deviations")
    assert len(table.rows) > 10
    assert [row for row in table.texts() if row[-1] == UNKNOWN] == []


def test_flags_over_seeds_follow_the_bootstrap_interval(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0, 1, 2])
    tables = {table.name: table for table in build_tables(store)}
    cells = {
        (cell.table, cell.row, cell.column): cell.number
        for cell in compared_cells([tables[name] for name in PRINTED if name in tables])
    }
    success = cells["performance", "RRT-Connect", "Success rate (%)"]
    # 50, 40 and 30 %: the mean of resampled seeds lies in [30, 50], and the paper's 55 does not
    assert (success.value.low, success.value.high) == (30.0, 50.0)
    assert success.flagged
    time = cells["performance", "RRT-Connect", "Avg. completion time (s)"]
    assert (time.value.low, time.value.high) == (5.0, 5.0)
    steps = cells["geometry", "Rainbow DQN, safe", "Steps to 75 % success (1e5), optimized"]
    # 0.3, 0.3 and never within 1e5 steps: more than that cannot be excluded
    assert steps.value.high == math.inf
    assert not steps.flagged
    assert steps.plain() == "0.30 ± 0.00 (1 of 3 never)"
    change = cells["robustness", "Rainbow DQN, safe", "Change at 0.01 (points)"]
    assert change.plain() == "-10.0 ± 0.0"
    assert change.flagged


def test_a_budget_below_the_papers_number_proves_nothing(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [2])  # solves 7 of 10: never at 75 %
    table = next(table for table in build_tables(store) if table.name == "geometry")
    (row,) = (row for row in table.rows if row[0] == "Rainbow DQN, safe")
    cell = row[table.header.index("Steps to 75 % success (1e5), optimized")]
    assert isinstance(cell, Number)
    assert cell.text() == "not reached"
    assert not cell.flagged  # the quick preset has fewer steps than the paper needs
    assert Number(cell.value, paper=f"{cell.value.low / 2:.2f}").flagged


def test_masks_are_no_reason_where_the_masks_are_the_papers() -> None:
    reasons = [r for r in load_reasons() if "masks of this track take out" in r.reason]
    assert reasons
    for reason in reasons:
        for track in ("printed", "reward"):
            assert not fnmatchcase(f"Rainbow DQN, {labels.track(track)}", reason.row), reason


def test_a_file_of_reasons_is_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "reasons.yaml"
    path.write_text("- {table: t, row: r, columns: [c], because: x}\n", encoding="utf-8")
    with pytest.raises(BenchmarkError, match="unknown key 'because'"):
        load_reasons(path)
    path.write_text("table: t\n", encoding="utf-8")
    with pytest.raises(BenchmarkError, match="expected a list"):
        load_reasons(path)
    path.write_text("- [\n", encoding="utf-8")
    with pytest.raises(BenchmarkError, match="not valid YAML"):
        load_reasons(path)
