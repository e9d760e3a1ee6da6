"""The task as the kernels take it: nested named tuples for the formulas, one record for a batch.

World frame: the 3-RRS's base, z up. The Delta's base frame lies ``base_height`` above it on the
same axis. A configuration is ``(x, y, z, roll, pitch, heave)``: the Delta's effector in the Delta's
base frame (m), then the platform's tilt (rad) and height (m).
"""

from collections.abc import Callable
from itertools import count
from typing import Any, Final, NamedTuple, get_type_hints

import numpy as np
from numba import from_dtype, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from coop_env.errors import ArgumentError
from coop_env.geometry import DELTA, DeltaGeometry, GeometryError, RRSGeometry
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rrs_kernels import RRSParams
from coop_env.simulation.insertion_task import MAX_HOLES, PAPER_TASK, InsertionTask

N_AXES: Final = 6
N_ACTIONS: Final = 12
AXES: Final = ("x", "y", "z", "roll", "pitch", "heave")

TRAIL: Final = 64  # configurations that a state can remember for ``mask_visited``
KEY_SPAN: Final = 1024  # lattice points along an axis that such a memory tells apart


class TaskParams(NamedTuple):
    """Parameters that decide a move, as numba takes them; m and rad."""

    chamfer: float
    tolerance: float
    angle_tolerance: float
    max_moves: int = 300
    mask_singularities: bool = False
    visited: int = 0  # number of configurations to which masks forbid to return
    imperfect: bool = False  # a sim-to-real knob is turned
    refused: bool = False  # masks forbid to try a refused move again
    fatal: bool = False  # a collision ends the episode
    base_x: float = 0.0  # where an imperfect machine's 3-RRS really stands
    base_y: float = 0.0
    base_z: float = 0.0
    cos_roll: float = 1.0
    sin_roll: float = 0.0
    cos_pitch: float = 1.0
    sin_pitch: float = 0.0


class RewardParams(NamedTuple):
    """Scales of the reward as numba takes them; see :mod:`coop_env.simulation.rewards`."""

    paper: bool
    step_cost: float
    distance_scale: float
    angle_scale: float
    insertion_bonus: float  # NaN: as printed
    violation_penalty: float
    duplicate_penalty: float
    gamma: float  # NaN: plain differences
    task_time: float = PAPER_TASK.task_time


class EnvParams(NamedTuple):
    """Everything the step kernel needs besides the state.

    ``layout`` is a record of ``LAYOUT``, which numba passes as one pointer.
    """

    rrs: RRSParams
    delta: DeltaParams
    task: TaskParams
    reward: RewardParams
    layout: Any


LAYOUT: Final = np.dtype(
    [
        ("step", "f8", (N_AXES,)),
        ("normals", "f8", (MAX_HOLES, 3)),  # unit vectors, platform frame; zeros beyond n_holes
        ("n_holes", "i8"),
        ("clearance_min", "f8"),
        ("clearance_max", "f8"),
        *((name, "f8") for name in (
            "dt", "dome_radius", "singular_margin", "start_tilt", "start_planar", "start_sigma",
            "effector_radius", "forearm_radius", "spoke_radius", "limb_radius",
        )),
    ],
    align=True,
)  # fmt: skip
"""Lattice, dome, start ranges and bodies; see :class:`InsertionTask` for the fields."""


def _make_layout(task: InsertionTask) -> np.void:
    record = np.zeros(1, LAYOUT)
    n_holes = len(task.holes)
    record["step"], record["n_holes"] = task.steps, n_holes
    record["normals"][0, :n_holes] = task.hole_normals
    record["clearance_min"], record["clearance_max"] = task.start_clearance
    for name in LAYOUT.names[5:] if LAYOUT.names else ():
        record[name] = getattr(task, name)
    return np.void(record[0])


def make_params(
    rrs: RRSGeometry,
    reward: RewardParams,
    *,
    delta: DeltaGeometry = DELTA,
    task: InsertionTask = PAPER_TASK,
    pose_model: str = "exact",
    **flags: Any,
) -> EnvParams:
    """Geometries, task and reward as the kernels take them; ``flags`` are of TaskParams.

    Raises:
        ArgumentError: ``pose_model`` is neither ``"exact"`` nor ``"paper"``, or the steps are too
            small for ``mask_visited``.
        GeometryError: the 3-RRS cannot take its home pose.
    """
    p = EnvParams(
        rrs_kernels.make_params(rrs, pose_model),
        delta_kernels.make_params(delta),
        TaskParams(task.chamfer, task.tolerance, task.angle_tolerance, **flags),
        reward._replace(task_time=task.task_time),
        _make_layout(task),
    )
    if not rrs_kernels.is_valid(0.0, 0.0, rrs.home_heave, p.rrs):
        raise GeometryError(
            f"the 3-RRS cannot take its home pose at home_heave = {rrs.home_heave} m within "
            "its joint limits: choose other lengths, another height or wider limits"
        )
    if p.task.visited == 0:
        return p
    low, high = axis_bounds(p)  # a memory of KEY_SPAN points along an axis tells them apart
    for least, step in zip((high - low) / (KEY_SPAN - 2), task.steps, strict=True):
        if step < least:
            raise ArgumentError(
                f"mask_visited needs steps of at least {least:.2g} here, not {step:.2g}: make them "
                "larger or leave mask_visited at 0"
            )
    return p


def axis_bounds(p: EnvParams) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and largest of each axis (6,) within both workspaces; m, rad."""
    d, r = p.delta, p.rrs
    reach, drop = d.proximal_length + d.distal_length, abs(d.proximal_length - d.distal_length)
    low = [-d.planar_limit, -d.planar_limit, -reach, -r.max_tilt, -r.max_tilt, r.heave_min]
    high = [d.planar_limit, d.planar_limit, -drop, r.max_tilt, r.max_tilt, r.heave_max]
    return np.array(low), np.array(high)


def pack(p: EnvParams) -> NDArray[np.float64]:
    """The parameters as a vector, which numba takes ten times faster than nested tuples."""
    numbers = np.array([*p.rrs, *p.delta, *p.task, *p.reward], np.float64)
    return np.concatenate([numbers, np.array([p.layout], LAYOUT).view(np.float64)])


def _unpack(_: Any, vector: Any) -> Any:
    numbers = {float: types.float64, int: types.int64, bool: types.boolean}
    parts = [
        types.BaseTuple.from_types([numbers[h] for h in get_type_hints(kind).values()], kind)
        for kind in (RRSParams, DeltaParams, TaskParams, RewardParams)
    ]
    record = from_dtype(LAYOUT)
    whole = types.NamedTuple([*parts, record], EnvParams)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        places = (builder.gep(data, [context.get_constant(types.intp, i)]) for i in count())

        def take(kind: Any) -> Any:
            return context.cast(builder, builder.load(next(places)), types.float64, kind)

        made = [context.make_tuple(builder, p, [take(kind) for kind in p.types]) for p in parts]
        layout = builder.bitcast(next(places), context.get_value_type(record))
        return context.make_tuple(builder, whole, [*made, layout])

    return whole(vector), generate


unpack: Callable[[NDArray[np.float64]], EnvParams] = intrinsic(_unpack)  # type: ignore[assignment]
"""The inverse of :func:`pack` within kernels, field by field; the layout stays where it is."""
