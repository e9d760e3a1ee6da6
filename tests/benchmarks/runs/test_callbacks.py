"""The curve and the curriculum of a run: counted again from its episodes, a checkpoint between."""

import dataclasses
import pickle
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger

from benchmarks.methods.learners import build_model, make_training_env
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Curriculum
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder
from tests.benchmarks.smoke import smoke_preset

PRESET = smoke_preset()
TRACK = dataclasses.replace(PRESET.tracks["safe"], timesteps=6400)  # of 4 environments: 16 a row
Infos = list[dict[str, Any]]


def steps(number: int, share: float) -> Iterator[tuple[list[bool], Infos]]:
    """Steps of four environments, whose first and later episodes end well, as to this share."""
    rng = np.random.default_rng(0)
    for step in range(number):
        infos = [
            {
                "success": bool(rng.random() < share * (step < 2 or step >= number / 2)),
                "n_filled": int(rng.integers(7)), "singular": bool(rng.random() < 0.1),
                "time": rng.random(), "episode": {"r": rng.normal()},
            }
            for _ in range(4)
        ]  # fmt: skip
        yield (rng.random(4) < 0.3).tolist(), infos


def test_a_row_is_the_mean_of_the_episodes_and_updates_since_the_last() -> None:
    cell = Cell("dqn", "full", "optimized", "safe", 0)
    model: Any = build_model(PRESET, cell, make_training_env(PRESET, cell))
    model._last_obs = np.random.default_rng(1).random((4, 12), np.float32)
    model.exploration_rate = 0.3
    model.set_logger(Logger(None, []))
    curriculum = CurriculumCallback(TRACK.curriculum)
    curriculum.switched_at = 40

    def recorder(state: Any = None) -> CurveRecorder:
        made = CurveRecorder(TRACK, curriculum)
        made.init_callback(model)
        if state:
            made.set_state(pickle.loads(state))
        return made

    recorded, episodes, losses, rows, solved = recorder(), Infos(), list[float](), Infos(), None
    every, columns = Infos(), ("episode_reward", "holes", "success", "duration", "loss")
    for step, (dones, infos) in enumerate(steps(100, 0.95)):
        model.logger.record("train/loss", float(step))
        if step:
            losses.append(float(step))
        recorded.on_rollout_start()
        if step and step % 4 == 0:
            means = [[e["episode"]["r"], e["n_filled"], e["success"], e["time"]] for e in episodes]
            row = dict(zip(columns, [*np.mean(means, axis=0), np.mean(losses)], strict=True))
            recent = np.mean([e["success"] for e in every[-20:]])
            rows.append(row | {"timesteps": 4 * step, "episodes": len(every), "success_20": recent})
            episodes, losses = [], []
        if step == 61:  # in the midst of an interval
            recorded = recorder(pickle.dumps(recorded.get_state()))
        model.num_timesteps += 4
        recorded.update_locals({"dones": dones, "infos": infos})
        recorded.on_step()
        episodes += [info for done, info in zip(dones, infos, strict=True) if done]
        every += [info for done, info in zip(dones, infos, strict=True) if done]
        if solved is None and sum(e["success"] for e in every[-20:]) > 15:
            solved = model.num_timesteps
    assert len(rows) == len(recorded.rows) == 24
    for row, ours in zip(rows, recorded.rows, strict=True):
        assert {name: ours[name] for name in row} == pytest.approx(row)
    with torch.no_grad():
        values = model.policy.q_net(torch.as_tensor(model._last_obs)).numpy()
    assert ours["mean_max_q"] == pytest.approx(values.max(axis=1).mean())
    assert (ours["noise"], ours["learning_rate"]) == (0.3, TRACK.hyperparameters.learning_rate)
    assert solved
    recent = np.mean([e["success"] for e in every[-20:]])
    singular = sum(e["singular"] for e in every)
    assert recorded.summary() == {
        "steps_to_75": solved, "curriculum_switch": 40, "final_success_20": pytest.approx(recent),
        "singular_per_1000": pytest.approx(1000 * singular / len(every)), "singular": singular,
        "episodes": len(every), "successes": sum(e["success"] for e in every),
        "holes": sum(e["n_filled"] for e in every),
    }  # fmt: skip


def test_a_curve_has_at_most_so_many_rows_and_no_more_than_rounds_of_steps() -> None:
    def interval(n_envs: int, timesteps: int) -> int:
        h = dataclasses.replace(TRACK.hyperparameters, n_envs=n_envs)
        track = dataclasses.replace(TRACK, hyperparameters=h, timesteps=timesteps)
        return CurveRecorder(track, CurriculumCallback(track.curriculum)).interval

    assert [interval(1, 799), interval(1, 800), interval(4, 800)] == [2, 2, 4]


@pytest.mark.parametrize("share", [0.8, 1.0])
def test_the_stage_rises_once_when_enough_of_a_full_window_succeeded(share: float) -> None:
    settings = Curriculum(window=10, threshold=0.9)
    calls: list[tuple[str, int]] = []
    env = SimpleNamespace(env_method=lambda name, stage: calls.append((name, stage)))
    model: Any = SimpleNamespace(num_timesteps=0, get_env=lambda: env, logger=None)

    def callback(state: Any = None) -> CurriculumCallback:
        made = CurriculumCallback(settings, rows=2)
        made.init_callback(model)
        if state:
            made.set_state(pickle.loads(state))
        return made

    curriculum, ended, switched = callback(), list[bool](), None
    for dones, infos in steps(100, share):
        model.num_timesteps += 4
        # the second row of an environment is of its other agent, and no other episode
        batch = {"dones": np.repeat(dones, 2), "infos": [each for each in infos for _ in range(2)]}
        curriculum.update_locals(batch)
        curriculum.on_step()
        ended += [info["success"] for done, info in zip(dones, infos, strict=True) if done]
        if switched is None and len(ended) >= 10 and sum(ended[-10:]) > 9:
            switched = model.num_timesteps
        curriculum = callback(pickle.dumps(curriculum.get_state()))
    assert bool(switched) == (share == 1.0)
    assert (curriculum.switched_at, curriculum.stage) == (switched, int(share == 1.0))
    assert calls == [("set_stage", 1)] * (share == 1.0)
    assert CurriculumCallback(Curriculum(enabled=False)).stage == 1
