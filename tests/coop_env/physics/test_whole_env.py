"""The whole task in increments: starts, insertions, bad input; what the twin shows."""

from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import coop_env
from coop_env.env import CoopInsertionEnv
from coop_env.errors import ResetOptionError
from coop_env.geometry import DELTA
from coop_env.kinematics import delta, rrs
from coop_env.physics.env import CoopInsertionContactEnv, CoopInsertionPhysicsEnv
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from tests.coop_env.physics.episodes import NO_ERROR, PUSH, REST, above, steps


def lead(env: CoopInsertionPhysicsEnv, to: np.ndarray, n: int) -> None:
    """Straight to a configuration."""
    start = env.configuration
    for k in range(1, n + 1):
        env.batch.advance((start + (to - start) * (k / n))[None])


def test_a_seed_gives_the_kinematic_tasks_start() -> None:
    env, kinematic = CoopInsertionPhysicsEnv(), coop_env.CoopInsertionEnv()
    for seed in range(3):
        _, info = env.reset(seed=seed)
        kinematic.reset(seed=seed)
        np.testing.assert_array_equal(env.configuration, kinematic.configuration)
        assert info["target"] == kinematic.state["target"]


def test_an_aligned_hole_is_off_by_the_error() -> None:
    env = CoopInsertionPhysicsEnv()
    for hole in range(6):
        options = {**above(hole), "error": [0.002, -0.001, 0.01, -0.01]}
        _, info = env.reset(seed=0, options=options)
        assert info["lateral_error"] == pytest.approx(np.hypot(0.002, 0.001), abs=5e-4)
        assert info["alignment_error"] == pytest.approx(np.hypot(0.01, 0.01), abs=1e-4)


def test_holes_are_filled_one_after_another() -> None:
    env = CoopInsertionPhysicsEnv(level=NO_ERROR)
    inserted = []
    for step in steps(env, 0.2 * PUSH, **above(4), filled=[0, 1, 2, 3]):
        if step["inserted"]:
            inserted.append(step)
            assert step["reward_terms"]["insertion"] == 20.0
            assert step["depth"] >= 0.01
        if step["inserted"] and not step["terminated"]:  # out again, and over to the other
            lead(env, above(4)["configuration"], 4)
            lead(env, above(5)["configuration"], 6)
    first, last = inserted
    assert (first["inserted_hole"], first["target"]) == (4, 5)
    assert (first["success"], first["terminated"]) == (True, False)
    assert (last["inserted_hole"], last["n_filled"]) == (5, 6)
    assert (last["terminated"], last["failure"]) == (True, "")
    assert last["peak_force"] < 3.0
    with pytest.raises(ResetNeeded):
        env.step(REST)


HERE: dict[str, Any] = {"hole": 1, "error": [0.0, 0.0, 0.0, 0.0]}


def test_at_rest_the_links_are_where_the_kinematics_have_them() -> None:
    env = CoopInsertionContactEnv()
    env.reset(seed=0, options=HERE)
    seen, c = env.scene(), env.configuration
    limbs = rrs.limb_points(c[3:])
    shown = np.stack([seen.rrs_base_joints, seen.elbows, seen.platform_joints], axis=1)
    np.testing.assert_allclose(shown, limbs, atol=1e-6)
    arms = delta.limb_points(c[:3], DELTA) + np.array([0.0, 0.0, DELTA.base_height])
    shown = np.stack([seen.delta_base_joints, seen.knees, seen.effector_joints], axis=1)
    np.testing.assert_allclose(shown, arms, atol=1e-6)
    pose = rrs.platform_pose(c[3:])
    np.testing.assert_allclose(seen.platform_centre, pose.position, atol=1e-6)
    np.testing.assert_allclose(seen.platform_rotation, pose.rotation, atol=1e-6)
    assert seen.status == "running"
    assert seen.distance == pytest.approx(0.010, abs=1e-5)


def test_a_hole_is_seen_where_it_stands_and_filled_when_it_is() -> None:
    env = CoopInsertionContactEnv(render_mode="ansi")
    *_, info = steps(env, PUSH.astype(np.float32), **HERE)
    assert "success" in env.render()
    assert env.scene().filled.tolist() == [False, True, False, False, False, False]
    assert len(env.scene().trace) == round(info["time"] / 0.05) + 1
    env.reset(seed=0, options=HERE)
    nominal = env.scene()
    env.reset(seed=0, options={**HERE, "error": [0.003, -0.001, 0.0, 0.0]})
    moved = env.scene()
    shift = [0.003, -0.001, 0.0]
    for name in ("rrs_base_joints", "elbows", "platform_joints", "hole_mouths"):
        off = getattr(moved, name) - getattr(nominal, name)
        np.testing.assert_allclose(off, np.broadcast_to(shift, off.shape), atol=1e-6)
    np.testing.assert_allclose(moved.tip, nominal.tip, atol=1e-6)


@pytest.mark.parametrize("knobs", [None, {"force_noise": 1.0}])
@pytest.mark.parametrize("env_class", [CoopInsertionPhysicsEnv, CoopInsertionPhysicsDiscreteEnv])
def test_a_start_in_which_the_twins_bodies_overlap_is_refused(env_class: Any, knobs: Any) -> None:
    """The kinematic model, whose platform has spokes, allows it."""
    env = env_class(sim_to_real=knobs)
    env.reset(seed=0)
    start, before = [-0.069, -0.058, -0.491, -0.346, 0.543, 0.23], env.configuration
    assert CoopInsertionEnv().configuration_status(start) == 0
    with pytest.raises(ResetOptionError, match=r"'platform_disc' and 'peg' .* overlap there"):
        env.reset(options={"configuration": start})
    np.testing.assert_array_equal(env.configuration, before)  # the episode goes on
    env.step(env.action_space.sample())
    start[2] += 0.02
    env.reset(options={"configuration": start, "error": [0.0] * 4})
    with pytest.raises(ResetOptionError, match=r"overlap there"):
        env.reset(options={"configuration": start, "error": [0.0, 0.0, 0.1, 0.1]})
