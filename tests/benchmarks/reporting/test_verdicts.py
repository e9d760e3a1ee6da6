"""Sentences say what the stored runs say; each threshold is held from both sides."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.protocol.plan import ABLATIONS, expand, settings
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.pages.readme import SHORT, short
from benchmarks.reporting.results import Results, tail_mean
from benchmarks.reporting.tables.paper import build_tables
from benchmarks.reporting.verdicts import headline_rows, sentences
from benchmarks.runs.store import Store
from tests.benchmarks.fabricated_store import curve, make_store

N = 2000  # episodes: one of them moves a success rate by 0.05 %
OURS, SCRIPT, OPTIMUM = (
    "rainbow-optimized-safe-s0",
    "lookahead-optimized-safe-s0",
    "optimum-optimized-s0",
)
Columns = dict[str, Any]
Tell = Callable[[dict[str, Columns]], dict[str, str]]


def first(solved: int) -> np.ndarray:
    """The first so many of all episodes are solved."""
    return (np.arange(N) < solved).astype(int)


@pytest.fixture
def results_of(tmp_path: Path) -> Callable[[dict[str, Columns]], Results]:
    """Results of one seed of preset paper: run -> columns of its episodes."""
    preset = dataclasses.replace(load_preset("cut"), seeds=[0])
    cells = {cell.id: cell for cell in expand(preset)}

    def write(runs: dict[str, Columns]) -> Results:
        store = Store.open(tmp_path / f"{len(list(tmp_path.iterdir()))}", "cut", create=True)
        for name, columns in runs.items():
            run, frame = store.run(name), pd.DataFrame({"episode": np.arange(N), "noise": 0.0})
            given = dict(columns)
            success = np.asarray(given.pop("success"))
            frame = frame.assign(success=success, holes=6 * success, collisions=0, moves_first=20)
            frame = frame.assign(start=frame["episode"], **{
                key: value for key, value in given.items() if key not in ("training", "curve")
            })  # fmt: skip
            frame["moves_first"] = frame["moves_first"].where(success == 1)
            frame["time_first"] = 0.2 * frame["moves_first"]
            run.begin(settings(preset, cells[name]))
            frame.to_csv(run.path / "episodes.csv", index=False)
            rows = pd.DataFrame(curve(cells[name])).assign(**given.get("curve", {}))
            rows.to_csv(run.path / "curve.csv", index=False)
            run.write_meta({
                "cell": name, "training": {"steps_to_75": None, "singular": 0, "episodes": 9},
                "wall_seconds": 60.0, "commit": "abc", "dirty": False,
                "machine": {"processor": "test"},
            })  # fmt: skip
        return Results(store)

    return write


@pytest.fixture
def tell(results_of: Callable[[dict[str, Columns]], Results]) -> Tell:
    """The sentences of such results."""
    return lambda runs: sentences(results_of(runs))


def headline(tell: Tell, ours: Columns, script: Columns, optimum: Columns) -> str:
    return tell({OURS: ours, SCRIPT: script, OPTIMUM: optimum})["safe"]


@pytest.mark.parametrize(("solved", "reproduces"), [(1900, True), (1899, False)])
def test_success_is_held_against_what_the_paper_prints(
    solved: int, reproduces: bool, tell: Tell
) -> None:
    ours = {"success": first(solved)}
    told = headline(tell, ours, {"success": first(1000)}, ours)
    assert told.startswith("**The success rate reproduces**") == reproduces
    assert told.startswith("**Above the scripts, short of the goal**") != reproduces
    assert ("Missed: success 95.0" in told or "Missed: success 94.9" in told) != reproduces


@pytest.mark.parametrize(("solved", "reproduces"), [(1960, True), (1959, False)])
def test_success_is_held_against_the_optimums(solved: int, reproduces: bool, tell: Tell) -> None:
    told = headline(
        tell, {"success": first(solved)}, {"success": first(1000)}, {"success": first(N)}
    )
    assert told.startswith("**The success rate reproduces**") == reproduces


@pytest.mark.parametrize(("odd", "met"), [(21, True), (23, False)])
def test_moves_are_held_against_the_optimums(odd: int, met: bool, tell: Tell) -> None:
    moves = np.where(np.arange(N) == 0, odd, 22)  # all but one at 1.10 exactly
    every = {"success": first(N)}
    told = headline(tell, {**every, "moves_first": moves}, {"success": first(1000)}, every)
    assert ("All goals are met" in told) == met
    assert ("Missed: moves 1.10 of the optimum's" in told) != met


@pytest.mark.parametrize(("sixes", "met"), [(801, True), (799, False)])
def test_holes_are_held_against_their_goal(sixes: int, met: bool, tell: Tell) -> None:
    every = {"success": first(N)}
    told = headline(tell, {**every, "holes": 5 + first(sixes)}, {"success": first(1000)}, every)
    assert ("All goals are met" in told) == met
    assert ("Missed: 5.40 holes" in told) != met


@pytest.mark.parametrize(("knocks", "met"), [(0, True), (1, False)])
def test_no_collision_is_forgiven(knocks: int, met: bool, tell: Tell) -> None:
    every = {"success": first(N)}
    told = headline(tell, {**every, "collisions": first(knocks)}, {"success": first(9)}, every)
    assert ("All goals are met" in told) == met
    assert ("collisions (at most 0)" in told) != met


@pytest.mark.parametrize(
    ("won", "lost", "verdict"),
    [
        # of 2000 pairs; three times the p of the paired t-test is 0.0499, or 0.0501
        (41, 22, "The success rate reproduces"),
        (88, 59, "A script does as well"),
    ],
)
def test_a_difference_counts_after_holm_at_five_percent(
    won: int, lost: int, verdict: str, tell: Tell
) -> None:
    ours = np.concatenate([np.ones(won), np.zeros(lost), np.ones(N - won - lost)]).astype(int)
    script = np.concatenate([np.zeros(won), np.ones(N - won)]).astype(int)
    # equal holes and times: two of the three comparisons find nothing, and count
    equal = {"holes": 5}
    told = headline(
        tell, {"success": ours, **equal}, {"success": script, **equal}, {"success": first(N)}
    )
    assert verdict in told
    mirrored = headline(
        tell, {"success": script, **equal}, {"success": ours, **equal}, {"success": first(N)}
    )
    assert ("A script does better" in mirrored) == ("reproduces" in verdict)


@pytest.mark.parametrize(
    ("ahead", "verdict"),
    [(201, "learning pays**"), (199, "learning pays less than 10 points**")],
)
def test_on_the_uncertain_machine_learning_has_to_pay_ten_points(
    ahead: int, verdict: str, tell: Tell
) -> None:
    told = tell({
        "rainbow-optimized-uncertain-s0": {"success": first(1000 + ahead)},
        "plan_search-optimized-uncertain-s0": {"success": first(1000)},
        "greedy-optimized-uncertain-s0": {"success": first(900)},
        "optimum-optimized-uncertain-s0": {"success": first(1900)},
    })["uncertain"]  # fmt: skip
    assert f"On the uncertain machine {verdict}" in told
    assert "at 3 mm Rainbow DQN, uncertain" in told
    assert "nominal plan, then search in 50.0" in told
    assert "the optimum that knows the machine in 95.0" in told


@pytest.mark.parametrize(
    ("ours", "verdict"), [(1000, "scripts do as well"), (800, "scripts stay ahead")]
)
def test_scripts_with_search_may_stay_ahead(ours: int, verdict: str, tell: Tell) -> None:
    told = tell({
        "rainbow-optimized-uncertain-s0": {"success": first(ours)},
        "plan_search-optimized-uncertain-s0": {"success": first(1000)},
    })["uncertain"]  # fmt: skip
    assert verdict in told


@pytest.mark.parametrize(("solved", "learns"), [(1000, True), (999, False)])
def test_as_printed_it_learns_from_half_of_the_episodes_on(
    solved: int, learns: bool, tell: Tell
) -> None:
    told = tell({"rainbow-optimized-printed-s0": {"success": first(solved)}})["printed"]
    assert ("the method learns the task" in told) == learns
    assert ("does not learn" in told) != learns
    steps = load_preset("cut").tracks["printed"].timesteps
    assert f"in {steps:,} of the paper's 1,500,000 steps" in told


def test_as_printed_it_stands_beside_the_script_with_its_masks(tell: Tell) -> None:
    told = tell({
        "rainbow-optimized-printed-s0": {"success": first(0)},
        "lookahead-optimized-printed-s0": {"success": first(900)},
        "lookahead-optimized-safe-s0": {"success": first(1900)},
    })["printed"]  # fmt: skip
    assert "a script under the same masks (two-move lookahead) in 45.0" in told


@pytest.mark.parametrize(
    ("holes", "reward", "unearned"),
    [(0.0, 30.0, True), (0.4999, 0.01, True), (0.5, 30.0, False), (0.0, 0.0, False)],
)
def test_what_is_paid_without_inserting_is_told(
    holes: float, reward: float, unearned: bool, tell: Tell
) -> None:
    told = tell({
        "rainbow-optimized-printed-s0": {
            "success": first(0), "curve": {"holes": holes, "episode_reward": reward}
        }
    })["printed"]  # fmt: skip
    assert f"fill {holes:.2f} holes" in told
    assert ("paid without inserting" in told) == unearned


def test_a_difference_that_is_the_same_in_every_pair_counts(tell: Tell) -> None:
    told = headline(tell, {"success": first(0)}, {"success": first(N)}, {"success": first(N)})
    assert told.startswith("**A script does better**")
    assert "(-100.0 points, p < 0.001)" in told


def test_a_script_that_knows_something_else_is_no_measure(tell: Tell) -> None:
    told = tell({
        OURS: {"success": first(1900)},
        "greedy-optimized-memory-s0": {"success": first(1990)},
        "greedy-optimized-printed-s0": {"success": first(1990)},
        OPTIMUM: {"success": first(N)},
    })["safe"]  # fmt: skip
    assert told.startswith("**No verdict yet**")
    assert "masks: safe; memory: none" in told


@pytest.mark.parametrize(
    ("before", "after", "scripts", "verdict"),
    [
        (980, 1960, 0.5, "effect reproduces**"),
        (979, 1960, 0.5, "effect reproduces in part**"),
        (980, 1959, 0.5, "effect reproduces in part**"),
        (980, 1960, 1.0, "effect reproduces in part**"),  # a script does as well
        (980, 980, 0.5, "effect does not reproduce**"),
    ],
)
def test_the_design_stage_reproduces_near_both_optima_and_above_the_scripts(
    before: int, after: int, scripts: float, verdict: str, tell: Tell
) -> None:
    told = tell({
        "rainbow-initial-safe-s0": {"success": first(before)},
        "rainbow-optimized-safe-s0": {"success": first(after)},
        "lookahead-initial-safe-s0": {"success": first(int(scripts * before))},
        "lookahead-optimized-safe-s0": {"success": first(int(scripts * after))},
        "optimum-initial-s0": {"success": first(1000)},
        "optimum-optimized-s0": {"success": first(N)},
    })["geometry"]  # fmt: skip
    assert verdict in told
    assert "fitted to the paper's two workspace areas" in told
    assert "on either the best script that knows the same from" in told


def test_a_component_counts_where_the_paired_test_finds_it(tell: Tell) -> None:
    def runs(worse: list[str]) -> dict[str, Columns]:
        names = {name: f"rainbow-{name}-optimized-safe-s0" for name in ABLATIONS if name != "full"}
        return {
            OURS: {"success": first(1600)},
            **{run: {"success": first(1400 if name in worse else 1600)}
               for name, run in names.items()},
        }  # fmt: skip

    six = [name for name in ABLATIONS if name not in ("full", "none")]
    assert "ablation does not reproduce" in tell(runs([]))["ablation"]
    told = tell(runs(["no_noisy"]))["ablation"]
    assert "ablation reproduces in part" in told
    assert "less without noisynets 70.0 of these trainings; no clear difference without" in told
    assert "**The ablation reproduces** (safe)" in tell(runs(six))["ablation"]


def test_where_learning_pays_and_where_not(tell: Tell) -> None:
    told = tell({
        OURS: {"success": first(1900)},
        SCRIPT: {"success": first(1500)},
        "rainbow-optimized-memory-s0": {
            "success": first(1900), "moves_first": 20 + np.arange(N) % 2
        },
        "greedy-optimized-memory-s0": {"success": first(1900), "moves_first": 30},
        "rainbow-optimized-printed-s0": {"success": first(0)},
        "lookahead-optimized-printed-s0": {"success": first(700)},
    })["pays"]  # fmt: skip
    assert "better than the best script: Rainbow DQN, safe (+20.0 points, these trainings);" in told
    assert "no better than it: Rainbow DQN, memory (+0.0 points);" in told
    assert "worse: Rainbow DQN, as printed (-35.0 points, these trainings);" in told
    assert "sooner at the first insertion: Rainbow DQN, memory (1.90 s, these trainings)." in told


def test_what_was_not_run_is_not_told(tmp_path: Path) -> None:
    store = make_store(tmp_path, [0], "cut", lambda cell: cell.method == "rrt_connect")
    assert sentences(Results(store)) == {}
    assert headline_rows(Results(store))  # the table says "missing"
    assert "missing" in short(store, [])


def test_the_readme_has_five_sentences_and_a_table_of_eight_rows(tmp_path: Path) -> None:
    store = make_store(tmp_path, [0, 1], "cut")
    text = short(store, build_tables(store))
    lines = text.splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len(table) <= 2 + 8
    assert table[0].count("|") - 1 <= 7
    told = [line for line in lines if line.startswith("- **")]
    assert len(told) == len(SHORT) == 5
    # a laptop's screen shows about fifty lines of a hundred characters
    assert sum(math.ceil(len(line) / 100) for line in lines) < 50


def test_the_last_episodes_count_once_each() -> None:
    rows = pd.DataFrame({
        "timesteps": [100, 900, 950, 980, 1000],
        "episodes": [1, 5, 6, 6, 9],
        "holes": [6.0, 6.0, 4.0, float("nan"), 2.0],
    })  # fmt: skip
    assert tail_mean(rows, "holes") == pytest.approx((1 * 4.0 + 3 * 2.0) / 4)
    assert math.isnan(tail_mean(rows[:1].assign(episodes=0), "holes"))
