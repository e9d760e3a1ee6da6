"""What the twin shows: where things are, in the modes of the kinematic environment."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra physics")

from coop_env.errors import ArgumentError
from coop_env.geometry import DELTA
from coop_env.kinematics import delta, rrs
from coop_env.physics.env import CoopInsertionContactEnv

HERE = {"hole": 1, "error": [0.0, 0.0, 0.0, 0.0]}


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


def test_a_hole_that_stands_aside_is_seen_there() -> None:
    env = CoopInsertionContactEnv()
    env.reset(seed=0, options=HERE)
    nominal = env.scene()
    env.reset(seed=0, options={**HERE, "error": [0.003, -0.001, 0.0, 0.0]})
    moved = env.scene()
    shift = [0.003, -0.001, 0.0]
    for name in ("rrs_base_joints", "elbows", "platform_joints", "hole_mouths"):
        off = getattr(moved, name) - getattr(nominal, name)
        np.testing.assert_allclose(off, np.broadcast_to(shift, off.shape), atol=1e-6)
    np.testing.assert_allclose(moved.tip, nominal.tip, atol=1e-6)


def test_frames_change_and_the_end_is_told() -> None:
    env = CoopInsertionContactEnv(render_mode="rgb_array")
    env.render_kwargs = {"size": (160, 120), "samples": 1}
    env.reset(seed=0, options=HERE)
    first, over = env.render(), False
    down = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.float32)
    while not over:
        _, _, terminated, truncated, info = env.step(down)
        over = terminated or truncated
    assert info["success"]
    last = env.render()
    assert first.shape == last.shape == (120, 160, 3)
    assert (first != last).any()
    seen = env.scene()
    assert seen.status == "success"
    assert seen.filled.tolist() == [False, True, False, False, False, False]
    assert len(seen.trace) == round(info["time"] / 0.05) + 1
    assert "success" in seen.describe()


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ArgumentError, match="render_mode = 'webgl': must be None or one of"):
        CoopInsertionContactEnv(render_mode="webgl")
