"""Reward audit and failure map: scripts against sums by hand, causes against the environment."""

import dataclasses
import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.evaluation.evaluate import begin_episodes
from benchmarks.methods.base import Plan
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.scripts import SCRIPTS, Simulator
from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.runs.cell import run_cell
from benchmarks.runs.store import Store
from benchmarks.studies import audit, failures
from benchmarks.studies.insertion import Insertion
from coop_env.env import CoopInsertionEnv
from tests.benchmarks.conftest import Command
from tests.benchmarks.fabricated_store import fill
from tests.benchmarks.smoke import smoke_file


def test_the_best_cycle_is_the_best_of_all() -> None:
    env = CoopInsertionEnv(reward="paper")
    simulator = Simulator(env)
    for seed in range(5):
        env.reset(seed=seed)
        before = env.get_state()
        paid, cycle = simulator.best_cycle(np.array([env.state]))
        best = -math.inf
        for action in range(12):
            env.set_state(before)
            _, there, ended, _, first = env.step(action)
            if ended:
                continue
            _, back, _, _, second = env.step(action ^ 1)
            if first["violation"] or second["violation"] or first["inserted"] or second["inserted"]:
                continue
            if action == cycle:
                assert there + back == pytest.approx(paid, abs=1e-9)
            best = max(best, there + back)
        assert best == pytest.approx(paid, abs=1e-9)


def test_scripts_return_what_the_environment_pays() -> None:
    preset = load_preset("cut")
    tracks = {name: preset.tracks[name] for name in ("printed", "safe")}
    rows = pd.DataFrame(audit.scripted(dataclasses.replace(preset, tracks=tracks), 2))
    assert set(rows["script"]) == set(SCRIPTS)
    means = {
        (track, script): (float(result["return"].mean()), float(result["holes"].mean()))
        for (track, script), result in rows.groupby(["track", "script"])
    }
    for name in ("printed", "safe"):
        assert means[name, "farm"][1] == means[name, "oscillate"][1] == 0
        assert means[name, "insert one"][1] == 1
        assert means[name, "insert"][1] > 3
    # as printed a farmer earns more than one insertion does; with the safe reward next to nothing
    assert means["printed", "farm"][0] > means["printed", "insert one"][0]
    assert means["safe", "farm"][0] < 0.1 * means["safe", "insert one"][0]
    # oscillating earns the dense term of every second move, which is at most 50 x 20 mm
    assert 0.0 < means["printed", "oscillate"][0] < 150 * 50 * 0.02
    assert "| as printed | farm |" in " ".join(audit.markdown(rows).split())


def test_each_reward_is_played_once() -> None:
    assert list(audit.of_each_reward(load_preset("cut")).tracks) == ["printed", "reward", "safe"]


def test_both_commands_write_what_they_say(tmp_path: Path, done: Command, refused: Command) -> None:
    preset = load_preset("smoke")
    store = Store.open(tmp_path, "smoke", create=True)
    place = ["--preset", "smoke", "--results", str(tmp_path)]
    audits, fails = (["study", name, *place] for name in ("audit", "failures"))
    done(*audits, "--starts", "1")
    assert "no team or shield" in refused("study", "audit", *place, "--preset", "shielded")
    assert not (tmp_path / "audit" / "learned.csv").exists()
    assert "no stored policy of rainbow, track safe" in refused(*fails)
    assert "unknown track 'nosuch'; known: safe" in refused(*fails, "--track", "nosuch")
    assert run_cell(Insertion(preset), Insertion(preset).find("rainbow-optimized-safe-s0"), store)
    done(*fails)
    rows = pd.read_csv(store.folder / "failures" / "rainbow-safe.csv")
    assert len(rows) == preset.evaluation.episodes
    assert set(rows.loc[~rows["success"].astype(bool), "cause"]) <= set(failures.CAUSES)
    assert rows["acting"].isna().all()  # no training episode ended within so few steps
    assert "exploration" not in failures.summary(rows)
    done(*audits, "--starts", "1")
    learned = pd.read_csv(tmp_path / "audit" / "learned.csv")
    assert learned["method"].tolist() == ["rainbow"]
    assert audit.Audit.problems(tmp_path) == []
    learned.assign(holes=99).to_csv(tmp_path / "audit" / "learned.csv", index=False)
    assert any("learned.csv differs from the runs" in p for p in audit.Audit.problems(tmp_path))
    Store.open(tmp_path, "team", create=True)
    assert "the robots move at once" in refused(*fails, "--preset", "team", "--track", "central")


def test_causes_are_told_apart() -> None:
    """On the spot, towards the singularity, and around a square of eight configurations."""
    preset = load_preset("smoke")
    cell = next(c for c in expand(preset) if c.method == "rainbow")
    around = (0, 0, 2, 2, 1, 1, 3, 3)

    def model(*actions: int) -> SimpleNamespace:
        turn = itertools.cycle(actions)
        return SimpleNamespace(predict=lambda *_, deterministic: (np.array([next(turn)]), None))

    plain = dataclasses.replace(preset.tracks["safe"], mask_singularities=False, mask_visited=0)
    preset = dataclasses.replace(preset, tracks={"safe": plain})
    for cause, actions in (
        ("cycle", (0, 2, 1, 3)),
        ("cycle", 20 * around + 70 * (4, 5)),  # an episode that ends in one
        ("singular", (8,)),
        ("wandering", around),
    ):
        rows = failures.play(preset, cell, model(*actions), LatticeOracle())
        assert [row["cause"] for row in rows] == 2 * [cause]
        assert [str(row["moves"]) for row in rows] == 2 * ["nan"]
    hopeless: Any = SimpleNamespace(plan=lambda env: Plan("infeasible", None, 0.0))
    rows = failures.play(preset, cell, model(4, 5), hopeless)
    assert [row["cause"] for row in rows] == 2 * ["infeasible"]
    assert [str(row["optimum"]) for row in rows] == 2 * ["nan"]
    rows = failures.play(preset, cell, model(4, 5), LatticeOracle(node_limit=1))  # gives up
    assert [row["cause"] for row in rows] == 2 * ["cycle"]
    # the optimum of another seed's episodes, and no move after it
    cell = dataclasses.replace(cell, seed=1)
    starts = begin_episodes(env_arguments(preset, cell, plain), 1, 2, preset.evaluation.stream)
    plans: list[Any] = [LatticeOracle().plan(episode.env).moves for episode in starts]
    rows = failures.play(preset, cell, model(*itertools.chain(*plans)), LatticeOracle())
    assert [row["start"] for row in rows] == [episode.start for episode in starts]
    assert [row["moves"] for row in rows] == [len(plan) for plan in plans]
    assert [row["optimum"] for row in rows] == [len(plan) for plan in plans]
    assert [(row["success"], row["cause"]) for row in rows] == 2 * [(True, "")]


def test_failures_are_of_each_seed_whose_policy_is_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    runs = [{"methods": ["rainbow"], "tracks": ["safe", "tilted"], "ablations": ["full", "none"]}]
    tracks: dict[str, Any] = {"safe": {}, "tilted": {"base": "safe"}}
    path = smoke_file(tmp_path, "mine", seeds=[0, 1, 2], tracks=tracks, runs=runs)
    preset, store = load_preset(str(path)), Store.open(tmp_path, "mine", create=True)
    for cell in expand(preset):
        fill(store, preset, cell, 1)
        run = store.run(cell.id)
        run.rows("curve").assign(success_20=0.9).to_csv(run.path / "curve.csv", index=False)
        if cell.seed < 2:
            run.policy.write_bytes(b"")
    still = SimpleNamespace(predict=lambda *_, deterministic: (np.array([0]), None))
    monkeypatch.setattr(failures, "load_stored", lambda path: still)
    done("study", "failures", "--preset", path, "--results", tmp_path)
    rows = pd.read_csv(store.folder / "failures" / "rainbow-safe.csv")
    assert rows["seed"].tolist() == [0, 0, 1, 1]
    assert rows["acting"].tolist() == [0.5] * 4


def test_a_summary_of_failures_says_what_its_rows_say() -> None:
    rows = pd.DataFrame({
        "seed": [0, 0, 0, 1, 1], "success": [1, 1, 0, 0, 0], "acting": [0.5] * 3 + [0.9] * 2,
        "moves": [15.0, 9.0] + [math.nan] * 3, "optimum": [10.0, math.nan, 10.0, 10.0, math.nan],
        "cause": ["", "", "cycle", "cycle", "infeasible"],
    })  # fmt: skip
    assert failures.summary(rows) == (
        "- Success at the first hole: 40.0 % of 5 test episodes, the exact optimum's 60.0 %.\n"
        "- Moves over the optimum's: 50.0 %.\n"
        "- Failures: 1 infeasible, 0 singular, 2 cycle, 0 wandering.\n"
        "- Success with exploration, last tenth of training: 70.0 %.\n"
    )
