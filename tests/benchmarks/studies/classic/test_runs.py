"""Runs of the public tasks: the protocol, exact resuming, the command from end to end."""

import dataclasses
import importlib
import itertools
import re
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
import yaml
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import model_policy
from benchmarks.protocol.plan import expand, of_task, settings
from benchmarks.protocol.presets import PRESETS, load_suite
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs.cell import run_cell
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic import envs
from benchmarks.studies.classic.experiment import Classic
from benchmarks.studies.classic.train import build_model, evaluate, run_learner
from sb3_rainbow import Rainbow
from tests.benchmarks.conftest import Command
from tests.benchmarks.smoke import preset_file, stop_after

pytest.importorskip("minatar", reason="needs the extra 'classic'")


TINY = load_suite("tiny")


def tiny_file(folder: Path, **changes: Any) -> Path:
    """The preset with other settings, as a file."""
    data = yaml.safe_load((PRESETS / "tiny.yaml").read_text(encoding="utf-8"))
    return preset_file(folder, data | changes, "changed")


@pytest.mark.parametrize(
    ("task", "method"),
    [
        *(("cartpole", "rainbow"), ("cartpole", "qrdqn"), ("masked_identity", "rainbow")),
        *(("breakout", "rainbow"), ("breakout", "dqn")),
    ],
)
def test_a_run_stopped_twice_is_the_whole_run(task: str, method: str, tmp_path: Path) -> None:
    cell = of_task(method, task, 0)
    whole = RunFolder(tmp_path / "whole")
    assert run_learner(TINY, cell, whole) is not None
    folder = RunFolder(tmp_path / "cut")
    assert run_learner(TINY, cell, folder, stop_after(20)) is None
    assert len(checkpoints(folder.checkpoint)) == 1
    assert run_learner(TINY, cell, folder, stop_after(15)) is None
    summary: Any = run_learner(TINY, cell, folder)
    assert len(summary["resumed_at"]) == 2
    assert summary["timesteps"] >= TINY.tasks[task].timesteps
    for name in ("curve", "episodes"):
        pd.testing.assert_frame_equal(folder.rows(name), whole.rows(name))


def test_box2d_resumes_with_other_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[Any] = []
    reset = DummyVecEnv.reset

    def noted(env: DummyVecEnv) -> Any:
        starts.append(reset(env))
        return starts[-1]

    monkeypatch.setattr(DummyVecEnv, "reset", noted)
    short = {"learning_starts": 50, "policy_kwargs": {"net_arch": [16]}, "train_freq": 4}
    lander = dataclasses.replace(
        load_suite("control").tasks["lunarlander"],
        timesteps=400, eval_every=400, eval_episodes=1, methods={"dqn": short},
    )  # fmt: skip
    preset = dataclasses.replace(TINY, tasks={"lunarlander": lander}, methods=["dqn"])
    folder = RunFolder(tmp_path / "run")
    cell = of_task("dqn", "lunarlander", 0)
    assert run_learner(preset, cell, folder, stop_after(40)) is None
    summary: Any = run_learner(preset, cell, folder)
    assert summary["timesteps"] == 400
    assert len(summary["resumed_at"]) == 1
    first, later = starts
    assert (first != later).any()


def test_how_often_a_policy_is_tested_changes_nothing(tmp_path: Path) -> None:
    cell = of_task("rainbow", "cartpole", 0)
    often = dataclasses.replace(TINY.tasks["cartpole"], eval_every=50)
    frequent = dataclasses.replace(TINY, tasks={"cartpole": often})
    folders = RunFolder(tmp_path / "seldom"), RunFolder(tmp_path / "often")
    for folder, what in zip(folders, (TINY, frequent), strict=True):
        run_learner(what, cell, folder)
    curve = folder.rows("curve")
    assert len(curve) > 10
    module = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    events = module.EventAccumulator(str(folder.tensorboard))
    events.Reload()
    shown = [(point.step, point.value) for point in events.Scalars("eval/mean_reward")]
    np.testing.assert_allclose(shown, curve[["timesteps", "return_mean"]], rtol=1e-6)
    seldom, frequently = (each.rows("episodes") for each in folders)
    pd.testing.assert_frame_equal(seldom, frequently)


def test_no_test_episode_is_one_of_training_or_validation() -> None:
    for name in ("public", "control", "minatar"):
        preset = load_suite(name)
        for cell in expand(preset):
            if not cell.learns:
                continue
            task = preset.tasks[cell.track]
            # SB3 seeds its environments with the learner's seed and the numbers after it
            first = derive("learner", cell.seed)
            training = set(range(first, first + task.n_envs))
            validation = set(episode_seeds(cell.seed, task.eval_episodes, "validate"))
            test = set(episode_seeds(cell.seed, preset.final_episodes, "test"))
            assert len(test) == preset.final_episodes
            assert not test & (training | validation)
            assert not validation & training


def test_evaluation_plays_each_seed_as_an_episode_of_its_own() -> None:
    task = TINY.tasks["cartpole"]
    model = build_model(task, "dqn", 0)
    seeds, env, expected = [11, 12, 13], gymnasium.make("CartPole-v1"), []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        steps, ended = 0, False
        while not ended:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            steps, ended = steps + 1, terminated or truncated
            assert reward == 1.0
        expected.append((steps, steps))
    assert evaluate(model_policy(model), task, seeds) == expected


def test_a_run_is_stored_planned_and_reported(tmp_path: Path, done: Command) -> None:
    tasks = yaml.safe_load((PRESETS / "tiny.yaml").read_text(encoding="utf-8"))["tasks"]
    few = {"masked_identity": tasks["masked_identity"]}
    path = tiny_file(tmp_path, methods=["rainbow"], tasks=few)
    one = Classic(str(path))
    store = one.open_store(tmp_path / "results", create=True)
    assert run_cell(one, one.find("masked_identity-rainbow-s0"), store)
    words = ["--preset", str(path), "--results", str(tmp_path / "results")]
    assert "Masked identity" in done("tables", *words)
    done("figures", *words)
    folder = tmp_path / "results" / "classic" / "changed"
    assert (folder / "tables" / "scores.csv").is_file()
    assert (folder / "figures" / "curves.png").read_bytes()[:4] == b"\x89PNG"
    meta = RunFolder(folder / "runs" / "masked_identity-rainbow-s0").meta()
    assert meta["training"]["timesteps"] == 300
    assert "sb3-contrib" in meta["versions"]
    assert sum(p.stat().st_size for p in (folder / "runs").rglob("*.*")) < 20_000
    report = done("plan", *words)
    assert "3 cells of preset 'changed'" in report
    assert ", 2 to run" in report


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"methods": ["a2c"]}, "unknown method 'a2c'; known: "),
        ({"methods": ["dqn", "dqn"]}, "methods: needs one value or more"),
        ({"tasks": {"cartpol": {}}}, "tasks: cartpol: unknown base 'cartpol'; known: "),
        ({"controls": ["held"], "search": True}, "controls: a search compares settings"),
        ({"controls": ["oracle"]}, "controls: unknown 'oracle'; known: held, random, script"),
        ({"methods": ["rainbow_x"]}, "methods has no settings for 'rainbow_x'"),
        ({"method_seeds": {"a2c": [1]}}, "method_seeds: 'a2c' is not among methods and controls"),
    ],
)
def test_bad_presets_are_refused(change: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=re.escape(message)):
        load_suite(str(tiny_file(tmp_path, **change)))


TURNED = partial(FakeImageEnv, screen_height=36, screen_width=36, channel_first=False)


@pytest.mark.parametrize(
    ("method", "change", "message"),
    [
        ("dqn", {"env_kwargs": {"no_such": 1}}, "cartpole-dqn-s0 cannot be built: .*no_such"),
        ("dqn", {"policy": "NoPolicy"}, "NoPolicy"),
        ("dqn", {"methods": {"dqn": {"learning_rate": "lin_fast"}}}, "'fast'"),
        ("dqn", {"methods": {"dqn": {"lerning_rate": 1.0}}}, "no argument 'lerning_rate'"),
        ("dqn", {"methods": {"dqn": {"seed": 1}}}, "no argument 'seed'"),
        ("dqn", {"methods": {"dqn": {"learning_rate": "1e-3"}}}, "1.0e-3"),
        ("dqn", {"env": "Turned", "policy": "CnnPolicy", "methods": {"dqn": {}}}, "channels last"),
        ("random", {"env": "Pendulum-v1"}, "controls play numbers"),
        ("random", {"env": "CartPool-v1"}, "CartPool"),
    ],
)
def test_what_cannot_be_built_is_said_before_anything_runs(
    method: str, change: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(envs.BY_NAME, "Turned", TURNED)
    tasks = {"cartpole": dataclasses.replace(TINY.tasks["cartpole"], **change)}
    one = Classic(dataclasses.replace(TINY, tasks=tasks, methods=["dqn"], controls=["random"]))
    with pytest.raises(BenchmarkError, match=message):
        one.check([cell for cell in one.cells if cell.method == method])


def test_a_check_before_the_start_leaves_the_settings_as_they_are() -> None:
    """SB3 writes the optimizer's class into policy_kwargs, which no config.yaml can hold."""
    preset = load_suite("public")
    before = repr(preset)
    for name, method in itertools.product(("cartpole", "breakout"), preset.methods):
        env: Any = build_model(preset.tasks[name], method, 0).get_env()
        env.close()
    assert repr(preset) == before


def test_a_task_gives_arguments_to_all_methods_and_skips_some() -> None:
    preset = load_suite("changes")
    cells = [cell for cell in expand(preset) if cell.track == "changed_bits"]
    assert {preset.methods[i] for i in (0, -2, -1)} <= {cell.method for cell in cells}
    assert "rainbow_one_step" not in {cell.method for cell in cells}
    stored = settings(preset, next(cell for cell in cells if cell.method == "rainbow_tau_0.001"))
    own = {"learning_rate": 1e-3, "tau": 1e-3}
    assert stored["arguments"] == {"replay_buffer_class": "HerReplayBuffer", **own}
    with pytest.warns(UserWarning, match="prioritized=False, n_steps=1"):
        model = build_model(preset.tasks["changed_bits"], "rainbow_tau_0.001", 0)
    assert isinstance(model, Rainbow)
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    task = preset.tasks["changed_bits"]
    scores = evaluate(model_policy(model), task, [1, 2, 3])  # of dictionaries
    assert all(-8.0 <= total <= 0.0 and length <= 8 for total, length in scores)


def test_a_method_may_have_seeds_of_its_own() -> None:
    preset = load_suite("control")
    for name in (*preset.methods, *preset.controls):
        seeds = {cell.seed for cell in expand(preset) if cell.method == name}
        assert seeds == ({11, 12, 13, 14, 15} if name == "rainbow" else {*preset.seeds})


def test_a_task_may_have_seeds_of_its_own() -> None:
    own = {"cartpole": dataclasses.replace(TINY.tasks["cartpole"], seeds=[7])}
    cells = expand(dataclasses.replace(TINY, tasks=TINY.tasks | own))
    assert {cell.seed for cell in cells if cell.track == "cartpole"} == {7}
    assert {cell.seed for cell in cells if cell.track != "cartpole"} == {0}
