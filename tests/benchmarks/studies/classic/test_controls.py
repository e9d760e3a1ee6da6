"""What plays the public tasks without learning: scripts, one action, chance."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks.protocol.plan import expand, of_task
from benchmarks.protocol.presets import load_suite
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.runs.cell import run_cell
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.classic.controls import SCRIPTS, at_random, held, scripted
from benchmarks.studies.classic.experiment import Classic
from benchmarks.studies.classic.train import evaluate, make_env, run_control

pytest.importorskip("minatar", reason="needs the extra 'classic'")

TASKS = {
    task.env: task
    for preset in ("control", "minatar")
    for task in load_suite(preset).tasks.values()
}
# what each script reaches, less some; Box2D's and MinAtar's episodes differ much
REACHED = {
    "CartPole-v1": 500.0,
    "Acrobot-v1": -100.0,
    "MountainCar-v0": -115.0,
    "LunarLander-v3": 150.0,
    "MinAtar/asterix": 15.0,
    "MinAtar/breakout": 6.0,
    "MinAtar/freeway": 60.0,
    "MinAtar/seaquest": 10.0,
    "MinAtar/space_invaders": 15.0,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_plays_better_than_chance_and_than_any_one_action(name: str) -> None:
    task, seeds = TASKS[name], range(2000, 2003 if name == "MinAtar/freeway" else 2006)
    n = make_env(task).action_space.n  # type: ignore[attr-defined]
    others = [at_random(n, 0), *(held(action) for action in range(n))]
    mean, *rest = (
        np.mean([total for total, _ in evaluate(control, task, seeds)])
        for control in (scripted(name), *others)
    )
    assert mean >= REACHED[name]
    assert mean > max(rest)


def test_every_allowed_action_is_as_likely() -> None:
    act, batch = at_random(4, 0), np.zeros(6000)
    masks = np.tile([True, False, True, True], (6000, 1))
    counts = np.bincount(act(batch, masks), minlength=4)
    assert counts == pytest.approx([2000, 0, 2000, 2000], abs=150)
    assert np.bincount(act(batch, None)) == pytest.approx(4 * [1500], abs=150)
    task = load_suite("basics").tasks["masked_identity"]
    result = [total for total, _ in evaluate(at_random(30, 0), task, range(100))]
    assert np.mean(result) == pytest.approx(50 / 4, abs=1.0)  # one in four of the allowed is right


def test_the_action_that_is_held_is_the_best_on_validation_episodes(tmp_path: Path) -> None:
    preset = dataclasses.replace(load_suite("minatar"), final_episodes=2)
    task = dataclasses.replace(preset.tasks["freeway"], eval_episodes=2)
    preset = dataclasses.replace(preset, tasks={"freeway": task})
    folder = RunFolder(tmp_path / "run")
    about = run_control(preset, of_task("held", "freeway", 1), folder)
    assert about["action"] == 1  # up, which alone ever crosses the road
    rows = folder.rows("episodes")
    assert rows["seed"].tolist() == episode_seeds(1, 2)
    played = evaluate(held(1), task, episode_seeds(1, 2))
    assert list(zip(rows["return"], rows["length"], strict=True)) == played


def test_controls_are_runs_of_the_preset_and_can_be_stopped(tmp_path: Path) -> None:
    tiny = Classic("tiny")
    result = {cell.id for cell in expand(tiny.preset) if not cell.learns}
    assert {"cartpole-script-s0", "breakout-held-s0", "masked_identity-random-s0"} <= result
    assert "masked_identity-script-s0" not in result
    store = Store.open(tmp_path, "tiny", create=True)
    for name in ("cartpole-held-s0", "cartpole-script-s0"):
        cell = tiny.find(name)
        assert not run_cell(tiny, cell, store, lambda: True)
        assert not store.run(cell.id).is_complete()
    for cell in expand(tiny.preset):
        if not cell.learns:
            assert run_cell(tiny, cell, store)
            assert tiny.verdict(store.run(cell.id)).endswith("over 3 test episodes")
