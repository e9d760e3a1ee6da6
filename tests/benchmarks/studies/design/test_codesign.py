"""``python -m benchmarks codesign``: searches, goes on, chooses, can be checked."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.stats import spearmanr
from stable_baselines3.common.env_checker import check_env

pytest.importorskip("optuna", reason="the extra 'tune' is not installed")

from benchmarks.__main__ import main
from benchmarks.errors import BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.verify import Report
from benchmarks.runs.cell import run_cell
from benchmarks.runs.store import RunFolder
from benchmarks.studies.design.codesign import command, conditioned, spaces, tell
from benchmarks.studies.design.codesign.found import Found, on_front, quickest, surest
from benchmarks.studies.insertion import Insertion
from coop_env.design import workspace_area
from coop_env.geometry import GEOMETRIES, OPTIMIZED
from coop_env.team.joint_env import CoopInsertionJointEnv

SMALL = ["--designs", "4", "--starts", "3", "--candidates", "2", "--seeds", "2"]


@pytest.fixture(scope="module")
def machine() -> spaces.Machine:
    return spaces.machine_of("optimized", [])


def test_a_design_is_the_given_machine_with_some_lengths_changed(machine: spaces.Machine) -> None:
    same = machine.geometry({})
    for name, value in OPTIMIZED.as_dict().items():
        assert getattr(same, name) == pytest.approx(value, abs=1e-12), name
    higher = machine.geometry({"home_heave": 0.23, "distal_length": 0.25})
    assert (higher.heave_min, higher.heave_max) == pytest.approx((0.23, 0.27))
    assert higher.distal_length == 0.25
    assert higher.lambdas == pytest.approx(OPTIMIZED.lambdas)
    assert spaces.area(OPTIMIZED) == workspace_area(OPTIMIZED)
    assert machine.of({"design": "initial"}) is GEOMETRIES["initial"]


def test_what_cannot_be_assembled_has_no_score(machine: spaces.Machine) -> None:
    for reason, values in (
        ("lengths", {"lambda1": 0.9, "lambda2": 1.0}),
        ("home", {"home_heave": 0.33}),
        ("starts", {"lambda1": 1.25, "lambda2": 2.65}),
    ):
        with pytest.raises(spaces.Unbuilt, match=reason):
            spaces.build(machine, values)


def test_the_optimum_of_a_design_is_the_same_for_the_same_starts() -> None:
    found = spaces.optimum(OPTIMIZED, 0, 6)
    assert found == spaces.optimum(OPTIMIZED, 0, 6)
    solved = found.success / 100.0
    assert found.ticks_all == pytest.approx(solved * found.ticks + (1 - solved) * 300)
    assert spaces.summary([math.nan, 10.0], 300) == (50.0, 10.0, 155.0)
    assert spaces.summary([math.nan], 300)[0] == 0.0


def test_a_front_holds_what_no_other_beats() -> None:
    rng = np.random.default_rng(0)
    rows = pd.DataFrame({
        "success": rng.integers(70, 100, 40).astype(float), "ticks": rng.integers(15, 25, 40) / 1.0,
    }, index=[f"lambdas-{i}" for i in range(40)])  # fmt: skip
    rows.loc["lambdas-40"] = [60.0, 1.0]
    held = rows[on_front(rows, 75.0)]
    for name, row in rows.iterrows():
        beaten = any(
            s >= row["success"] and t <= row["ticks"] and (s, t) != (row["success"], row["ticks"])
            for s, t in zip(rows["success"], rows["ticks"], strict=True)
        )
        assert (name in held.index) == (row["success"] >= 75.0 and not beaten)
    assert surest(rows) in held.index
    fast = quickest(rows, 90.0)
    assert fast in held.index
    assert rows.loc[fast, "ticks"] == rows.loc[rows["success"] >= 90.0, "ticks"].min()


def test_a_rank_correlation_has_an_interval_about_it() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=80)
    y = x + rng.normal(size=80)
    found = tell.rank_correlation(x, y)
    assert found.mean == pytest.approx(spearmanr(x, y).statistic)
    assert found.low < found.mean < found.high
    assert found.high - found.low == pytest.approx(4 * 0.75 / math.sqrt(80), rel=0.5)
    assert tell.rank_correlation([*x, 9.0], [*y, math.nan]).n == 80
    assert tell.rank_correlation(x, np.ones(80)).n == 0


def test_the_policy_sees_which_machine_it_moves(machine: spaces.Machine) -> None:
    geometries = conditioned.pool(machine, 6, 0)
    assert geometries == conditioned.pool(machine, 6, 0)
    env = conditioned.DesignsEnv(machine, geometries, reward="progress", mask_singularities=True)
    check_env(env, skip_render_check=True)
    seen = set()
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        geometry = env.env.params.rrs
        mine = [g for g in geometries if np.allclose(machine.features(g), observation[12:])]
        assert len(mine) == 1
        assert mine[0].base_radius == pytest.approx(geometry.base_radius)
        seen.add(mine[0])
        assert np.array_equal(observation[:12], env.env.observe())
        assert env.action_masks().shape == (49,)
    assert len(seen) > 3


def test_played_lengths_are_those_of_the_moves(machine: spaces.Machine) -> None:
    """A policy that knows the optimum's plans takes its ticks."""
    plans: dict[int, Any] = {}
    env = CoopInsertionJointEnv(geometry=OPTIMIZED, reward="progress")
    oracle = LatticeOracle(at_once=True)
    starts = [3, 5, 8]
    for i, seed in enumerate(starts):
        env.reset(seed=seed)
        plans[i] = oracle.plan(env).moves
    tick = 0

    def policy(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        nonlocal tick
        running = [i for i in range(3) if len(plans[i]) > tick]
        assert len(observations) == len(running)
        assert observations.shape[1] == 16
        tick += 1
        return np.array([plans[i][tick - 1] for i in running])

    lengths = conditioned.play(policy, machine, OPTIMIZED, starts, {"reward": "progress"})
    assert lengths == [len(plans[i]) for i in range(3)]


@pytest.mark.slow
def test_the_largest_area_is_the_one_that_the_design_study_finds(machine: spaces.Machine) -> None:
    found = machine.area_best("lambdas")
    assert found == pytest.approx({"lambda1": 1.438, "lambda2": 1.660}, abs=0.002)
    assert spaces.area(machine.geometry(found)) == pytest.approx(1.165, abs=5e-4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--geometry", "theirs"], "neither initial, optimized nor a YAML file"),
        (["--bounds", "lambda1=2:1"], "lambda1=2:1: must be name=low:high"),
        (["--bounds", "L2=0.1:0.2"], "names: distal_length, home_heave, lambda1, lambda2"),
        (["--bounds", "lambda1=0.3:0.4"], "lambda1 0.3:0.4, lambda2 0.6:2.8 was found to have"),
    ],
)
def test_bad_input_is_said_before_anything_is_written(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["codesign", "--results", str(tmp_path / "results"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


def test_a_machine_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    twice = {
        name: 2.0 * getattr(OPTIMIZED, name)
        for name in ("base_radius", "proximal_length", "platform_radius", "distal_length")
    }
    path.write_text(yaml.safe_dump(twice), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="cannot take their home pose"):
        spaces.machine_of(spaces.given(str(path)), [])
    path.write_text(yaml.safe_dump(twice | {"plinth": 1.0}), encoding="utf-8")
    with pytest.raises(BenchmarkError, match="plinth"):
        spaces.machine_of(spaces.given(str(path)), [])
    ours = OPTIMIZED.as_dict() | {"distal_length": 0.24, "home_heave": 0.22}
    path.write_text(yaml.safe_dump(ours), encoding="utf-8")
    mine = spaces.machine_of(spaces.given(str(path)), ["home_heave=0.2:0.25"])
    assert list(mine.named) == ["given"]
    assert mine.bounds["home_heave"] == (0.2, 0.25)
    assert mine.bounds["distal_length"] == pytest.approx((0.18, 0.324))


@pytest.mark.slow
def test_the_policy_for_all_designs_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    asked = {"geometry": "optimized", "bounds": [], "starts": 2, "steps": 800}
    RunFolder(tmp_path).begin(asked)
    lambda1, lambda2, _ = OPTIMIZED.lambdas
    lengths = {"study": "lambdas", "lambda1": lambda1, "lambda2": lambda2}
    designs = [{"design": name, **lengths} for name in ("initial", "lambdas-7")]
    RunFolder(tmp_path).write_rows("candidates", designs)
    experiment = conditioned.Conditioned(tmp_path)
    (cell,) = experiment.cells()
    store = experiment.open_store(tmp_path, create=True)
    asked_so_often = 0

    def stop() -> bool:
        nonlocal asked_so_often
        asked_so_often += 1
        return asked_so_often > 20

    assert not run_cell(experiment, cell, store, stop)
    assert run_cell(conditioned.Conditioned(tmp_path), cell, store)
    folder = store.run(cell.id)
    (resumed,) = folder.meta()["training"]["resumed_at"]
    assert 0 < resumed < folder.meta()["training"]["timesteps"] == 800
    assert folder.rows("designs")["design"].tolist() == ["initial", "lambdas-7"]


@pytest.mark.slow
def test_the_command_goes_on_and_can_be_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    docs, results = tmp_path / "docs", tmp_path / "results"
    docs.mkdir()
    page = docs / tell.PAGE
    page.write_text("# Page\n\n<!-- codesign:begin -->\n<!-- codesign:end -->\n", encoding="utf-8")
    words = ["codesign", "--results", str(results), "--docs", str(docs), "--jobs", "1", *SMALL]
    words += ["--steps", "400", "--policy-steps", "320"]
    monkeypatch.setattr(command, "EPISODES", 4)
    largest = {
        "lambdas": {"lambda1": 1.4386, "lambda2": 1.6591},
        "heights": {"distal_length": 0.27631, "home_heave": 0.28221},
    }
    monkeypatch.setattr(spaces.Machine, "area_best", lambda _, study: largest[study])
    score, calls = spaces.optimum, []

    def cut_off(*arguments: Any, **named: Any) -> spaces.Optimum:
        calls.append(arguments)
        if len(calls) == 7:
            raise KeyboardInterrupt
        return score(*arguments, **named)

    with monkeypatch.context() as patched:
        patched.setattr(command, "optimum", cut_off)
        assert main([*words, "--until", "search"]) == 130
    folder = results / "codesign"
    assert not (folder / "designs.csv").exists()
    assert main([*words, "--until", "search"]) == 0
    resumed = (folder / "designs.csv").read_bytes()
    whole = tmp_path / "whole"
    assert main([*words, "--until", "search", "--results", str(whole)]) == 0
    assert resumed == (whole / "codesign" / "designs.csv").read_bytes()

    assert main([*words, "--until", "conditioned"]) == 0
    found = Found(folder)
    rows = RunFolder(folder).rows("designs")
    assert len(rows) == 2 * 4 + 4
    assert found.designs["policy_success"].notna().sum() >= 6
    assert {"initial", "optimized", "lambdas-area", "heights-area"} <= set(found.choose())
    preset = command._write_preset(RunFolder(folder), spaces.machine_of("optimized", []))
    cells = expand(load_preset(str(preset)))
    assert len(cells) == 2 * len(found.choose())
    assert {cell.geometry for cell in cells} == set(found.choose())

    experiment = Insertion(str(preset))
    own = next(cell for cell in cells if cell.geometry == "heights-area")
    assert run_cell(experiment, own, experiment.open_store(folder, create=True))
    assert found.policies("heights-area").n == 1
    assert main([*words, "--until", "conditioned"]) == 0  # nothing but tables is left to do

    text = page.read_text("utf-8")
    assert text.count("too few designs to say") == 2
    assert "](../results/codesign/figures/fronts.png)" in text
    told = Found(folder).told["command"]
    assert "--designs 4" in told
    assert "--until" not in told
    assert (folder / "figures" / "fronts.png").stat().st_size > 10_000
    report = Report()
    tell.check(report, results, [], docs)
    assert report.problems == []
    page.write_text(text.replace("too few", "enough"), encoding="utf-8")
    report = Report()
    tell.check(report, results, [], docs)
    assert report.problems
    capsys.readouterr()
    assert main([*words, "--starts", "4"]) == 2
    assert "starts: 3 -> 4" in capsys.readouterr().err
