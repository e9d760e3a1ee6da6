"""Kinematic players on the twin; ``study transfer`` and ``study physics``, which can be checked."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.methods.base import Plan
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.rrt_connect import execute
from benchmarks.protocol.presets import load_preset
from benchmarks.protocol.seeding import derive
from benchmarks.studies.robots import transfer
from benchmarks.studies.robots.physics import Physics
from benchmarks.studies.robots.transfer import Transfer
from benchmarks.studies.robots.trials import inserter
from coop_env.simulation.sim_to_real import FORGE, draw_disturbance
from tests.process import ROOT

pytest.importorskip("mujoco", reason="needs the extra physics")

RESULTS = ROOT / "results"


@pytest.mark.parametrize("world", ["+ moment", "+ SAC", "+ push"])
def test_an_exact_plan_fills_all_holes_with_a_search_and_no_far_one_by_a_push(world: str) -> None:
    env = transfer.make_world(world, RESULTS, {"reward": "progress"})
    play = partial(execute, plan=LatticeOracle().plan)
    result = transfer.play_one(env, play, 0, derive("validate", 31, 3))
    if world == "+ push":
        assert not result["first"]
    else:
        assert result == {"success": True, "first": True, "holes": 6}


@pytest.mark.parametrize(
    ("name", "fix"), [("spiral search", "study contact"), ("SAC", "run --preset contact")]
)
def test_what_inserts_must_be_there(name: str, fix: str, tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=f"is missing: run python -m benchmarks {fix} first"):
        inserter(tmp_path, name, 0)


def test_a_run_without_its_policy_is_run_again_once_it_is_deleted(tmp_path: Path) -> None:
    run = tmp_path / "classic/contact_errors/runs/standard-sac-s0"
    run.mkdir(parents=True)
    (run / "meta.json").write_text("{}")
    with pytest.raises(BenchmarkError, match=f"is missing: delete {run} and run python"):
        inserter(tmp_path, "SAC, trained on machines that err", 0)
    given = Transfer.parser().parse_args(["--results", str(tmp_path)])
    given.command = ""
    (tmp_path / "classic/contact").mkdir()
    assert not [part for part in Transfer(given).measures() if part.startswith("machines")]


@pytest.mark.parametrize("world", ["kinematics", "twin, no error"])
def test_a_script_plays_under_the_masks_and_the_memory_of_a_track(world: str) -> None:
    preset = load_preset(transfer.PRESET)
    play, arguments = transfer.player("lookahead, uncertain", preset, RESULTS, 0)
    env = transfer.make_world(world, RESULTS, arguments)
    assert arguments["mask_visited"] == 64
    assert arguments["mask_refused"]
    result = transfer.play_one(env, play, 0, derive("validate", 31, 3))
    assert result["holes"] >= 1
    assert result["first"]


def test_a_plan_that_leads_elsewhere_ends_it() -> None:
    env = transfer.make_world("kinematics", RESULTS, {})
    plans = iter([Plan("solved", np.array([4]), 0.0), Plan("infeasible", None, 0.0)])
    play = partial(execute, plan=lambda _: next(plans))  # who asks once more finds none
    assert transfer.play_one(env, play, 0, 1)["holes"] == 0
    assert transfer.play_one(env, play, 0, 1)["holes"] == 0
    assert not list(plans)


def test_machines_outside_of_the_bounds_are_outside() -> None:
    machines = transfer.machines()
    assert not machines["nominal"].active
    assert machines["within the bounds"] == FORGE
    for n in (1.5, 2.0):
        errors = machines[f"{n:g} times the bounds"]
        drawn = draw_disturbance(errors, np.random.default_rng(0))
        assert errors.turned == FORGE.turned
        assert (drawn.dead_zone, drawn.latency) == (n * FORGE.servo_dead_zone, 1.0)


def test_what_inserts_is_tried_on_every_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "SEEDS", 2)
    report: list[float] = []
    result = transfer.on_machines("moment-guided search", RESULTS, 1, report.append)
    assert list(result) == list(transfer.machines())
    assert report[-1] == 1.0
    assert all(len(rows[0]["success"]) == 2 for rows in result.values())
    (table,) = transfer._machines({"machines: moment-guided search": result})
    assert "2 times the bounds" in table
    assert not list(transfer._machines({}))


def test_the_command_writes_what_it_prints(site: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = {"success": [True, False], "first": [True, False], "holes": [6, 0]}
    monkeypatch.setattr(transfer, "_cell", lambda *_: cell)
    here = site("transfer")
    assert Transfer.main(["--results", str(here.results)]) == 0
    here.check(Transfer, "50 / 50 / 3.00")
    assert here.parts(Transfer)["RRT-Connect: twin"] == cell


def test_the_twins_errors_and_speed_are_written_and_printed(site: Any) -> None:
    here = site("physics")
    small = ["--poses", "4", "--steps", "16", "--rounds", "1", "--memory-steps", "20"]
    assert Physics.main(["--results", str(here.results), *small]) == 0
    here.check(Physics, "tip of the peg")
    assert (here.results / "physics" / "model" / "coop_insertion.xml").is_file()
    parts = here.parts(Physics)
    for geometry in ("initial", "optimized"):
        assert 0.0 < parts[f"errors, {geometry}"]["tip"]["largest"] < 5e-5
    assert min(parts["speed"].values()) > 0.0
