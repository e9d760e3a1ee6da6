"""Tables, figures, README and verify, from a fabricated store whose numbers are known."""

import csv
import dataclasses
import io
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.paper_values import ABLATION
from benchmarks.protocol.plan import CONTROLS, Cell
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.compared import Question, comparisons
from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.results import Level, Result, Results
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.beyond import build_tables, team
from benchmarks.reporting.tables.table import FLAG, Number, Table, printed_range
from benchmarks.reporting.verify import check_tables
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks import fabricated_store
from tests.benchmarks.fabricated_store import write_tables
from tests.benchmarks.smoke import smoke_file

WIDEST = 7  # columns of a table


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Preset paper, whose methods also explore: each solves one episode more so."""
    return fabricated_store.make_store(tmp_path_factory.mktemp("full"), [0, 1, 2], "paper")


def tables_of(store: Store) -> dict[str, Table]:
    return {table.name: table for table in build_tables(Results(store))}


@pytest.fixture(scope="module")
def tables(full: Store) -> dict[str, Table]:
    return tables_of(full)


# 9, 8 and 7 of 10 greedily, one more each as trained; the planner has one way of acting
@pytest.mark.parametrize(
    ("name", "row", "first", "cells"),
    [
        ("performance", "Success rate (%)", 1,
         ["55 ± 4", "40.0 ± 10.0", "68 ± 5", "60.0 ± 10.0", "95 ± 2", "90.0 ± 10.0"]),
        ("performance", "Success rate, greedily (%)", 1,
         ["-", "40.0 ± 10.0", "-", "50.0 ± 10.0", "-", "80.0 ± 10.0"]),
        ("performance", "Avg. completion time (s)", -2, ["7.1 ± 0.5", "5.00 ± 0.00 †"]),
        ("controls", "Success rate (%)", 1,
         ["80.0 ± 10.0", "90.0 ± 10.0", "80.0 ± 10.0", "90.0 ± 10.0"]),
        ("controls", "Success rate, greedily (%)", 3, ["70.0 ± 10.0"]),
        ("leaderboard", "Exact optimum", 0, ["-"]),
        ("leaderboard", "Rainbow DQN", 2,
         ["paper's", "none", "80.0 ± 10.0", "90.0 ± 10.0"]),
        ("leaderboard", "Masked DQN", 4, ["70.0 ± 10.0", "80.0 ± 10.0"]),
        ("ablation", "Full Rainbow", 1, ["95 ± 2", "90.0 ± 10.0", "80.0 ± 10.0"]),
        # one episode of ten fewer on each seed: no spread between seeds, no test
        ("ablation", "- Dueling head", 2,
         ["80.0 ± 10.0", "70.0 ± 10.0", "-10.0 [-10.0, -10.0]", "-", "3"]),
        ("geometry", "Env. steps to 75 % success (1e5)", 1,
         ["11.2 ± 1.1", "0.30 ± 0.00 (1 of 3 never)"]),
        ("geometry", "Final success rate (%)", 1,
         ["82 ± 4", "90.0 ± 10.0", "95 ± 2", "90.0 ± 10.0"]),
        ("geometry", "Exact optimum (%)", 2, ["90.0 ± 10.0"]),
    ],
)  # fmt: skip
def test_a_row_says_what_the_runs_did(
    name: str, row: str, first: int, cells: list[str], tables: dict[str, Table]
) -> None:
    label = 1 if name == "leaderboard" else 0
    (cells_of_row,) = (each for each in tables[name].texts() if each[label] == row)
    assert cells_of_row[first:][: len(cells)] == cells


def test_tables_have_the_papers_rows_and_columns(full: Store, tables: dict[str, Table]) -> None:
    assert "team" not in tables
    assert all(len(table.header) <= WIDEST for table in tables.values())
    performance, controls = tables["performance"], tables["controls"]
    assert performance.header == [
        "Metric", "RRT-Connect, paper", "Ours", "Vanilla DQN, paper", "Ours", "Rainbow DQN, paper",
        "Ours",
    ]  # fmt: skip
    assert "As trained: Vanilla DQN; Rainbow DQN." in performance.notes
    assert any("precision 18" in note for note in performance.notes)
    # under the same masks, acting alike
    assert controls.header[1:] == [
        "Masked DQN", "MaskablePPO", "Best script: Two-move lookahead", "Exact optimum",
    ]  # fmt: skip
    assert any("5 % random moves" in note for note in controls.notes)
    names = [row[0] for row in tables["ablation"].rows]
    assert names == [*(labels.ABLATIONS[key] for key in ABLATION), labels.ABLATIONS["none"]]
    robust = tables["robustness"]
    rows = {row[0]: dict(zip(robust.header, row, strict=True)) for row in robust.texts()}
    assert list(rows) == ["0", "0.01", "0.02", "0.04"]
    assert rows["0.01"]["Rainbow DQN, paper"] == "88 ± 3"
    assert rows["0.01"]["Rainbow DQN"] == "70.0 ± 10.0"
    columns = zip(robust.header, *robust.rows, strict=True)
    held = [name for name, *cells in columns if any(getattr(c, "paper", "") for c in cells)]
    assert held == ["Rainbow DQN"]  # the paper's noise is Rainbow's, and no other method's
    # another machine has scripts of its own, and none here
    row = Results(full).group("rainbow", "repaired").as_trained()
    machine = {**(row.settings or {}), "sim_to_real": {"base_position_error": 0.005}}
    assert Results(full).control_of(row) is not None
    assert Results(full).control_of(dataclasses.replace(row, settings=machine)) is None
    # a collision that ends the episode has scripts of its own
    results = Results(full)
    for track in ("repaired", "terminal"):
        control: Any = results.control_of(results.group("rainbow", track))
        assert control.track == track


def test_the_uncertain_machine_has_a_table_of_its_own(tmp_path: Path) -> None:
    built = tables_of(fabricated_store.make_store(tmp_path, [0], "cut"))
    assert all(len(table.header) <= WIDEST for table in built.values())
    table, board = built["uncertain"], built["leaderboard"]
    row = next(row for row in table.texts() if row[0] == "Rainbow DQN, uncertain")
    assert row[2] == "64 configurations, refused moves"
    shown = dict(zip(table.header, row, strict=True))
    assert shown["Success (%)"] == shown["Success (%) at 8 mm"] == "90.0"
    assert shown["Success (%) at 0 mm"] == "100.0"
    assert [row[0] for row in table.texts()][-1] == "Exact optimum, uncertain"
    assert "up to 3 mm" in " ".join(table.notes)
    assert not any("uncertain" in row[1] for row in board.texts())


def test_what_a_run_was_run_with_counts_not_what_another_of_its_track_was(tmp_path: Path) -> None:
    def change(run: str, old: str, new: str) -> Results:
        path = store.run(run).path / "config.yaml"
        text = path.read_text("utf-8")
        assert old in text
        path.write_text(text.replace(old, new), "utf-8")
        return Results(store)

    store = fabricated_store.make_store(tmp_path, [0], "cut")
    before = Results(store)
    for name in [*CONTROLS]:
        after = change(f"{name}-optimized-safe-s0", "mask_visited: 0", "mask_visited: 7")
        assert before.group(name, "safe").knows.memory != "7 configurations"
        assert after.group(name, "safe").knows.memory == "7 configurations"
    row = before.group("rainbow", "safe")
    assert before.control_of(row) is not None
    assert after.control_of(row) is None
    row = before.group("rainbow", "uncertain")
    assert before.best_script(row) is not None
    assert [each.method for each in before.references("uncertain")][-1] == "optimum"
    own = "base_position_error: 0.003"
    after = change("rainbow-optimized-uncertain-s0", own, "base_position_error: 0.006")
    row = after.group("rainbow", "uncertain")
    assert after.best_script(row) is None
    assert "optimum" not in [each.method for each in after.references("uncertain")]


def test_each_comparison_has_the_p_of_its_own_differences(full: Store, tmp_path: Path) -> None:
    """Two removals of different spread: neither takes the other's p; both are corrected."""
    shutil.copytree(full.folder, tmp_path / "paper")
    full = Store.open(tmp_path, "paper")
    spread = {"no_dueling": (3, 2, 4), "no_double_q": (1, 5, 0)}
    for ablation, losses in spread.items():
        for seed, lost in enumerate(losses):
            run = full.run(f"rainbow-{ablation}-optimized-repaired-s{seed}")
            rows = run.rows("episodes")
            rows.loc[rows.index[rows["acting"] == "exploring"][:lost], "success"] = 0
            rows.to_csv(run.path / "episodes.csv", index=False)
    compared = [c for c in comparisons(Results(full)) if c.question == Question.ABLATION]
    dueling, double_q = (next(c for c in compared if c.ours.ablation == name) for name in spread)
    for one, losses in zip((dueling, double_q), spread.values(), strict=True):
        differences = [-10.0 * (lost + 1) for lost in losses]  # one more is lost without it
        assert one.difference.mean == pytest.approx(np.mean(differences))
        assert one.p == pytest.approx(scipy.stats.ttest_1samp(differences, 0.0).pvalue)
    # the others' differences are all equal, have no p and do not count
    assert [dueling.p_holm, double_q.p_holm] == pytest.approx([2 * dueling.p, double_q.p])
    assert dueling.name == "- Dueling head"
    table = tables_of(full)["significance"]
    assert any(row[1] == "- Dueling head, as trained" for row in table.texts())


def test_the_tables_of_tasks_have_a_row_for_each(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "difficulty")
    (table,) = build_tables(Results(store))
    assert any(
        "design stage changes the optimum's points: as stated +0.0," in n for n in table.notes
    )
    (picture,) = pictures(Results(store))
    assert picture.write(tmp_path).stat().st_size > 10_000
    assert any("x 10 validation episodes" in note for note in table.notes)
    rows = {row[0]: row[1:] for row in table.texts()}
    # scripts solve one episode more with random moves; no row of a geometry that was not asked for
    assert rows["tolerance 5 mm"] == ["100.0", "100.0", "50.0", "80.0", "90.0", "100.0"]
    assert rows["step 5 mm"][:3] == ["-", "-", "50.0"]
    assert len(rows) == len(load_preset("difficulty").tracks)


def test_tables_are_written_in_three_forms_that_agree_and_repeat(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0, 1])
    paths = write_tables(store)
    assert {path.suffix for path in paths} == {".csv", ".md", ".tex"}
    first = {path: path.read_bytes() for path in paths}
    write_tables(store)
    assert {path: path.read_bytes() for path in paths} == first
    text = (store.tables / "ablation.tex").read_text(encoding="utf-8")
    assert r"\toprule" in text
    assert r"\usepackage{booktabs}" in text
    assert r"85.0 $\pm$ 7.1" in text
    full = next(csv.DictReader(io.StringIO((store.tables / "ablation.csv").read_text("utf-8"))))
    assert float(full["Greedily (%) | mean"]) == pytest.approx(85.0)
    assert float(full["Greedily (%) | std"]) == pytest.approx(7.071068)
    assert full["Greedily (%) | n"] == "2"


def test_a_preset_of_ones_own_has_the_tables_that_it_fills(tmp_path: Path) -> None:
    """No table of removals without one; the headline's track is the one that there is."""
    there = {("rrt_connect", ""), ("optimum", "")}
    between: list[str] = []
    for learner, title in (("dqn", "Vanilla DQN, safe"), ("rainbow", "Rainbow DQN, safe")):
        there.add((learner, "safe"))
        between.insert(0, title)  # Rainbow solves more

        def keep(cell: Cell) -> bool:
            place = (cell.ablation, cell.geometry)
            return (cell.method, cell.track) in there and place == ("full", "optimized")

        fabricated_store.make_store(tmp_path, [0], "cut", keep).folder.rename(tmp_path / learner)
        built = tables_of(Store.open(tmp_path, learner))
        assert built["performance"].title == "Performance, safe"
        assert built.keys() & {"ablation", "geometry", "design", "uncertain"} == set()
        ranked = [row[1] for row in built["leaderboard"].texts()]
        assert ranked == ["Exact optimum", *between, "RRT-Connect"]
    assert "leaderboard" in Insertion(str(smoke_file(tmp_path, "own"))).printed
    assert "leaderboard" not in Insertion("smoke").printed


def test_runs_of_other_settings_are_in_no_table(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0, 1])
    path = store.run("rainbow-optimized-safe-s1").path / "config.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("gamma: 0.93", "gamma: 0.99"), encoding="utf-8")
    with pytest.raises(BenchmarkError, match=r"s0 and .*s1 differ .*gamma: 0.93 -> 0.99\)"):
        Results(store)


def test_markup_of_tables_is_escaped() -> None:
    flagged = Number(Value(76.0, 0.5, 3, low=66.0, high=83.0), 1, paper="95 ± 2")
    table = Table("t", "50 % & more", ["a|b", "x_1"], [["p < 0.01", flagged]], ["100 %"])
    assert r"a\|b" in table.markdown()
    assert r"50 \% \& more" in table.latex()
    assert r"x\_1" in table.latex()
    assert "p $<$ 0.01 & 76.0 $\\pm$ 0.5 $^\\dagger$" in table.latex()
    assert table.texts() == [["p < 0.01", f"76.0 ± 0.5 {FLAG}"]]
    with pytest.raises(ValueError, match="does not fit"):
        Table("t", "t", ["a"], [["1", "2"]])


def test_a_partly_finished_preset_shows_what_is_missing(tmp_path: Path) -> None:
    def keep(cell: Cell) -> bool:
        if cell.method == "dqn" and cell.seed > 1:
            return False
        return cell.track in ("", "safe") and cell.ablation == "full" and cell.method != "greedy"

    store = fabricated_store.make_store(tmp_path, range(5), "cut", keep)
    built = tables_of(store)
    table = built["performance"]
    rows = {row[0]: row[1:] for row in table.texts()}
    assert rows["Success rate (%)"][3] == "55.0 ± 7.1"
    assert rows["Success rate (%)"][5] == "70.0 ± 15.8 †"
    (note,) = (note for note in table.notes if note.startswith("Not complete"))
    assert "Vanilla DQN, safe 2 of 5 seeds" in note
    assert "Rainbow DQN, safe" not in note
    assert built["controls"].header[1] == "Masked DQN"  # none of five seeds: its cells say so
    assert {row[1] for row in built["controls"].texts()} == {"missing"}
    assert note in built["leaderboard"].notes
    assert "Greedy, safe" not in {row[1] for row in built["leaderboard"].texts()}
    write_tables(store)
    assert check_tables(store.tables, [*built.values()]) == []


def test_episodes_that_began_elsewhere_are_no_pairs(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0])
    path = store.run("lookahead-optimized-safe-s0").path / "episodes.csv"
    path.write_text(path.read_text("utf-8").replace("start3", "start33", 1), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="episode 3 of seed 0 began"):
        build_tables(Results(store))


@given(st.floats(-500, 500), st.integers(0, 3))
def test_every_number_is_in_the_range_of_its_own_print(number: float, digits: int) -> None:
    printed: Any = printed_range(f"{number:.{digits}f}")
    assert printed[0] - 1e-9 <= number <= printed[1] + 1e-9


@given(st.floats(-9, 9), st.floats(0, 5), st.floats(-9, 9))
def test_outside_means_that_no_rounding_reconciles(low: float, width: float, paper: float) -> None:
    text = f"{paper:.1f}"
    value = Value(low, low=low, high=low + width)
    candidates = [float(text) + 0.05 * k / 50 for k in range(-50, 51)]
    if Number(value, paper=text).flagged:
        assert not any(low + 1e-6 < x < low + width - 1e-6 for x in candidates)
    elif width > 0.01:
        assert any(low - 1e-9 <= x <= low + width + 1e-9 for x in candidates)
    assert not Number(Value(paper + 100.0), paper=text).flagged  # no interval, no verdict


def test_flags_follow_students_interval_over_seeds(full: Store, tables: dict[str, Table]) -> None:
    results = Results(full)
    value = results.group("rainbow", "repaired").success()
    assert [value.mean, value.std, value.n] == pytest.approx([80.0, 10.0, 3])
    # t of 2 degrees of freedom: 4.303 times 10 / sqrt 3
    assert [value.low, value.high] == pytest.approx([55.16, 104.84], abs=0.01)
    # moves count only on starts that both solved
    excess = results.group("dqn", "repaired").excess(results.group("optimum"))
    assert excess.mean == pytest.approx(25.0)
    planner: Any = tables["performance"].rows[0][2]
    # 50, 40 and 30 %, whose interval is [15.2, 64.8], which holds the paper's 55
    assert planner.value.high == pytest.approx(64.84, abs=0.01)
    assert not planner.flagged
    steps: Any = tables["geometry"].rows[0][4]
    # 0.3, 0.3 and never within its steps: more than that cannot be excluded
    assert steps.value.high == math.inf
    assert not steps.flagged


def test_a_budget_below_the_papers_number_proves_nothing(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [2])  # solves 7 of 10: never at 75 %
    cell: Any = tables_of(store)["geometry"].rows[0][4]
    assert cell.text() == "not reached"
    assert not cell.flagged  # the quick preset has fewer steps than the paper needs
    assert Number(cell.value, paper=f"{cell.value.low / 2:.2f}").flagged


ROWS = pd.DataFrame({
    "episode": [0, 1, 2, 3],
    "noise": [0.0, 0.01, 0.0, 0.0],
    "acting": ["greedy", np.nan, "exploring", "greedy"],
    "error": [3.0, 3.0, 3.0, 8.0],
})  # fmt: skip
MACHINE = {"sim_to_real": {"base_position_error": 0.003}}


@pytest.mark.parametrize(
    ("columns", "track", "level", "episodes"),
    [
        (["noise", "acting", "error"], MACHINE, Level(), [0]),
        (["noise", "acting", "error"], MACHINE, Level(error=8.0), [3]),
        (["noise", "acting"], {}, Level(), [0, 3]),
        (["noise", "acting"], {}, Level(acting="exploring"), [2]),
        (["noise", "acting"], {}, Level(noise=0.01), [1]),
        (["noise"], {}, Level(), [0, 2, 3]),
        (["noise"], {}, Level(noise=0.01), [1]),
        (["noise"], {}, Level(noise=0.02), []),
    ],
)
def test_a_level_has_the_rows_that_were_played_at_it(
    columns: list[str], track: dict[str, Any], level: Level, episodes: list[int]
) -> None:
    result = Result({"track": track}, RunFolder(Path("nowhere")), ROWS[["episode", *columns]])
    assert result.test(level)["episode"].tolist() == episodes


def test_rows_of_older_runs_under_other_masks_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("cell: {seed: 4}\ntrack: {}\n", encoding="utf-8")
    (tmp_path / "meta.json").write_text('{"schema": 1}', encoding="utf-8")
    every: Any = {"reset_seed": 1, "start": "s", "success": 1}  # columns of any run
    rows = ROWS.assign(masks=["own", np.nan, "paper", "own"], **every)
    rows.to_csv(tmp_path / "episodes.csv", index=False)
    result = Result.read(RunFolder(tmp_path))
    assert result.seed == 4
    assert result.episodes["episode"].tolist() == [0, 1, 3]


OVER = "Ticks over the optimum at once (%)"


def test_teams_have_a_row_for_each_form_and_a_table_of_their_own(tmp_path: Path) -> None:
    results = Results(fabricated_store.make_store(tmp_path, [0, 1], "team"))
    (table,) = team(results)
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
    (cost,) = (note for note in table.notes if note.startswith("Full Rainbow, what"))
    assert "central Rainbow has 85.0 %" in cost
    assert cost.count("changes that by +0.0 points [0.0, 0.0]") == 2
    for built in build_tables(results):
        if built.name != "team":
            assert len(built.header) <= WIDEST, built.name
            assert "VDN" not in built.markdown(), built.name
            assert "at once" not in built.markdown(), built.name
    assert [picture.name for picture in pictures(results)] == ["team_success"]
