"""The collision kernel against densely sampled bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from coop_env import CoopInsertionEnv
from coop_env.kinematics.rrs_kernels import limb_points
from coop_env.simulation.collision import (
    arm_points,
    collides,
    point_segment_distance,
    segment_distance,
)
from coop_env.simulation.state import Configuration, joint_angles

Points = NDArray[np.float64]
Point = tuple[float, float, float]
coordinate = st.floats(-1.0, 1.0).map(lambda v: round(v, 3))
point = st.tuples(coordinate, coordinate, coordinate)


def sampled(a: ArrayLike, b: ArrayLike, n: int = 61) -> Points:
    t = np.linspace(0.0, 1.0, n)[:, None]
    return (1.0 - t) * np.asarray(a) + t * np.asarray(b)


def least(a: Points, b: Points) -> float:
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min())


@settings(max_examples=150, deadline=None, derandomize=True)
@given(point, point, point, point)
def test_segment_distance_is_the_least_over_both_segments(
    a: Point, b: Point, c: Point, d: Point
) -> None:
    got = segment_distance(a, b, c, d)
    expected = least(sampled(np.array(a), np.array(b)), sampled(np.array(c), np.array(d)))
    spacing = max(np.linalg.norm(np.subtract(b, a)), np.linalg.norm(np.subtract(d, c))) / 60
    assert expected - 2.0 * spacing <= got <= expected + 1e-12
    assert abs(got - segment_distance(c, d, b, a)) < 1e-9


@settings(max_examples=100, deadline=None, derandomize=True)
@given(point, point, point)
def test_point_segment_distance(p: Point, a: Point, b: Point) -> None:
    got = point_segment_distance(p, a, b)
    expected = least(np.array(p)[None], sampled(np.array(a), np.array(b), 2001))
    assert expected - np.linalg.norm(np.subtract(b, a)) / 2000 <= got <= expected + 1e-12


def clearance(env: CoopInsertionEnv, c: Configuration) -> float:
    """Least gap between the two robots' bodies, all sampled, with the chamfer's exemption."""
    p, task = env.params, env.task
    _, theta, pose, q = joint_angles(c, p)
    x, y, z = c[0], c[1], c[2] + p.delta.base_height
    tip, effector = np.array([x, y, z - p.delta.peg_length]), np.array([x, y, z])
    rotation = np.array(pose[3:]).reshape(3, 3)
    centre = np.array(pose[:3])
    peg = (sampled(tip + np.array([0, 0, p.delta.peg_radius]), effector), p.delta.peg_radius)
    arms = [arm_points(c[0], c[1], c[2], theta, i, p.delta) for i in range(3)]
    upper = [peg, (effector[None], task.effector_radius)]
    upper += [(sampled(knee, joint), task.forearm_radius) for _, knee, joint in arms]
    limbs = [limb_points(pose, q[i], i, p.rrs) for i in range(3)]
    lower = [(sampled(centre, joint), task.spoke_radius) for _, _, joint in limbs]
    lower += [(sampled(elbow, joint), task.limb_radius) for _, elbow, joint in limbs]
    lower += [(sampled(base, elbow), task.limb_radius) for base, elbow, _ in limbs]
    mouths = centre + task.dome_radius * np.array(task.hole_normals) @ rotation.T
    exempt = np.linalg.norm(mouths - tip, axis=1).min() < p.task.chamfer + p.delta.peg_radius
    gaps = [least(a, b) - ra - rb for a, ra in upper for b, rb in lower]
    for k, (a, ra) in enumerate(upper):
        if k > 0 or not exempt:
            gaps.append(least(a, centre[None]) - ra - task.dome_radius)
    return min(gaps)


THICK = {
    "dome_radius": 0.11, "chamfer": 0.02, "holes": [(0.2, 1.0 * k) for k in range(6)],
    "effector_radius": 0.06, "forearm_radius": 0.03, "spoke_radius": 0.025, "limb_radius": 0.02,
}  # fmt: skip


@pytest.mark.parametrize("task", [{}, THICK], ids=["paper", "thick"])
def test_configurations_collide_when_their_sampled_bodies_do(task: dict[str, Any]) -> None:
    env = CoopInsertionEnv(task=task)
    rng = np.random.default_rng(0)
    counts = {True: 0, False: 0}
    while min(counts.values()) < 40:
        x, y = rng.uniform(-0.16, 0.16, 2)
        roll, pitch = rng.uniform(-0.6, 0.6, 2)
        c = (x, y, rng.uniform(-0.65, -0.4), roll, pitch, rng.uniform(0.21, 0.25))
        valid, theta, pose, q = joint_angles(c, env.params)
        if not valid:
            continue
        gap = clearance(env, c)
        if abs(gap) < 0.006:  # finer than the sampling
            continue
        hit = collides(c[0], c[1], c[2], theta, pose, q, env.params)
        assert hit == (gap < 0.0)
        counts[hit] += 1


def test_an_effector_thicker_than_the_peg_is_long_collides_before_the_peg_does() -> None:
    env = CoopInsertionEnv(delta={"peg_length": 0.01})
    delta, task = env.params.delta, env.task
    for gap in (-0.002, 0.002):  # between the effector's ball and the top of the dome
        centre = 0.21 + task.dome_radius + task.effector_radius + gap
        c = (0.0, 0.0, centre - delta.base_height, 0.0, 0.0, 0.21)
        assert (clearance(env, c) < 0.0) == (gap < 0.0)
        assert env.configuration_status(c) == (2 if gap < 0.0 else 0)


def test_the_peg_may_touch_the_dome_only_inside_a_chamfer() -> None:
    env = CoopInsertionEnv()
    statuses = []
    for pitch in (-np.radians(10.0), 0.0):  # a hole's mouth at the top, or the bare apex
        _, _, pose, _ = joint_angles((0.0, 0.0, -0.3, 0.0, pitch, 0.22), env.params)
        four_mm_deep = pose.z + 0.10 - 0.004 + 0.08 - 0.85
        statuses.append(
            env.configuration_status((pose.x, pose.y, four_mm_deep, 0.0, pitch, pose.z))
        )
    assert statuses == [0, 2]
