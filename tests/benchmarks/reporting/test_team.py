"""The table of two robots: a row per form, over the optimum at once, and the answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.beyond import build_tables, team
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import Store
from tests.benchmarks import fabricated_store

OVER = "Ticks over the optimum at once (%)"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return fabricated_store.make_store(tmp_path_factory.mktemp("results"), [0, 1], "team")


@pytest.fixture(scope="module")
def table(store: Store) -> Table:
    return team(Results(store))[0]


def test_a_row_for_each_form_with_its_ticks_over_the_optimum(table: Table) -> None:
    rows = [dict(zip(table.header, row, strict=True)) for row in table.texts()]
    heads = [tuple(row[name] for name in table.header[:4]) for row in rows]
    assert len(set(heads)) == len(rows) == 2 * 4 + 2 + 2 * 4
    assert [row["Robots move"] for row in rows].count("in turn") == 2 + 1 + 1
    sights = {row["Decided by"] for row in rows if row["Method"].startswith("VDN")}
    assert sights == {"each robot, in sight", "each robot, without sight"}
    by_head = dict(zip(heads, rows, strict=True))
    optimum = by_head["Exact optimum", "-", "in turn", "one for both"]
    assert optimum[OVER] == "25.0 ± 0.0"  # 20 moves where 16 ticks do
    central = by_head["Rainbow on 49 joint moves", "Full Rainbow", "at once", "one for both"]
    assert central["Success (%)"] == "85.0 ± 7.1"
    assert central[OVER].startswith("56.2")


def test_what_decentralization_costs_is_answered_from_the_runs(table: Table) -> None:
    (cost,) = (note for note in table.notes if note.startswith("Full Rainbow, what"))
    assert "central Rainbow has 85.0 %" in cost
    assert cost.count("changes that by +0.0 points [0.0, 0.0]") == 2


def test_other_tables_are_of_robots_that_move_in_turn(store: Store) -> None:
    for built in build_tables(Results(store)):
        if built.name != "team":
            assert len(built.header) <= 7, built.name
            assert "VDN" not in built.markdown(), built.name
            assert "at once" not in built.markdown(), built.name
    names = [picture.name for picture in pictures(Results(store))]
    assert names == ["team_success"]


def test_no_other_store_has_the_table(tmp_path: Path) -> None:
    assert team(Results(fabricated_store.make_store(tmp_path, [0]))) == []
