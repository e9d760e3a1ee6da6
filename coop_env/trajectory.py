"""From configurations to trajectories of the six actuated joints that keep their limits.

The profiles are ruckig's (extra ``trajectory``). The environment's own kernel checks each sample
for reach, collision and singularity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coop_env.compilation import njit
from coop_env.errors import ArgumentError, as_dataclass, check_flag, check_number, imports
from coop_env.geometry import DeltaGeometry, RRSGeometry, resolve_delta, resolve_rrs
from coop_env.kinematics import delta_kernels, rrs_forward_kernels
from coop_env.simulation import rewards, state
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask
from coop_env.simulation.task import N_AXES, make_params, pack, unpack

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

JOINTS: Final = (*(f"delta_joint{i}" for i in range(3)), *(f"rrs_joint{i}" for i in range(3)))
"""The actuated joints by name, as in the twin's MJCF; theta of the Delta, q of the 3-RRS."""
TIMESTEP: Final = 0.002
"""s between two samples."""
REASONS: Final = {
    state.INVALID: "beyond reach or joint limits",
    state.COLLISION: "a collision",
    state.SINGULAR: "too near a singularity, or beyond it",
}
_SAME: Final = 1e-12  # rad
_MET: Final = 1e-6  # m or rad
_BOW: Final = 1e-3
"""m and rad by which a way, straight for the joints, may bow out of a robot's workspace."""


class TrajectoryError(ValueError):
    """No trajectory leads along the configurations; the message names the first that fails."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Samples of the six joints of :data:`JOINTS`, evenly spaced; the first is at rest at 0 s.

    Attributes:
        times: (T,), s.
        positions: (T, 6), rad.
        velocities: (T, 6), rad/s.
        accelerations: (T, 6), rad/s^2.
        configurations: (T, 6), where the joints put both robots; NaN where the links cannot close.
        status: (T,), 0 where the sample is free, else a key of ``REASONS``.
        stops: (n,), the samples at which the n given configurations are met.
    """

    times: Floats
    positions: Floats
    velocities: Floats
    accelerations: Floats
    configurations: Floats
    status: NDArray[np.int64]
    stops: NDArray[np.int64]

    @property
    def duration(self) -> float:
        """Duration of the whole, s."""
        return float(self.times[-1])

    def blocked(self) -> list[tuple[int, str]]:
        """Ways that are not free: the move's number, from 0, and the first reason."""
        result: dict[int, str] = {}
        for sample in np.flatnonzero(self.status):
            move = max(int(np.searchsorted(self.stops, sample)) - 1, 0)
            result.setdefault(move, REASONS[int(self.status[sample])])
        return list(result.items())

    def to_csv(self, path: Path | str) -> None:
        """Write time, positions, velocities and accelerations, a row a sample; SI units."""
        kinds = ("position", "velocity", "acceleration")
        names = ["time", *(f"{joint}_{kind}" for kind in kinds for joint in JOINTS)]
        columns = np.column_stack([self.times, self.positions, self.velocities, self.accelerations])
        np.savetxt(path, columns, "%.9g", ",", header=",".join(names), comments="")

    def to_joint_trajectory(self) -> dict[str, Any]:
        """The fields of ROS 2's ``trajectory_msgs/msg/JointTrajectory``, plain numbers and lists.

        ``rosidl_runtime_py.set_message_fields(JointTrajectory(), ...)`` takes it.
        """
        points = []
        for i, time in enumerate(self.times.tolist()):
            sec, nanosec = divmod(round(1e9 * time), 10**9)
            points.append(
                {
                    "positions": self.positions[i].tolist(),
                    "velocities": self.velocities[i].tolist(),
                    "accelerations": self.accelerations[i].tolist(),
                    "effort": [],
                    "time_from_start": {"sec": sec, "nanosec": nanosec},
                }
            )
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        return {"header": header, "joint_names": list(JOINTS), "points": points}

    def to_yaml(self, path: Path | str) -> None:
        """Write :meth:`to_joint_trajectory` as YAML; needs PyYAML (extra ``trajectory``)."""
        with imports("trajectories need", "trajectory"):
            import yaml
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # ten times faster, where there is C
        style: dict[str, Any] = {"sort_keys": False, "default_flow_style": None}
        text = yaml.dump(self.to_joint_trajectory(), Dumper=dumper, **style)
        Path(path).write_text(text, encoding="utf-8")

    def plot(self) -> Figure:
        """Positions, velocities and accelerations over time, a line at each configuration.

        It needs matplotlib (extra ``trajectory``).
        """
        with imports("trajectories need", "trajectory"):
            from matplotlib.figure import Figure
        figure = Figure(figsize=(8.0, 6.0), layout="constrained")
        rows = (
            ("angle, rad", self.positions),
            ("velocity, rad/s", self.velocities),
            ("acceleration, rad/s²", self.accelerations),
        )
        for axes, (label, values) in zip(figure.subplots(3, 1, sharex=True), rows, strict=True):
            for stop in self.times[self.stops]:
                axes.axvline(stop, color="0.85", linewidth=0.6)
            for k, joint in enumerate(JOINTS):
                style = {"color": f"C{k % 3}", "linestyle": "-" if k < 3 else "--"}
                axes.plot(self.times, values[:, k], linewidth=1.0, label=joint, **style)
            axes.set_ylabel(label)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=6, fontsize="small", loc="outside upper center")
        figure.axes[-1].set_xlabel("time, s")
        return figure


def make_trajectory(
    configurations: ArrayLike,
    geometry: str | RRSGeometry | Mapping[str, Any] = "optimized",
    delta: DeltaGeometry | Mapping[str, Any] | None = None,
    task: InsertionTask | Mapping[str, Any] | None = None,
    *,
    blend: bool = False,
    move_time: float | None = None,
) -> Trajectory:
    """The fastest trajectory through configurations under the geometries' joint limits.

    Stop-and-go rests at each configuration, and all joints move in proportion between two. Blended,
    a joint that goes on in the same direction passes a configuration with the harmonic mean of its
    two mean velocities, and one that turns round rests there. Every configuration is met exactly;
    whether the ways between them are free is in ``status`` and :meth:`Trajectory.blocked`. A way is
    straight for the joints, so it may bow out of the Delta's radius and the 3-RRS's range of heave
    and tilt, by 1 mm and 1 mrad at most.

    Args:
        configurations: (n, 6), at least two: x, y, z of the effector, roll, pitch, heave; m, rad.
        geometry: the 3-RRS, as the environment takes it, like the Delta and the task.
        task: whose bodies collide.
        blend: whether moves are blended.
        move_time: s that each move takes; None, as long as the limits ask for.

    Raises:
        DependencyNotInstalled: ruckig is missing; it names the extra.
        ArgumentError: an argument is of the wrong form.
        GeometryError: a limit or a length makes no sense.
        TrajectoryError: a configuration is out of reach or in another assembly mode, or the limits
            admit no trajectory of a move in its time.
    """
    rrs, robot = resolve_rrs(geometry), resolve_delta(delta)
    bodies = as_dataclass("task", task, InsertionTask, {None: PAPER_TASK})
    try:
        points = np.array(configurations, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"configurations: must be numbers (n, 6): {error}") from error
    if points.ndim != 2 or points.shape[1] != N_AXES or len(points) < 2:
        raise ArgumentError(f"configurations of shape {points.shape}: must be (n, 6), n at least 2")
    check_flag("blend", blend)
    if move_time is not None:
        seconds = check_number("move_time", move_time, 0.0, above=True)
        move_time = max(1, round(seconds / TIMESTEP)) * TIMESTEP
    params = make_params(rrs, rewards.make_reward("progress"), delta=robot, task=bodies)
    joints, reached = state.joints_of(points, pack(params))
    if not reached.all():
        index = int(np.argmin(reached))
        raise TrajectoryError(
            f"configuration {index} of {len(points)}, {points[index].tolist()}, is out of reach, "
            "or in another assembly mode of the Delta"
        )
    kinds = [f"max_joint_{kind}" for kind in ("velocity", "acceleration", "jerk")]
    each = [[getattr(owner, kind) for owner in (robot, rrs)] for kind in kinds]
    limits = np.repeat(each, 3, axis=1)
    if not blend or move_time is None:
        moves = _profiles(joints, np.zeros_like(joints), limits, move_time)
    if blend:
        steps = np.full(len(joints) - 1, move_time or 0.0) / TIMESTEP
        if move_time is None:
            steps = np.array([max(m.shape[1] - 1, 1) for m in moves], np.float64)
        means = np.diff(joints, axis=0) / steps[:, None]
        moves = _profiles(joints, _passing(means / TIMESTEP), limits, move_time)
    stops = np.cumsum([0, *(move.shape[1] - 1 for move in moves)])
    parts = [moves[0][:, :1], *(move[:, 1:] for move in moves)]
    positions, velocities, accelerations = np.concatenate(parts, axis=1)
    d, r = params.delta, params.rrs
    low, high, tilt = r.heave_min - _BOW, r.heave_max + _BOW, r.max_tilt + _BOW
    bowed = params._replace(
        delta=d._replace(planar_limit=d.planar_limit + _BOW),
        rrs=r._replace(heave_min=low, heave_max=high, max_tilt=tilt),
    )
    result, status = _follow(positions, points[0], pack(bowed))
    if (missed := np.abs(result[stops] - points).max(axis=1) > _MET).any():  # not where NaN
        index = int(np.argmax(missed))
        raise TrajectoryError(
            f"configuration {index} of {len(points)}, {points[index].tolist()}, is in another "
            f"assembly mode: its joint angles lead to {result[stops[index]].tolist()}"
        )
    times = TIMESTEP * np.arange(len(positions), dtype=np.float64)
    return Trajectory(times, positions, velocities, accelerations, result, status, stops)


def _passing(means: Floats) -> Floats:
    """Velocities (n + 1, 6) at the ends of n moves with these mean ones (n, 6), rad/s."""
    before, after = means[:-1], means[1:]
    product = before * after
    passing = np.zeros((len(means) + 1, N_AXES))
    np.divide(2.0 * product, before + after, out=passing[1:-1], where=product > 0.0)
    return passing


def _profiles(
    joints: Floats, velocities: Floats, limits: Floats, move_time: float | None
) -> list[Floats]:
    """Positions, velocities and accelerations (3, samples, 6) of each move, both ends included.

    ``joints`` (n, 6) are met at ``velocities`` (n, 6); ``limits`` (3, 6) are of velocity,
    acceleration and jerk.
    """
    moves = []
    for k, way in enumerate(np.diff(joints, axis=0)):
        start, end = velocities[k : k + 2]
        length = float(np.abs(way).max())
        if length < _SAME:  # a move that was not made
            rest = 1 if move_time is None else round(move_time / TIMESTEP) + 1
            moves.append(np.zeros((3, rest, N_AXES)))
        elif start.any() or end.any():
            moves.append(_fastest(k, way, start, end, limits, move_time))
        else:  # one path for all, within the limits of each joint's share of it
            share = way / length
            slowest = np.divide(limits, abs(share), where=share != 0.0, out=np.full((3, 6), np.inf))
            path, still = np.array([length]), np.zeros(1)
            one = slowest.min(axis=1, keepdims=True)
            moves.append(_fastest(k, path, still, still, one, move_time) * share)
        moves[-1][0] += joints[k]
        moves[-1][0, -1] = joints[k + 1]
    return moves


def _fastest(
    k: int, way: Floats, start: Floats, end: Floats, limits: Floats, move_time: float | None
) -> Floats:
    """Positions from 0, velocities and accelerations (3, samples, n) of move k along a way (n,).

    ``start`` and ``end`` are velocities (n,); the rest as in :func:`_profiles`.
    """
    with imports("trajectories need", "trajectory"):
        import ruckig
    solver, profile = ruckig.Ruckig(len(way), TIMESTEP), ruckig.Trajectory(len(way))
    wanted = ruckig.InputParameter(len(way))
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = limits.tolist()
    wanted.duration_discretization = ruckig.DurationDiscretization.Discrete
    if move_time is not None:
        wanted.minimum_duration = move_time
    wanted.target_position = way.tolist()
    wanted.current_velocity, wanted.target_velocity = start.tolist(), end.tolist()
    try:
        done = solver.calculate(wanted, profile) == ruckig.Result.Working
    except (ValueError, ruckig.RuckigError):  # an error that its enumeration does not know
        done = False
    if not done:
        raise TrajectoryError(f"move {k}: these joint limits admit no trajectory")
    steps = round(profile.duration / TIMESTEP)
    if move_time is not None and steps > round(move_time / TIMESTEP):
        raise TrajectoryError(
            f"move {k} takes {profile.duration:.3g} s at these joint limits, and has "
            f"{move_time:.3g} s: raise move_time or the limits"
        )
    samples = np.array([profile.at_time(TIMESTEP * i)[:3] for i in range(steps + 1)])
    return np.swapaxes(samples, 0, 1)


@njit(cache=True)
def _follow(
    joints: np.ndarray, start: np.ndarray, packed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Configurations (n, 6) and status (n,) of joints (n, 6), followed from a configuration (6,).

    Where the links cannot close, and from there on, they are NaN and INVALID.
    """
    p = unpack(packed)
    result = np.full_like(joints, np.nan)
    status = np.full(len(joints), state.INVALID)
    roll, pitch, heave = start[3], start[4], start[5]
    for i in range(len(joints)):
        a = joints[i]
        ok_delta, e = delta_kernels.forward((a[0], a[1], a[2]), p.delta)
        ok_rrs, pose, _ = rrs_forward_kernels.forward((a[3], a[4], a[5]), roll, pitch, heave, p.rrs)
        if not (ok_delta and ok_rrs):
            break
        roll, pitch, heave = pose
        for k in range(3):
            result[i, k], result[i, 3 + k] = e[k], pose[k]
        status[i] = state.configuration_status((e[0], e[1], e[2], roll, pitch, heave), p)
    return result, status
