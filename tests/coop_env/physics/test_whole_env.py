"""The whole task in increments: checkers, starts, insertions, ends, bad input."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")

from stable_baselines3.common.env_checker import check_env as sb3_check_env

import coop_env
from coop_env.errors import ActionError, ArgumentError, ResetOptionError
from coop_env.physics.env import CoopInsertionPhysicsEnv
from coop_env.physics.task import start_configurations

NO_ERROR = {"position_error": 0.0, "tilt_error": 0.0}
REST = np.zeros(6)


def above(env: CoopInsertionPhysicsEnv, hole: int) -> np.ndarray:
    """10 mm above a hole's mouth, aligned."""
    return start_configurations(env.batch.machine, env.task.start_height)[hole]


def lead(env: CoopInsertionPhysicsEnv, to: np.ndarray, steps: int) -> None:
    """Straight to a configuration."""
    start = env.configuration
    for k in range(1, steps + 1):
        env.batch.advance((start + (to - start) * (k / steps))[None])


def play(env: CoopInsertionPhysicsEnv, action: Any, most: int) -> dict[str, Any]:
    """Repeat an action until the episode ends or something is inserted; the last info."""
    for _ in range(most):
        observation, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(observation).all()
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        if terminated or truncated or info["inserted"]:
            return {**info, "terminated": terminated, "truncated": truncated}
    return info


def test_checkers() -> None:
    check_env(gym.make("CoopInsertionPhysics-v0").unwrapped, skip_render_check=True)
    sb3_check_env(gym.make("CoopInsertionPhysics-v0").unwrapped)


def test_a_seed_gives_the_kinematic_tasks_start() -> None:
    env, kinematic = CoopInsertionPhysicsEnv(), coop_env.CoopInsertionEnv()
    for seed in range(3):
        _, info = env.reset(seed=seed)
        kinematic.reset(seed=seed)
        np.testing.assert_array_equal(env.configuration, kinematic.configuration)
        assert info["target"] == kinematic.state["target"]
        error = env.batch.error[0].copy()
        env.reset(seed=seed)
        np.testing.assert_array_equal(env.batch.error[0], error)


def test_an_aligned_hole_is_off_by_the_error() -> None:
    env = CoopInsertionPhysicsEnv()
    for hole in range(6):
        options = {"configuration": above(env, hole), "error": [0.002, -0.001, 0.01, -0.01]}
        _, info = env.reset(seed=0, options={**options, "target": hole})
        assert info["lateral_error"] == pytest.approx(np.hypot(0.002, 0.001), abs=5e-4)
        assert info["alignment_error"] == pytest.approx(np.hypot(0.01, 0.01), abs=1e-4)


def test_holes_are_filled_one_after_another() -> None:
    env = CoopInsertionPhysicsEnv(level=NO_ERROR)
    start = above(env, 4)
    options = {"configuration": start, "target": 4, "filled": [0, 1, 2, 3]}
    env.reset(seed=0, options=options)
    down = np.array([0.0, 0.0, -0.2, 0.0, 0.0, 0.0])
    first = play(env, down, 60)
    assert first["inserted"]
    assert first["inserted_hole"] == 4
    assert first["success"]
    assert first["target"] == 5
    assert not first["terminated"]
    assert first["depth"] >= 0.01
    assert first["reward_terms"]["insertion"] == 20.0
    lead(env, start, 4)
    lead(env, above(env, 5), 6)
    last = play(env, down, 60)
    assert last["inserted_hole"] == 5
    assert last["terminated"]
    assert last["failure"] == ""
    assert last["n_filled"] == 6
    assert last["peak_force"] < 3.0
    with pytest.raises(ResetNeeded):
        env.step(REST)


def test_a_simulation_that_diverges_ends_the_episode_without_nan() -> None:
    env = CoopInsertionPhysicsEnv()
    env.reset(seed=0)
    env.step(REST)
    env.batch.twin.states[0, -21:] = 1e12
    observation, reward, terminated, _, info = env.step(REST)
    assert info["failure"] == "diverged"
    assert terminated
    assert np.isfinite(observation).all()
    assert np.isfinite(reward)


def test_bad_input_is_refused() -> None:
    env = CoopInsertionPhysicsEnv()
    with pytest.raises(ResetNeeded):
        env.step(REST)
    env.reset(seed=0)
    before = env.configuration
    for action in (np.full(6, np.nan), np.full(6, 2.0), np.zeros(5), "up"):
        with pytest.raises(ActionError):
            env.step(action)
    malformed: list[Any] = [{"error": [1.0]}, {"friction": -1.0}, {"hole": 1}, {"target": 9}, 3]
    for options in malformed:
        with pytest.raises(ResetOptionError):
            env.reset(options=options)
    np.testing.assert_array_equal(env.configuration, before)
    env.step(REST)
    for wrong in ({"level": "none"}, {"max_steps": 0}, {"stage": 2}, {"render_mode": "x"}):
        with pytest.raises(ArgumentError):
            CoopInsertionPhysicsEnv(**wrong)


def test_a_command_beyond_the_robots_is_not_taken() -> None:
    env = CoopInsertionPhysicsEnv()
    env.reset(seed=0)
    for _ in range(80):
        *_, info = env.step([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert info["violation"]
    assert info["failure"] == ""
    assert env.scene().status == "running"
