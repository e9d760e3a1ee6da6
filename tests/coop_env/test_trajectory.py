"""Trajectories: limits, end points, ways that are not free, files, and what is refused."""

import csv
import sys
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("ruckig", reason="ruckig is not installed (extra trajectory)")

from gymnasium.error import DependencyNotInstalled
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coop_env import CoopInsertionEnv, InsertionTask
from coop_env.errors import ArgumentError
from coop_env.geometry import DELTA, OPTIMIZED, DeltaGeometry, GeometryError
from coop_env.kinematics import delta, rrs
from coop_env.trajectory import JOINTS, TIMESTEP, Trajectory, TrajectoryError, make_trajectory
from tests.coop_env.kinematics.reference import FOLDING

SLOW = DeltaGeometry(max_joint_velocity=0.5, max_joint_acceleration=3.0, max_joint_jerk=90.0)
HOME = np.array([0.0, 0.0, -0.35, 0.0, 0.0, 0.23])
LOW = HOME - [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]


def walk(seed: int, moves: int) -> np.ndarray:
    """Configurations (moves + 1, 6) of random valid moves of the task."""
    env = CoopInsertionEnv(mask_singularities=True)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    result = [env.configuration]
    for _ in range(moves):
        env.step(rng.choice(np.flatnonzero(env.action_masks())))
        result.append(env.configuration)
    return np.array(result)


def lowered() -> Trajectory:
    return make_trajectory([HOME, LOW])


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), moves=st.integers(1, 15), blend=st.booleans())
@example(seed=4767, moves=8, blend=False)  # meets a singularity between two stops
def test_no_sample_exceeds_a_limit_and_every_configuration_is_met(
    seed: int, moves: int, blend: bool
) -> None:
    way = walk(seed, moves)
    result = make_trajectory(way, delta=SLOW, blend=blend)
    kinds = ("velocity", "acceleration", "jerk")
    each = [[getattr(owner, f"max_joint_{kind}") for owner in (SLOW, OPTIMIZED)] for kind in kinds]
    limits = np.repeat(each, 3, axis=1)
    jerk = np.diff(result.accelerations, axis=0) / TIMESTEP
    for values, limit in zip((result.velocities, result.accelerations, jerk), limits, strict=True):
        assert (np.abs(values) <= limit * (1.0 + 1e-6)).all()
    joints = np.hstack([delta.inverse(way[:, :3]).theta, rrs.inverse(way[:, 3:]).q])
    assert result.positions[result.stops] == pytest.approx(joints, abs=1e-9)
    placed = result.configurations[result.stops]
    known = np.isfinite(placed).all(axis=1)
    assert placed[known] == pytest.approx(way[known], abs=1e-9)
    # straight in the joints is another way than the task's: where it ends, a way before is blocked
    assert known.all() or min(result.blocked())[0] < int(np.argmin(known))
    assert result.velocities[[0, -1]] == pytest.approx(0.0, abs=1e-9)
    if not blend:
        assert result.velocities[result.stops] == pytest.approx(0.0, abs=1e-9)
    # samples belong together: the mean of two velocities leads from one position to the next
    means = 0.5 * (result.velocities[1:] + result.velocities[:-1])
    left = np.diff(result.positions, axis=0) - TIMESTEP * means
    assert np.abs(left).max() < limits[2].max() * TIMESTEP**3 / 6.0
    assert np.diff(result.times) == pytest.approx(TIMESTEP)


@pytest.mark.parametrize(
    ("delta", "move_time"), [(None, None), (None, 0.4), (SLOW, None), (SLOW, 2.0)]
)
def test_between_two_stops_all_joints_move_in_proportion(
    delta: DeltaGeometry | None, move_time: float | None
) -> None:
    for seed in (3, 46):
        # every other stop: both robots move
        way = walk(seed, 12)[:: 1 + seed % 2]
        result = make_trajectory(way, delta=delta, move_time=move_time)
        for first, last in pairwise(result.stops):
            part = result.positions[first : last + 1] - result.positions[first]
            share = part @ part[-1] / max(part[-1] @ part[-1], 1e-12)  # it may have come back
            assert part == pytest.approx(np.outer(share, part[-1]), abs=1e-9)
            if move_time is None and np.ptp(part, axis=0).any():  # as fast as the limits admit
                jerk = np.diff(result.accelerations[first : last + 1], axis=0) / TIMESTEP
                allowed = [(delta or DELTA).max_joint_jerk] * 3 + [OPTIMIZED.max_joint_jerk] * 3
                assert 0.9 < np.abs(jerk / allowed).max() < 1.0 + 1e-6


def test_a_move_along_a_bound_is_free() -> None:
    """Straight for the joints, it bows out: the platform by 0.05 mm, the effector by half a one."""
    low, wide = walk(0, 0).repeat(2, axis=0)
    low[3:] = 0.0, 0.0, OPTIMIZED.heave_min
    tilted = replace(OPTIMIZED, max_tilt=0.3)
    for geometry, axis, there, move in (
        (OPTIMIZED, 5, [0.25, 0.0, OPTIMIZED.heave_max], [0.1, 0.1, 0.0]),
        (tilted, 3, [0.3, -0.3, 0.23], [0.0, 0.2, 0.0]),
    ):
        result = make_trajectory([[*low[:3], *there], [*low[:3], *np.add(there, move)]], geometry)
        assert result.blocked() == []
        assert result.configurations[:, axis].max() > there[axis - 3] + 1e-4
    wide[:3] = DELTA.planar_limit, 0.0, -0.40
    moves = [(low, step * np.eye(6)[axis]) for axis in (3, 4) for step in (0.03, -0.03)]
    for start, move in [*moves, (wide, -0.02 * np.eye(6)[2])]:
        result = make_trajectory([start, start + move])
        assert result.blocked() == []
        assert result.configurations[:, 5].min() > OPTIMIZED.heave_min - 1e-4
    assert np.hypot(*result.configurations[:, :2].T).max() > DELTA.planar_limit + 1e-4


def test_blended_moves_pass_without_a_stop_and_in_less_time() -> None:
    way = HOME + np.outer(np.arange(5), [0.0, 0.0, -0.02, 0.0, 0.0, 0.0])
    stops, blended = make_trajectory(way), make_trajectory(way, blend=True)
    assert blended.duration < 0.75 * stops.duration
    assert (np.abs(blended.velocities[blended.stops[1:-1], :3]) > 0.2).all()
    back = make_trajectory([way[0], way[1], way[0]], blend=True)
    assert back.velocities[back.stops] == pytest.approx(0.0, abs=1e-9)
    uneven = HOME + np.outer([0.0, 1.0, 3.0, 3.5, 5.0], [0.0, 0.0, -0.02, 0.0, 0.0, 0.0])
    timed = make_trajectory(uneven, blend=True, move_time=0.4)
    means = np.diff(timed.positions[timed.stops, :3], axis=0) / 0.4
    harmonic = 2.0 / (1.0 / means[:-1] + 1.0 / means[1:])
    assert timed.velocities[timed.stops[1:-1], :3] == pytest.approx(harmonic, abs=1e-9)
    kept: dict[bool, list[int]] = {False: [], True: []}  # steps of time that moves may take
    for blend, n in product(kept, range(30, 130)):
        with suppress(TrajectoryError):
            result = make_trajectory(way, blend=blend, move_time=n * TIMESTEP)
            assert result.duration == pytest.approx(4 * n * TIMESTEP)
            kept[blend].append(n)
    assert min(kept[True]) < min(kept[False])


def test_a_move_that_was_not_made_takes_no_time() -> None:
    once, twice = make_trajectory([HOME, HOME]), make_trajectory([HOME, LOW, LOW, HOME])
    assert (once.duration, once.stops.tolist()) == (0.0, [0, 0])
    assert make_trajectory([HOME, HOME, LOW], move_time=0.4).duration == pytest.approx(0.8)
    assert make_trajectory([HOME, LOW], move_time=0.4015).duration == pytest.approx(0.402)
    task = InsertionTask(dome_radius=0.05)
    assert make_trajectory([HOME, HOME], task=task).duration == 0.0
    assert twice.duration == pytest.approx(2.0 * lowered().duration, abs=TIMESTEP)


def test_a_way_through_the_dome_is_not_free() -> None:
    """Both ends are free: the tip stands beside the dome at the height of its middle."""
    beside = HOME.copy()
    beside[2] = 0.23 + 0.09 + DELTA.peg_length - DELTA.base_height
    ends = [beside + x * np.eye(6)[0] for x in (0.14, 0.14 - 1e-3, -0.14)]
    result = make_trajectory(ends)
    assert result.status[result.stops].tolist() == [0, 0, 0]
    assert result.blocked() == [(1, "a collision")]
    tips = result.configurations[:, :3] + [0.0, 0.0, DELTA.base_height - DELTA.peg_length - 0.23]
    inside = np.linalg.norm(tips, axis=1) < 0.09
    assert inside.any()
    assert (result.status[inside] != 0).all()
    assert lowered().blocked() == []
    assert make_trajectory(ends, task=InsertionTask(dome_radius=0.03)).blocked() == []
    top, env = np.array([0.0, 0.0, -0.43, 0.0, 0.0, 0.22]), CoopInsertionEnv()
    lifted = make_trajectory([top, top + 0.03 * np.eye(6)[5]])
    assert lifted.status.tolist() == [*map(env.configuration_status, lifted.configurations)]
    assert 0 < np.count_nonzero(lifted.status) < len(lifted.status)
    into = make_trajectory([ends[0], ends[0] - 0.14 * np.eye(6)[0]])
    assert into.blocked() == [(0, "a collision")]  # the sample at its end is of the same move
    reasons = np.sign(into.status)
    reasons[np.flatnonzero(reasons)[0]] = 2  # the first is said
    assert replace(into, status=reasons).blocked() == [(0, "a collision")]


def test_the_clock_of_the_paper_is_kept_or_refused() -> None:
    way = walk(1, 6)
    assert make_trajectory(way, move_time=0.2).duration == pytest.approx(1.2, abs=1e-9)
    with pytest.raises(TrajectoryError, match=r"move 0 takes 0\.\d+ s .* has 0\.02 s"):
        make_trajectory(way, move_time=0.02)


STILL = {"max_joint_velocity": 1e-9, "max_joint_acceleration": 1e-9, "max_joint_jerk": 1e-9}


@pytest.mark.parametrize(
    ("way", "arguments", "error", "message"),
    [
        ([HOME, LOW], {"delta": STILL}, TrajectoryError, "move 0: these joint limits admit no"),
        ([HOME, HOME + 0.5, HOME], {}, TrajectoryError, r"configuration 1 of 3, .* out of reach"),
        ([HOME, HOME * np.nan, HOME], {}, TrajectoryError, "configuration 1 of 3"),
        (
            [[0.0, 0.0, -0.2, 0.0, 0.0, 0.21], [-0.0125, 0.0889, -0.1306, 0.0, 0.0, 0.21]],
            {"delta": FOLDING},
            TrajectoryError,
            "configuration 1 of 2, .* is out of reach, or in another assembly mode of the Delta",
        ),
        (
            [HOME, [*HOME[:3], -0.638, -0.483, 0.2166]],  # beyond det A = 0 of the 3-RRS
            {},
            TrajectoryError,
            "configuration 1 of 2, .* is in another assembly mode: its joint angles lead to",
        ),
        ([[0.0] * 6, [0.0] * 5], {}, ArgumentError, "configurations: must be numbers"),
        ([HOME], {}, ArgumentError, "configurations of shape"),
        ([HOME, HOME], {"delta": {"max_joint_jerk": 0.0}}, GeometryError, "max_joint_jerk = 0.0"),
        ([HOME, HOME], {"move_time": 0.0}, ArgumentError, "move_time"),
        ([HOME, HOME], {"task": 3}, ArgumentError, "task"),
    ],
)
def test_what_is_no_trajectory_is_named(
    way: Any, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make_trajectory(way, **arguments)


def test_the_csv_holds_every_sample(tmp_path: Path) -> None:
    result = lowered()
    result.to_csv(tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["time"]) for row in rows] == pytest.approx(result.times)
    for kind, values in (
        ("position", result.positions),
        ("velocity", result.velocities),
        ("acceleration", result.accelerations),
    ):
        read = [[float(row[f"{joint}_{kind}"]) for joint in JOINTS] for row in rows]
        assert read == pytest.approx(values, abs=1e-7)


def test_the_yaml_is_a_joint_trajectory(tmp_path: Path) -> None:
    """Fields as trajectory_msgs/msg/JointTrajectory.msg and JointTrajectoryPoint.msg name them."""
    result = lowered()
    result.to_yaml(tmp_path / "t.yaml")
    message = yaml.safe_load((tmp_path / "t.yaml").read_text("utf-8"))
    assert message == result.to_joint_trajectory()
    assert list(message) == ["header", "joint_names", "points"]
    assert message["joint_names"] == list(JOINTS)
    for point in message["points"]:
        assert list(point) == [
            "positions", "velocities", "accelerations", "effort", "time_from_start"
        ]  # fmt: skip
        assert all(type(v) is float for v in point["positions"] + point["accelerations"])
    for kind in ("positions", "velocities", "accelerations"):
        assert [point[kind] for point in message["points"]] == getattr(result, kind).tolist()
    stamps = [point["time_from_start"] for point in message["points"]]
    assert all(type(v) is int for stamp in stamps for v in stamp.values())
    seconds = [stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps]
    assert seconds == pytest.approx(result.times, abs=1e-9)


def test_the_picture_shows_all_six_joints(tmp_path: Path) -> None:
    figure = lowered().plot()
    assert [len(axes.lines) for axes in figure.axes] == [8, 8, 8]  # with the two configurations
    figure.savefig(tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 0


def test_without_ruckig_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(DependencyNotInstalled, match=r"\[trajectory\]"):
        lowered()
