"""The collision kernel against all pairs of bodies; an entry into a filled hole counts once."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv
from coop_env.geometry import DELTA, OPTIMIZED, DeltaGeometry
from coop_env.kinematics import delta, rrs
from coop_env.simulation.collision import (
    ceiling,
    collides,
    lowest,
    point_segment_distance,
    segment_distance,
)
from coop_env.simulation.state import Configuration, joint_angles
from tests.coop_env.simulation.bodies import gap

Points = NDArray[np.float64]
Point = tuple[float, float, float]
coordinate = st.floats(-1.0, 1.0).map(lambda v: round(v, 3))
point = st.tuples(coordinate, coordinate, coordinate)


def sampled(a: ArrayLike, b: ArrayLike, n: int = 61) -> Points:
    t = np.linspace(0.0, 1.0, n)[:, None]
    return (1.0 - t) * np.asarray(a) + t * np.asarray(b)


def least(a: Points, b: Points) -> float:
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min())


@settings(max_examples=150)
@given(point, point, point, point)
def test_distances_of_segments_are_the_least_over_their_points(
    a: Point, b: Point, c: Point, d: Point
) -> None:
    got = segment_distance(a, b, c, d)
    expected = least(sampled(a, b), sampled(c, d))
    length, other = np.linalg.norm(np.subtract([b, d], [a, c]), axis=1)
    assert expected - 2.0 * max(length, other) / 60 <= got <= expected + 1e-12
    assert abs(got - segment_distance(c, d, b, a)) < 1e-9
    got = point_segment_distance(c, a, b)
    expected = least(np.array([c]), sampled(a, b, 2001))
    assert expected - length / 2000 <= got <= expected + 1e-12


def clearance(env: CoopInsertionEnv, c: Configuration, robot: DeltaGeometry = DELTA) -> float:
    """The gap at a configuration of the nominal machine."""
    up, platform = np.array([0.0, 0.0, robot.base_height]), rrs.platform_pose(c[3:])
    mouths = platform.position + env.task.dome_radius * (
        np.array(env.task.hole_normals) @ platform.rotation.T
    )
    arms = delta.limb_points(c[:3], robot) + up
    limbs, chamfer = rrs.limb_points(c[3:]), env.task.chamfer
    return gap(env, np.array(c[:3]) + up, arms, platform.position, limbs, mouths, chamfer)


THICK = {
    "dome_radius": 0.11, "chamfer": 0.02, "holes": [(0.2, 1.0 * k) for k in range(6)],
    "effector_radius": 0.06, "forearm_radius": 0.03, "spoke_radius": 0.025, "limb_radius": 0.02,
}  # fmt: skip


FLAT = {"dome_radius": 0.03, "limb_radius": 0.1}  # links reach higher than dome and spokes
LONG = {"proximal_length": 0.3, "distal_length": 0.35, "base_height": 0.55, "peg_length": 0.03}


@pytest.mark.parametrize(
    ("task", "arms", "heights"),
    [
        ({}, {}, (-0.65, -0.4)),
        (THICK, {}, (-0.65, -0.4)),
        (FLAT, {}, (-0.5, -0.36)),
        ({}, LONG, (-0.3, -0.05)),  # knees hang below the effector
    ],
    ids=["paper", "thick", "flat", "long"],
)
def test_configurations_collide_when_their_bodies_do(
    task: dict[str, Any], arms: dict[str, Any], heights: tuple[float, float]
) -> None:
    env = CoopInsertionEnv(task=task, delta=arms)
    rng = np.random.default_rng(0)
    counts = {True: 0, False: 0}
    while min(counts.values()) < 40:
        x, y = rng.uniform(-0.16, 0.16, 2)
        roll, pitch = rng.uniform(-0.6, 0.6, 2)
        c = (x, y, rng.uniform(*heights), roll, pitch, rng.uniform(0.21, 0.25))
        valid, theta, pose, q = joint_angles(c, env.params)
        if not valid:
            continue
        free = clearance(env, c, DeltaGeometry(**arms)) >= 0.0
        hit = collides(c[0], c[1], c[2], theta, pose, q, env.params)
        assert hit != free
        counts[hit] += 1


# elbows stand upright, above the platform
TALL = {"proximal_length": 0.4, "distal_length": 0.25, "joint_min": -2.0, "joint_max": 2.0}


@pytest.mark.parametrize(
    ("task", "arms", "limbs"),
    [
        *((THICK, {}, {}), (FLAT, {}, {}), ({"dome_radius": 0.03, "spoke_radius": 0.1}, {}, {})),
        *(
            ({"dome_radius": 0.2}, {}, {}),
            ({}, {}, TALL),
            ({"forearm_radius": 0.1}, {"peg_length": 0.03}, {}),
        ),
        *(({}, LONG, {}), ({"forearm_radius": 0.1}, LONG, {})),
    ],
)
def test_nothing_of_a_robot_is_beyond_the_height_that_clears_the_other(
    task: dict[str, Any], arms: dict[str, Any], limbs: dict[str, Any]
) -> None:
    robot, geometry = DeltaGeometry(**arms), replace(OPTIMIZED, **limbs)
    env = CoopInsertionEnv(task=task, delta=arms, geometry=geometry)
    rng, bodies, seen = np.random.default_rng(0), env.task, 0
    while seen < 200:
        c = (*rng.uniform(-0.16, 0.16, 2), rng.uniform(-0.65, -0.05), *rng.uniform(-0.6, 0.6, 2))
        c = (*c, rng.uniform(geometry.heave_min, geometry.heave_max))
        if not joint_angles(c, env.params)[0]:
            continue
        seen += 1
        base = 0.05 * rng.choice([-1.0, 0.0, 1.0], 5)  # where the base really stands
        turn = Rotation.from_euler("XY", base[3:])
        cos, sin = np.cos(base[3:]), np.sin(base[3:])
        real = env.params._replace(
            task=env.params.task._replace(
                base_x=base[0], base_y=base[1], base_z=base[2],
                cos_roll=cos[0], sin_roll=sin[0], cos_pitch=cos[1], sin_pitch=sin[1],
            )
        )  # fmt: skip
        height = (turn.apply(rrs.platform_pose(c[3:], geometry).position) + base[:3])[2]
        _, elbows, joints = np.moveaxis(rrs.limb_points(c[3:], geometry), 1, 0)
        elbow, joint = (turn.apply(points)[:, 2].max() + base[2] for points in (elbows, joints))
        tops = height + bodies.dome_radius, joint + bodies.spoke_radius
        assert max(*tops, max(elbow, joint) + bodies.limb_radius) <= ceiling(height, real)
        tip = c[2] + robot.base_height - robot.peg_length
        _, knees, ends = np.moveaxis(delta.limb_points(c[:3], robot), 1, 0)
        arm = min(knees[:, 2].min(), ends[:, 2].min()) + robot.base_height - bodies.forearm_radius
        effector = c[2] + robot.base_height - bodies.effector_radius
        assert lowest(c[2], real) <= min(tip, arm, effector)


def test_the_peg_may_touch_the_dome_only_inside_a_chamfer() -> None:
    env = CoopInsertionEnv()

    def status(nx: float, ny: float, nz: float, beside: float = 0.0) -> int:
        """With that normal upright, and the tip 4 mm below the top of the dome, or beside that."""
        tilt = float(np.arcsin(ny)), float(-np.arctan2(nx, nz))
        _, _, pose, _ = joint_angles((0.0, 0.0, -0.3, *tilt, 0.22), env.params)
        z = pose.z + 0.10 - 0.004 + 0.08 - 0.85
        return env.configuration_status((pose.x, pose.y + beside, z, *tilt, pose.z))

    assert [status(*normal) for normal in env.task.hole_normals] == [0] * 6
    assert status(0.0, 0.0, 1.0) == 2
    side = np.sqrt((env.task.chamfer + env.params.delta.peg_radius) ** 2 - 0.004**2)
    inner = np.sin(np.radians(10.0)), 0.0, np.cos(np.radians(10.0))
    assert [status(*inner, beside) for beside in (side - 1e-6, side + 1e-6)] == [0, 2]


# a forearm alone touches the dome; in the last a spoke, and the link that ends there
LEANING = (
    (0.0884, -0.1160, -0.5697, -0.1712, 0.2817, 0.2463),
    (0.0965, 0.1093, -0.6075, -0.1198, -0.4106, 0.2360),
    (0.1406, 0.0571, -0.6020, 0.0404, -0.5056, 0.2426),
)


@pytest.mark.parametrize("leaning", LEANING)
def test_a_forearm_alone_collides_until_it_is_as_thin_as_the_gap(leaning: Configuration) -> None:
    thin = CoopInsertionEnv(task={"forearm_radius": 1e-3})
    width = 1e-3 + clearance(thin, leaning)  # from the forearm's axis
    assert 1e-3 < width < CoopInsertionEnv().task.forearm_radius == 0.010
    for radius, status in ((0.010, 2), (width + 1e-7, 2), (width - 1e-7, 0)):
        env = CoopInsertionEnv(task={"forearm_radius": radius})
        assert env.configuration_status(leaning) == status


def test_staying_in_a_filled_hole_is_no_duplicate() -> None:
    env, oracle = CoopInsertionEnv(), LatticeOracle()
    stayed = refused = entered = 0
    for seed in range(4):
        env.reset(seed=seed)
        moves: Any = oracle.plan(env).moves
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
