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
from benchmarks.reporting.results import Results, excess_over_optimum
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


def test_performance_has_our_value_beside_the_papers(make_store: MakeStore) -> None:
    table = find(make_store([0]), "performance")
    ours, paper = column(table, "Rainbow DQN, tuned"), column(table, "Rainbow DQN, paper")
    assert (ours["Success rate (%)"], paper["Success rate (%)"]) == ("90.0", "95 ± 2")
    assert ours["Avg. completion time (s)"] == "5.00 †"
    assert ours["Moves to first insertion over the optimum (%)"] == "25.0"
    assert column(table, "Exact optimum")["Success rate (%)"] == "100.0"
    assert "n = 1" in table.notes[0]
    assert "±" not in "".join(ours.values())
    assert any("precision 5" in note for note in table.notes)


def test_seeds_give_mean_and_sample_standard_deviation(make_store: MakeStore) -> None:
    store = make_store([0, 1, 2])
    table = find(store, "performance")
    ours = column(table, "Rainbow DQN, tuned")
    assert ours["Success rate (%)"] == "80.0 ± 10.0 †"
    assert ours["Success rate, IQM over seeds [95 % interval]"].startswith("80.0 [")
    value = Results(store).group("rainbow", track="tuned").success()
    assert value.n == 3
    assert 70.0 <= value.low <= 80.0 <= value.high <= 90.0


def test_the_ablation_has_a_row_for_each_component_and_the_optimum(make_store: MakeStore) -> None:
    table = find(make_store([0]), "ablation")
    assert [row[0] for row in table.rows[:7]] == [labels.ABLATIONS[key] for key in ABLATION]
    assert table.rows[-1][0] == "Exact optimum"
    success = column(table, "Success (%), tuned")
    assert success["Full Rainbow"] == "90.0"
    assert success["- Dueling head"] == "80.0"
    assert success["Exact optimum"] == "100.0"
    assert column(table, "Success (%), paper")["- Dueling head"] == "85 ± 3"


def test_geometry_and_robustness_rows(make_store: MakeStore) -> None:
    store = make_store([0])
    geometry = find(store, "geometry")
    steps = geometry.texts()[0]
    assert steps == ["Env. steps to 75 % success (1e5)", "11.2 ± 1.1", "0.30", "7.6 ± 0.8", "0.30"]
    noise = column(find(store, "robustness"), "Change at 0.01 (points)")
    assert noise["Rainbow DQN, tuned"] == "-10.0"


def test_a_run_that_never_reached_the_threshold_says_so(make_store: MakeStore) -> None:
    store = make_store([0, 2])  # the second seed solves 7 of 10
    steps = column(find(store, "ablation"), "Steps to 75 % (1e5), tuned")
    assert steps["Full Rainbow"] == "0.30 (1 of 2 never)"


def test_pairs_are_made_by_initial_state(make_store: MakeStore) -> None:
    table = find(make_store([0]), "significance")
    row = next(row for row in table.texts() if "RRT-Connect" in row[0] and "Success" in row[1])
    # 9 against 5 of the same 10 starts: differences 0.4 on average
    assert row[2] == "+40.0"
    assert row[6] == "10"
    time = next(row for row in table.texts() if "RRT-Connect" in row[0] and "time" in row[1])
    assert time[6] == "5"


def test_excess_counts_only_starts_that_both_solved(make_store: MakeStore) -> None:
    results = Results(make_store([0]))
    value = excess_over_optimum(results.group("dqn", track="tuned"), results.group("optimum"))
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
    assert float(full["Success (%), tuned | mean"]) == pytest.approx(85.0)
    assert float(full["Success (%), tuned | std"]) == pytest.approx(7.071068)
    assert full["Success (%), tuned | n"] == "2"


def test_an_empty_store_gives_tables_of_dashes(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "quick", create=True)
    assert {table.name for table in build_tables(store)} >= set(PRINTED)
    write_tables(store)
    assert verify(store) == []


def test_verify_is_green_and_red_after_one_digit(make_store: MakeStore, tmp_path: Path) -> None:
    store = make_store([0])
    write_tables(store)
    readme = tmp_path / "README.md"
    readme.write_text(f"# Title\n\n{BEGIN}\n{END}\n\nThe end.\n", encoding="utf-8")
    assert rewrite(readme, store)
    assert not rewrite(readme, store)
    assert verify(store, readme) == []
    path = store.tables / "ablation.md"
    path.write_text(path.read_text("utf-8").replace("90.0", "91.0", 1), encoding="utf-8")
    (problem,) = verify(store, readme)
    assert "ablation.md" in problem
    assert "91.0" in problem
    write_tables(store)
    readme.write_text(readme.read_text("utf-8").replace("90.0", "91.0", 1), encoding="utf-8")
    (problem,) = verify(store, readme)
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
    assert text.count("| Success rate (%)") == 1


def test_figures_are_drawn_and_repeat(make_store: MakeStore, tmp_path: Path) -> None:
    found = {picture.name: picture for picture in pictures(Results(make_store([0, 1])))}
    assert {"tuned_cumulative_reward", "tuned_loss", "robustness"} <= set(found)
    for name in ("tuned_cumulative_reward", "performance_profile"):
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
            return cell.seed < 2 and cell.track == "repaired"
        if cell.method == "rainbow":
            return cell.track != "printed" and cell.ablation == "full"
        return True

    store = fabricated_store.make_store(tmp_path, range(5), "paper", keep)
    table = find(store, "performance")
    assert column(table, "Rainbow DQN, as printed")["Success rate (%)"] == "missing"
    assert column(table, "Vanilla DQN, tuned")["Avg. energy proxy (J)"] == "missing"
    assert column(table, "Vanilla DQN, repaired")["Success rate (%)"] == "55.0 ± 7.1 †"
    assert column(table, "Rainbow DQN, repaired")["Success rate (%)"] == "70.0 ± 15.8 †"
    (note,) = (note for note in table.notes if note.startswith("Not complete"))
    assert "Vanilla DQN, repaired 2 of 5 seeds" in note
    assert "Rainbow DQN, as printed 0 of 5 seeds" in note
    assert "Rainbow DQN, repaired" not in note
    headers = find(store, "hyperparameters").header
    assert headers[2:] == ["Ours, as printed", "Ours, repaired", "Ours, tuned"]
    write_tables(store)
    assert verify(store) == []


def test_statistics_over_seeds(make_store: MakeStore) -> None:
    store = make_store([0, 1, 2])
    # 90, 80, 70 against 50, 40, 30 %: each seed of ours beats each of theirs
    improvement = find(store, "improvement")
    row = next(row for row in improvement.texts() if row[0].endswith("over RRT-Connect"))
    assert row[1] == "1.000 [1.000, 1.000]"
    assert row[-1] == "3; 3"
    aggregates = find(store, "aggregates")
    ours = next(row for row in aggregates.texts() if row[0] == "Rainbow DQN, tuned")
    assert ours[1] == "Success rate"
    assert ours[2].startswith("0.800 [0.7")
    assert ours[4].startswith("0.200 [0.1")
    significance = find(store, "significance")
    row = next(row for row in significance.texts() if "RRT" in row[0] and "Success" in row[1])
    # the difference is 40 points in each seed: no spread between seeds, no test over them
    assert row[-2:] == ["-", "3"]
    assert row[6] == "30"


def test_episodes_that_began_elsewhere_are_no_pairs(make_store: MakeStore) -> None:
    store = make_store([0])
    run = store.run("rrt_connect-optimized-s0")
    path = run.path / "episodes.csv"
    path.write_text(path.read_text("utf-8").replace("start3", "start33", 1), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="episode 3 of seed 0 began"):
        build_tables(store)
