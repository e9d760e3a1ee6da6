"""Learners of the contact task: whom the script guides, how runs resume, what tables say."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium import spaces

from benchmarks.errors import BenchmarkError
from benchmarks.methods.guided import Guided
from benchmarks.methods.learners import class_on
from benchmarks.protocol.plan import of_task
from benchmarks.protocol.presets import Guide, SuitePreset, Task, load_suite
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic.train import build_model, make_env, run_learner
from benchmarks.studies.robots import trials
from benchmarks.studies.robots.contact import SEARCH, make
from tests.benchmarks.smoke import stop_after

pytest.importorskip("mujoco", reason="needs the extra physics")

METHODS = ("sac", "crossq", "td3", "ppo", "rainbow", "dqn", "bc")
# sac is as crossq, dqn as rainbow
RESUMED = ["ppo", "rainbow"]
RESUMED_SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("crossq", "td3", "bc")]


def tiny(steps: int = 120, noise: float = 0.0) -> SuitePreset:
    """The preset's own task and settings, for a few steps and of shorter episodes."""
    preset = load_suite("contact")
    task: Any = preset.tasks["standard"]
    short: dict[str, dict[str, Any]] = {name: dict(task.methods[name]) for name in METHODS}
    for arguments in short.values():
        arguments |= {"buffer_size": 1_000, "learning_starts": 40, "batch_size": 16}
        arguments["policy_kwargs"] = {"net_arch": [16]}
    del short["td3"]["guide"]
    short["ppo"] = {"n_steps": 60, "batch_size": 20}
    guide = replace(task.guide, steps=80, noise=noise)
    task = replace(
        task, timesteps=steps, eval_every=60, eval_episodes=1, methods=short, guide=guide,
        env_kwargs={**task.env_kwargs, "max_steps": 25},
    )  # fmt: skip
    return replace(preset, tasks={"standard": task}, final_episodes=1)


def stored(method: str, noise: float, steps: int = 80) -> tuple[Any, Task]:
    """A model after the script's own steps, and its task."""
    task = tiny(noise=noise).tasks["standard"]
    return build_model(task, method, 0).learn(steps), task


def of_the_script(model: Any, task: Task) -> tuple[Any, Any, Any]:
    """What was observed (80, 29), what the memory says was done, and the script's (80, 6)."""
    assert task.guide is not None
    script = trials.script_of(SEARCH, make("standard"), task.guide.gains)
    buffer = model.replay_buffer
    observed, actions = buffer.observations[:80, 0], buffer.actions[:80, 0]
    return observed, actions, np.array([script(each) for each in observed])


def test_the_first_steps_are_the_scripts() -> None:
    _, actions, script = of_the_script(*stored("sac", 0.0))
    np.testing.assert_allclose(actions, script, atol=1e-6)


def test_of_twelve_moves_the_script_takes_those_it_would_go_along() -> None:
    from coop_env.physics.env import move

    _, actions, script = of_the_script(*stored("dqn", 0.0))
    for action, increments in zip(actions, script, strict=True):
        assert move(int(action[0])) @ increments >= 0.0


def test_a_clone_keeps_what_the_script_wanted_and_goes_elsewhere() -> None:
    """The stored action is the script's; the last action, of which the state tells, has noise."""
    model, task = stored("bc", 0.3)
    observed, wanted, script = of_the_script(model, task)
    np.testing.assert_allclose(wanted, script, atol=1e-6)
    following = model.replay_buffer.dones[:79, 0] == 0.0
    made = observed[1:, 23:][following]
    assert np.std(made - wanted[:79][following]) > 0.1


def test_a_clone_comes_to_do_what_the_script_does() -> None:
    model, _ = stored("bc", 0.3, steps=800)
    batch = model.replay_buffer.sample(256)
    with torch.no_grad():
        left = torch.nn.functional.mse_loss(model.actor(batch.observations), batch.actions)
    assert float(left) < 0.3 * float(batch.actions.var())


@pytest.mark.parametrize("method", [*RESUMED, *RESUMED_SLOW])
def test_a_stopped_run_is_the_run_that_was_not(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "EPISODES", 1)
    preset, cell = tiny(noise=0.3), of_task(method, "standard", 0)
    whole, cut = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "cut")
    assert run_learner(preset, cell, whole) is not None
    rounds = 2 if method == "ppo" else 50
    assert run_learner(preset, cell, cut, stop_after(rounds - 1)) is None
    summary: Any = run_learner(preset, cell, cut)
    assert summary["resumed_at"]
    rows = cut.rows("contact")
    assert len(rows) == 7
    assert set(rows["error"].fillna(-1.0)) == {0.0, 1.0, 2.0, 3.0, 4.0, 5.0, -1.0}
    assert (cut.rows("curve")["timesteps"].iloc[-1]) == 120
    for name in ("contact", "curve", "episodes"):
        pd.testing.assert_frame_equal(cut.rows(name), whole.rows(name))
    task = preset.tasks["standard"]
    kept = class_on(task, method).load(cut.policy, device="cpu")
    discrete = isinstance(kept.action_space, spaces.Discrete)
    again = pd.DataFrame(trials.on_tests(kept, make_env(task, discrete)))
    for name in ("success", "time", "force"):
        assert again[name].tolist() == rows[name].tolist()


def test_a_method_may_change_its_guide() -> None:
    task: Any = load_suite("contact").tasks["standard"]
    for method, noise in (("sac", task.guide.noise), ("td3", 1.0)):
        model = build_model(task, method, 0)
        assert isinstance(model, Guided)
        assert model._guide.noise == noise
    wrong = replace(task, methods={"td3": {**task.methods["td3"], "guide": {"nois": 1.0}}})
    with pytest.raises(BenchmarkError, match="standard: td3: guide: unknown key 'nois'"):
        build_model(wrong, "td3", 0)


def test_what_cannot_be_guided_is_said() -> None:
    task = tiny().tasks["standard"]
    with pytest.raises(BenchmarkError, match="bc learns from a script: give the task a guide"):
        build_model(replace(task, guide=None), "bc", 0)
    wrong = replace(task, guide=Guide(10, 0.1, {"hodl": 3.0}))
    with pytest.raises(BenchmarkError, match="unknown gain 'hodl'; known: "):
        build_model(wrong, "sac", 0)
