"""Tables, figures, README and verify, from a fabricated store whose numbers are known."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

import pytest
import scipy.stats

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.paper_values import ABLATION
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.compared import ABLATION as ABLATION_QUESTION
from benchmarks.reporting.compared import comparisons
from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.results import Results
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.reporting.tables.table import Number, Table
from benchmarks.reporting.verify import check_tables
from benchmarks.runs.store import Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks import fabricated_store

MakeStore = Callable[[list[int]], Store]


def write_tables(store: Store) -> list[Path]:
    return [path for table in build_tables(store) for path in table.write(store.tables)]


def verify(store: Store) -> list[str]:
    return check_tables(store.tables, build_tables(store))


@pytest.fixture
def make_store(tmp_path: Path) -> MakeStore:
    return lambda seeds: fabricated_store.make_store(tmp_path / "results", seeds)


def find(store: Store, name: str) -> Table:
    return next(table for table in build_tables(store) if table.name == name)


def column(table: Table, header: str) -> dict[str, str]:
    index = table.header.index(header)
    return {row[0]: row[index] for row in table.texts()}


def cell(table: Table, row: str, header: str) -> str:
    return column(table, header)[row]


@pytest.fixture
def full(tmp_path: Path) -> Store:
    """Preset paper, whose methods also explore: each solves one episode more so."""
    return fabricated_store.make_store(tmp_path / "results", [0, 1, 2], "paper")


def test_performance_has_the_papers_rows_and_columns(full: Store) -> None:
    table = find(full, "performance")
    assert table.header == [
        "Metric", "RRT-Connect, paper", "Ours", "Vanilla DQN, paper", "Ours", "Rainbow DQN, paper",
        "Ours",
    ]  # fmt: skip
    rows = {row[0]: row[1:] for row in table.texts()}
    # 9, 8 and 7 of 10 greedily, one more each as trained; the planner has one way of acting
    assert rows["Success rate (%)"] == [
        "55 ± 4", "40.0 ± 10.0", "68 ± 5", "60.0 ± 10.0", "95 ± 2", "90.0 ± 10.0",
    ]  # fmt: skip
    assert rows["Success rate, greedily (%)"] == [
        "-", "40.0 ± 10.0", "-", "50.0 ± 10.0", "-", "80.0 ± 10.0",
    ]  # fmt: skip
    assert rows["Avg. completion time (s)"][-2:] == ["7.1 ± 0.5", "5.00 ± 0.00 †"]
    assert "Acting: Vanilla DQN, repaired, Rainbow DQN, repaired: as trained." in table.notes
    assert any("precision 18" in note for note in table.notes)


def test_controls_stand_under_the_same_masks_and_act_alike(full: Store) -> None:
    table = find(full, "controls")
    assert table.header[1:] == [
        "Masked DQN", "MaskablePPO", "Best script: Two-move lookahead, repaired", "Exact optimum",
    ]  # fmt: skip
    rows = {row[0]: row[1:] for row in table.texts()}
    assert rows["Success rate (%)"] == [
        "80.0 ± 10.0", "90.0 ± 10.0", "80.0 ± 10.0", "90.0 ± 10.0",
    ]  # fmt: skip
    assert rows["Success rate, greedily (%)"][2] == "70.0 ± 10.0"
    assert any("5 % random moves" in note for note in table.notes)


def test_a_collision_that_ends_the_episode_has_scripts_of_its_own(full: Store) -> None:
    results = Results(full)
    for track in ("repaired", "terminal"):
        control = results.control_of(results.group("rainbow", track))
        assert control is not None
        assert control.track == track


@pytest.mark.parametrize("preset", ["paper", "cut", "team"])
def test_no_table_is_wider_than_seven_columns_but_the_teams(preset: str, tmp_path: Path) -> None:
    for table in build_tables(fabricated_store.make_store(tmp_path, [0], preset)):
        if not table.name.startswith("team"):
            assert len(table.header) <= 7, table.name


def test_the_uncertain_machine_has_a_table_of_its_own(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "cut")
    table = find(store, "uncertain")
    row = next(row for row in table.texts() if row[0] == "Rainbow DQN, uncertain")
    assert row[2] == "64 configurations, refused moves"
    shown = dict(zip(table.header, row, strict=True))
    assert shown["Success (%)"] == shown["Success (%) at 8 mm"] == "90.0"
    assert shown["Success (%) at 0 mm"] == "100.0"
    assert [row[0] for row in table.texts()][-1] == "Exact optimum, uncertain"
    assert "up to 3 mm" in " ".join(table.notes)
    board = find(store, "leaderboard")
    assert not any("uncertain" in row[1] for row in board.texts())


def test_the_leaderboard_says_masks_memory_and_both_ways_of_acting(full: Store) -> None:
    rows = {row[1]: row for row in find(full, "leaderboard").texts()}
    assert rows["Exact optimum"][0] == "-"
    assert rows["Rainbow DQN, repaired"][2:6] == ["paper's", "none", "80.0 ± 10.0", "90.0 ± 10.0"]
    assert rows["Masked DQN, repaired"][4:6] == ["70.0 ± 10.0", "80.0 ± 10.0"]
    assert rows["Random, repaired"][5] == "-"


def test_seeds_give_mean_deviation_and_students_interval(make_store: MakeStore) -> None:
    value = Results(make_store([0, 1, 2])).group("rainbow", track="safe").success()
    assert [value.mean, value.std, value.n] == pytest.approx([80.0, 10.0, 3])
    # t of 2 degrees of freedom: 4.303 times 10 / sqrt 3
    assert [value.low, value.high] == pytest.approx([55.16, 104.84], abs=0.01)


def test_the_ablation_has_a_row_for_each_component_with_its_difference(full: Store) -> None:
    table = find(full, "ablation")
    names = [row[0] for row in table.rows]
    assert names == [*(labels.ABLATIONS[key] for key in ABLATION), labels.ABLATIONS["none"]]
    rows = {row[0]: row[1:] for row in table.texts()}
    assert rows["Full Rainbow"][:3] == ["95 ± 2", "90.0 ± 10.0", "80.0 ± 10.0"]
    # one episode of ten fewer on each seed: no spread between seeds, no test
    assert rows["- Dueling head"][1:] == [
        "80.0 ± 10.0",
        "70.0 ± 10.0",
        "-10.0 [-10.0, -10.0]",
        "-",
        "3",
    ]


def test_a_run_that_never_reached_the_threshold_says_so(full: Store) -> None:
    rows = {row[0]: row[1:] for row in find(full, "geometry").texts()}
    assert rows["Env. steps to 75 % success (1e5)"][:2] == [
        "11.2 ± 1.1",
        "0.30 ± 0.00 (1 of 3 never)",
    ]
    assert rows["Final success rate (%)"] == ["82 ± 4", "90.0 ± 10.0", "95 ± 2", "90.0 ± 10.0"]
    assert rows["Exact optimum (%)"][1] == "90.0 ± 10.0"


def test_robustness_has_a_row_for_each_level_of_noise(full: Store) -> None:
    table = find(full, "robustness")
    rows = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.texts()}
    assert list(rows) == ["0", "0.01", "0.02", "0.04"]
    assert rows["0.01"]["Rainbow DQN, paper"] == "88 ± 3"
    assert rows["0.01"]["Rainbow DQN, repaired"] == "70.0 ± 10.0"


def test_comparisons_are_corrected_within_their_question(full: Store) -> None:
    for seed, lost in ((0, 3), (1, 2), (2, 4)):  # so that a component's differences have a spread
        run = full.run(f"rainbow-no_dueling-optimized-repaired-s{seed}")
        rows = run.rows("episodes")
        rows.loc[rows.index[rows["acting"] == "exploring"][:lost], "success"] = 0
        rows.to_csv(run.path / "episodes.csv", index=False)
    found = {(c.question, c.name): c for c in comparisons(Results(full))}
    one = found[ABLATION_QUESTION, "- Dueling head, repaired"]
    differences = [-40.0, -30.0, -50.0]
    assert one.difference.mean == pytest.approx(-40.0)
    assert one.p == pytest.approx(scipy.stats.ttest_1samp(differences, 0.0).pvalue)
    assert one.p_holm == one.p  # the others' differences are all equal and have no p
    table = find(full, "significance")
    assert any(row[1] == "- Dueling head, repaired, as trained" for row in table.texts())


def test_the_tables_of_tasks_have_a_row_for_each(tmp_path: Path) -> None:
    (table,) = build_tables(fabricated_store.make_store(tmp_path, [0], "difficulty"))
    rows = {row[0]: row[1:] for row in table.texts()}
    # scripts solve one episode more with random moves; no row of a geometry that was not asked for
    assert rows["tolerance 5 mm"] == ["100.0", "100.0", "50.0", "80.0", "90.0", "100.0"]
    assert rows["step 5 mm"][:3] == ["-", "-", "50.0"]
    assert len(rows) == len(load_preset("difficulty").tracks)


def test_excess_counts_only_starts_that_both_solved(make_store: MakeStore) -> None:
    results = Results(make_store([0]))
    value = results.group("dqn", "safe").excess(results.group("optimum"))
    assert value.mean == pytest.approx(25.0)


def test_tables_are_written_in_three_forms_that_agree_and_repeat(make_store: MakeStore) -> None:
    store = make_store([0, 1])
    paths = write_tables(store)
    assert {path.suffix for path in paths} == {".csv", ".md", ".tex"}
    first = {path: path.read_bytes() for path in paths}
    write_tables(store)
    assert {path: path.read_bytes() for path in paths} == first
    text = (store.tables / "ablation.tex").read_text(encoding="utf-8")
    assert r"\toprule" in text
    assert r"\usepackage{booktabs}" in text
    assert r"85.0 $\pm$ 7.1" in text
    rows = list(csv.DictReader(io.StringIO((store.tables / "ablation.csv").read_text("utf-8"))))
    full = rows[0]
    assert float(full["Greedily (%) | mean"]) == pytest.approx(85.0)
    assert float(full["Greedily (%) | std"]) == pytest.approx(7.071068)
    assert full["Greedily (%) | n"] == "2"


def test_an_empty_store_gives_tables_of_dashes(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "quick", create=True)
    assert {table.name for table in build_tables(store)} >= {*Insertion.printed} - {
        "team",
        "difficulty",
    }
    write_tables(store)
    assert verify(store) == []


def test_figures_are_drawn_and_repeat(make_store: MakeStore, tmp_path: Path) -> None:
    found = {picture.name: picture for picture in pictures(Results(make_store([0, 1])))}
    assert {"safe_cumulative_reward", "safe_loss", "robustness"} <= set(found)
    for name in ("safe_cumulative_reward", "performance_profile"):
        data = found[name].write(tmp_path).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert found[name].write(tmp_path).read_bytes() == data


def test_markup_of_tables_is_escaped() -> None:
    number = Number(Value(1.0, 0.5, 3), 1)
    table = Table("t", "50 % & more", ["a|b", "x_1"], [["p < 0.01", number]], ["100 %"])
    assert r"a\|b" in table.markdown()
    assert r"50 \% \& more" in table.latex()
    assert r"x\_1" in table.latex()
    assert "p $<$ 0.01 & 1.0 $\\pm$ 0.5" in table.latex()
    with pytest.raises(ValueError, match="does not fit"):
        Table("t", "t", ["a"], [["1", "2"]])


def test_a_partly_finished_preset_shows_what_is_missing(tmp_path: Path) -> None:
    def keep(cell: Cell) -> bool:
        if cell.method == "dqn":
            return cell.seed < 2 and cell.track == "safe"
        if cell.method == "rainbow":
            return cell.track != "printed" and cell.ablation == "full"
        return cell.method != "greedy"

    store = fabricated_store.make_store(tmp_path, range(5), "cut", keep)
    table = find(store, "performance")
    rows = {row[0]: row[1:] for row in table.texts()}
    assert rows["Success rate (%)"][3] == "55.0 ± 7.1"
    assert rows["Success rate (%)"][5] == "70.0 ± 15.8 †"
    (note,) = (note for note in table.notes if note.startswith("Not complete"))
    assert "Vanilla DQN, safe 2 of 5 seeds" in note
    assert "Rainbow DQN, safe" not in note
    (note,) = (n for n in find(store, "controls").notes if n.startswith("Not complete"))
    assert "Masked DQN 0 of 5 seeds" in note
    board = {row[1] for row in find(store, "leaderboard").texts()}
    assert "Greedy, safe" not in board
    write_tables(store)
    assert verify(store) == []


def test_episodes_that_began_elsewhere_are_no_pairs(make_store: MakeStore) -> None:
    store = make_store([0])
    run = store.run("lookahead-optimized-safe-s0")
    path = run.path / "episodes.csv"
    path.write_text(path.read_text("utf-8").replace("start3", "start33", 1), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="episode 3 of seed 0 began"):
        build_tables(store)
