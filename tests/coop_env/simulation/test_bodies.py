"""How thick the forearms are, and that an entry into a filled hole is counted once."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv
from coop_env.kinematics.rrs_kernels import limb_points
from coop_env.simulation.collision import (
    arm_points,
    point_segment_distance,
    segment_distance,
)
from coop_env.simulation.state import Configuration, joint_angles

FREE, COLLISION = 0, 2
# a forearm alone touches the dome; in the last a spoke, and the link that ends there
LEANING = (
    (0.0884, -0.1160, -0.5697, -0.1712, 0.2817, 0.2463),
    (0.0965, 0.1093, -0.6075, -0.1198, -0.4106, 0.2360),
    (0.1406, 0.0571, -0.6020, 0.0404, -0.5056, 0.2426),
)


def clearances(env: CoopInsertionEnv, c: Configuration) -> tuple[float, float]:
    """Least gap of the forearms' axes, and of the other bodies' surfaces, to the 3-RRS, m."""
    p = env.params
    _, theta, pose, q = joint_angles(c, p)
    effector = (c[0], c[1], c[2] + p.delta.base_height)
    radius = p.delta.peg_radius
    peg = (*effector[:2], effector[2] - p.delta.peg_length + radius)
    centre = (pose.x, pose.y, pose.z)
    limbs = [limb_points(pose, q[i], i, p.rrs) for i in range(3)]
    thin = [(centre, joint) for _, _, joint in limbs]
    thin += [pair for base, elbow, joint in limbs for pair in ((base, elbow), (elbow, joint))]
    arms = [arm_points(c[0], c[1], c[2], theta, i, p.delta)[1:] for i in range(3)]
    spans = [*arms, (peg, effector), (effector, effector)]
    gaps = [
        min(
            point_segment_distance(centre, a, b) - 0.10,
            *(segment_distance(a, b, d, e) - 0.008 for d, e in thin),
        )
        for a, b in spans
    ]
    return min(gaps[:3]), min(gaps[3] - radius, gaps[4] - 0.04)


@pytest.mark.parametrize("leaning", LEANING)
def test_a_forearm_touches_at_ten_millimetres(leaning: Configuration) -> None:
    env = CoopInsertionEnv()
    x, y, z, roll, pitch, heave = leaning
    touching, free = z, z + 0.06
    assert env.configuration_status(leaning) == COLLISION
    assert env.configuration_status((x, y, free, roll, pitch, heave)) == FREE
    while free - touching > 1e-7:
        middle = 0.5 * (free + touching)
        if env.configuration_status((x, y, middle, roll, pitch, heave)) == FREE:
            free = middle
        else:
            touching = middle
    forearm, others = clearances(env, (x, y, free, roll, pitch, heave))
    assert forearm == pytest.approx(0.010, abs=1e-6)
    assert others > 0.005


def test_staying_in_a_filled_hole_is_no_duplicate() -> None:
    env, oracle = CoopInsertionEnv(), LatticeOracle()
    stayed = refused = entered = 0
    for seed in range(4):
        env.reset(seed=seed)
        moves = oracle.plan(env).moves
        assert moves is not None
        for move in moves:
            info = env.step(int(move))[4]
        assert info["inserted"]
        assert not info["duplicate"]
        there = env.get_state()
        for action in range(12):
            env.set_state(there)
            info = env.step(action)[4]
            assert not info["duplicate"]
            inside = bool(env.state["inside"].any())
            refused += info["violation"]
            stayed += inside and not info["violation"]
            if not inside and not env.state["over"]:
                back = env.step(action ^ 1)[4]  # the move that undoes it
                assert back["duplicate"] == bool(np.any(env.state["inside"]))
                entered += back["duplicate"]
    assert min(stayed, refused, entered) > 3
