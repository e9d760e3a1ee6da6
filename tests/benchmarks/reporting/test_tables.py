"""Tables, figures, README and verify, from a fabricated store whose numbers are known."""

from __future__ import annotations

import csv
import io
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.paper_values import ABLATION
from benchmarks.protocol.plan import Cell
from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.pages.readme import BEGIN, END, rewrite
from benchmarks.reporting.results import Level, Results, excess_over_optimum
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.paper import PRINTED, build_tables, write_tables
from benchmarks.reporting.tables.table import Number, Table
from benchmarks.reporting.verify import verify
from benchmarks.runs.store import Store
from tests.benchmarks import fabricated_store

MakeStore = Callable[[list[int]], Store]


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


def test_performance_has_our_value_beside_the_papers(make_store: MakeStore) -> None:
    table = find(make_store([0]), "performance")
    assert cell(table, "Rainbow DQN, safe", "Success rate (%)") == "90.0"
    assert cell(table, "Rainbow DQN, paper", "Success rate (%)") == "95 ± 2"
    assert cell(table, "Rainbow DQN, safe", "Avg. completion time (s)") == "5.00 †"
    over = "Moves to first insertion over the optimum (%)"
    assert cell(table, "Rainbow DQN, safe", over) == "25.0"
    assert cell(table, "Exact optimum", "Success rate (%)") == "100.0"
    assert "n = 1" in table.notes[0]
    ours = next(row for row in table.texts() if row[0] == "Rainbow DQN, safe")
    assert "±" not in "".join(ours)
    assert any("precision 5" in note for note in table.notes)


def test_a_safe_policy_has_a_row_under_the_papers_own_masks(make_store: MakeStore) -> None:
    table = find(make_store([0]), "performance")
    row = "Rainbow DQN, safe, the paper's masks"
    assert cell(table, row, "Masks") == "paper's"
    assert cell(table, row, "Success rate (%)") == "70.0 †"
    assert cell(table, "Rainbow DQN, safe", "Masks") == "safe"


def test_every_row_says_which_masks_and_which_memory(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "cut")
    for table in build_tables(store):
        if table.name != "design":
            at = [table.header.index(name) for name in ("Masks", "Memory")]
            assert table.rows
            assert all(row[i] for row in table.texts() for i in at), table.name
    performance = find(store, "performance")
    memory = "64 configurations"
    assert cell(performance, "Greedy, memory", "Memory") == memory
    assert cell(performance, "Greedy, safe", "Memory") == "none"
    assert cell(performance, "Two-move lookahead, as printed", "Masks") == "paper's"
    controls = {"Random", "Greedy", "Two-move lookahead"}
    for name in ("performance", "leaderboard"):
        rows = {text for row in find(store, name).texts() for text in row[:2]}
        assert {
            f"{control}, {track}" for control in controls for track in ("safe", "memory")
        } <= rows
        assert "Exact optimum" in rows
    robust = column(find(store, "robustness"), "Noise 0.04")
    assert robust["Greedy, from the observation, safe"] == "60.0"
    assert robust["Two-move lookahead, from the observation, memory"] == "70.0"


def test_the_uncertain_machine_has_a_table_of_its_own(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "cut")
    table = find(store, "uncertain")
    row = next(row for row in table.texts() if row[0] == "Rainbow DQN, uncertain")
    assert row[2] == "64 configurations, refused moves"
    shown = dict(zip(table.header, row, strict=True))
    assert shown["Success (%)"] == shown["Success (%) at 3 mm"] == "90.0"
    assert shown["Success (%) at 0 mm"] == "100.0"
    assert [row[0] for row in table.texts()][-1] == "Exact optimum, uncertain"
    assert "up to 3 mm" in " ".join(table.notes)
    shown_elsewhere = {row[0] for row in find(store, "performance").texts()}
    assert not any("uncertain" in name for name in shown_elsewhere)


def test_files_of_before_the_columns_are_the_tracks_own(tmp_path: Path) -> None:
    store = fabricated_store.make_store(
        tmp_path, [0], "cut", lambda c: c.method == "rainbow" and c.ablation == "full"
    )
    for run in store.completed():
        rows = run.rows("episodes")
        rows = rows[rows["masks"] == "own"] if "masks" in rows else rows
        rows = rows[rows["error"] == 3.0] if "error" in rows else rows
        rows.drop(columns=["masks", "error"], errors="ignore").to_csv(
            run.path / "episodes.csv", index=False
        )
    results = Results(store)
    assert results.group("rainbow", track="uncertain").success().mean == 90.0
    assert results.group("rainbow", track="uncertain").success(Level(error=3.0)).mean == 90.0
    assert results.group("rainbow", track="uncertain").success(Level(error=4.0)).n == 0
    assert results.group("rainbow", track="safe").success(Level(0.01)).mean == 80.0
    assert results.group("rainbow", track="safe").success(Level(masks="paper")).n == 0


def test_seeds_give_mean_and_sample_standard_deviation(make_store: MakeStore) -> None:
    store = make_store([0, 1, 2])
    table = find(store, "performance")
    assert cell(table, "Rainbow DQN, safe", "Success rate (%)") == "80.0 ± 10.0 †"
    iqm = "Success rate, IQM over seeds [95 % interval]"
    assert cell(table, "Rainbow DQN, safe", iqm).startswith("80.0 [")
    value = Results(store).group("rainbow", track="safe").success()
    assert value.n == 3
    assert 70.0 <= value.low <= 80.0 <= value.high <= 90.0


def test_the_ablation_has_a_row_for_each_component_a_control_and_the_optimum(
    make_store: MakeStore,
) -> None:
    table = find(make_store([0]), "ablation")
    names = [row[0] for row in table.rows]
    assert names[:7] == [f"{labels.ABLATIONS[key]}, safe" for key in ABLATION]
    assert names[-2:] == ["Best control: Two-move lookahead, safe", "Exact optimum"]
    success = column(table, "Success (%)")
    assert success["Full Rainbow, safe"] == "90.0"
    assert success["- Dueling head, safe"] == "80.0"
    assert success["Exact optimum"] == "100.0"
    assert column(table, "Success (%), paper")["- Dueling head, safe"] == "85 ± 3"


def test_geometry_and_robustness_rows(make_store: MakeStore) -> None:
    store = make_store([0])
    geometry = find(store, "geometry")
    steps = "Steps to 75 % success (1e5), initial"
    assert cell(geometry, "Rainbow DQN, paper", steps) == "11.2 ± 1.1"
    assert cell(geometry, "Rainbow DQN, safe", steps) == "0.30"
    assert cell(geometry, "Exact optimum", "Success (%), initial") == "100.0"
    noise = column(find(store, "robustness"), "Change at 0.01 (points)")
    assert noise["Rainbow DQN, safe"] == "-10.0"
    assert noise["Greedy, from the observation, safe"] == "-10.0"


def test_the_hyperparameters_are_those_of_every_track(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "cut", lambda c: c.track == "safe")
    table = find(store, "hyperparameters")
    tracks = ["printed", "reward", "safe", "memory", "uncertain", "uncertain_nominal"]
    assert table.header[2:] == [f"Ours, {labels.track(track)}" for track in tracks]
    rows = {row[0]: row[2:] for row in table.texts()}
    assert rows["Masks"] == ["paper's"] * 2 + ["safe"] * 4
    assert rows["Memory"][:4] == ["none", "none", "none", "64 configurations"]
    for name in ("Reward", "Learning rate's schedule", "Updates per environment step",
                 "Environments"):  # fmt: skip
        assert "missing" not in rows[name]
    assert [text == "missing" for text in rows["Hardware"]] == [True, True, False, *[True] * 3]


def test_a_run_that_never_reached_the_threshold_says_so(make_store: MakeStore) -> None:
    store = make_store([0, 2])  # the second seed solves 7 of 10
    steps = column(find(store, "ablation"), "Steps to 75 % (1e5)")
    assert steps["Full Rainbow, safe"] == "0.30 (1 of 2 never)"


def test_pairs_are_made_by_initial_state(make_store: MakeStore) -> None:
    table = find(make_store([0]), "significance")
    rows = [dict(zip(table.header, row, strict=True)) for row in table.texts()]
    success = next(row for row in rows if row["Against"] == "RRT-Connect")
    # 9 against 5 of the same 10 starts: differences 0.4 on average
    assert success["Difference"] == "+40.0"
    assert success["Pairs"] == "10"
    time = next(row for row in rows if "time" in row["Metric"])
    assert time["Against"] == "Two-move lookahead, safe"
    assert time["Pairs"] == "8"


def test_excess_counts_only_starts_that_both_solved(make_store: MakeStore) -> None:
    results = Results(make_store([0]))
    value = excess_over_optimum(results.group("dqn", track="safe"), results.group("optimum"))
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
    assert r"85.0 $\pm$ 7.1" in text
    rows = list(csv.DictReader(io.StringIO((store.tables / "ablation.csv").read_text("utf-8"))))
    full = rows[0]
    assert float(full["Success (%) | mean"]) == pytest.approx(85.0)
    assert float(full["Success (%) | std"]) == pytest.approx(7.071068)
    assert full["Success (%) | n"] == "2"


def test_an_empty_store_gives_tables_of_dashes(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "quick", create=True)
    assert {table.name for table in build_tables(store)} >= {*PRINTED} - {"team"}  # if there is one
    write_tables(store)
    assert verify(store) == []


def test_verify_is_green_and_red_after_one_digit(make_store: MakeStore, tmp_path: Path) -> None:
    store = make_store([0])
    write_tables(store)
    readme = tmp_path / "README.md"
    readme.write_text(f"# Title\n\n{BEGIN}\n{END}\n\nThe end.\n", encoding="utf-8")
    assert rewrite(readme, store)
    assert not rewrite(readme, store)
    assert verify(store, [readme]) == []
    path = store.tables / "ablation.md"
    path.write_text(path.read_text("utf-8").replace("90.0", "91.0", 1), encoding="utf-8")
    (problem,) = verify(store, [readme])
    assert "ablation.md" in problem
    assert "91.0" in problem
    write_tables(store)
    readme.write_text(readme.read_text("utf-8").replace("90.0", "91.0", 1), encoding="utf-8")
    (problem,) = verify(store, [readme])
    assert "README.md" in problem


def test_the_readme_keeps_what_is_outside_the_block(make_store: MakeStore, tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    with pytest.raises(BenchmarkError, match="missing"):
        rewrite(readme, make_store([0]))
    readme.write_text("no markers", encoding="utf-8")
    store = Store.open(tmp_path / "results", "quick")
    with pytest.raises(BenchmarkError, match="no block"):
        rewrite(readme, store)
    readme.write_text(f"above\n{BEGIN}\nold\n{END}\nbelow\n", encoding="utf-8")
    rewrite(readme, store)
    text = readme.read_text(encoding="utf-8")
    assert text.startswith("above\n")
    assert text.endswith("\nbelow\n")
    assert "old" not in text
    assert text.count("| Rainbow DQN, safe") == 1


def test_figures_are_drawn_and_repeat(make_store: MakeStore, tmp_path: Path) -> None:
    found = {picture.name: picture for picture in pictures(Results(make_store([0, 1])))}
    assert {"safe_cumulative_reward", "safe_loss", "robustness"} <= set(found)
    for name in ("safe_cumulative_reward", "performance_profile"):
        data = found[name].write(tmp_path).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert found[name].write(tmp_path).read_bytes() == data


def test_tables_and_figures_do_without_torch() -> None:
    code = (
        "import sys, benchmarks.reporting.tables.paper, benchmarks.reporting.figures.learning;"
        "import benchmarks.reporting.verify, benchmarks.reporting.pages.readme;"
        "print([m for m in ('torch', 'stable_baselines3', 'sb3_contrib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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
    success = column(table, "Success rate (%)")
    assert success["Rainbow DQN, as printed"] == "missing"
    assert success["Greedy, safe"] == "missing"
    assert column(table, "Avg. energy proxy (J)")["Vanilla DQN, as printed"] == "missing"
    assert success["Vanilla DQN, safe"] == "55.0 ± 7.1 †"
    assert success["Rainbow DQN, safe"] == "70.0 ± 15.8 †"
    (note,) = (note for note in table.notes if note.startswith("Not complete"))
    assert "Vanilla DQN, safe 2 of 5 seeds" in note
    assert "Rainbow DQN, as printed 0 of 5 seeds" in note
    assert "Rainbow DQN, safe" not in note
    write_tables(store)
    assert verify(store) == []


def test_statistics_over_seeds(make_store: MakeStore) -> None:
    store = make_store([0, 1, 2])
    significance = find(store, "significance")
    row = next(row for row in significance.texts() if row[3] == "RRT-Connect")
    # the difference is 40 points in each seed: no spread between seeds, no test over them
    assert row[-2:] == ["-", "3"]
    assert row[11] == "30"


def test_episodes_that_began_elsewhere_are_no_pairs(make_store: MakeStore) -> None:
    store = make_store([0])
    run = store.run("rrt_connect-optimized-s0")
    path = run.path / "episodes.csv"
    path.write_text(path.read_text("utf-8").replace("start3", "start33", 1), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="episode 3 of seed 0 began"):
        build_tables(store)
