"""The task as the kernels take it: nested named tuples for the formulas, one record for a batch.

World frame: the 3-RRS's base, z up. The Delta's base frame lies ``base_height`` above it on the
same axis. A configuration is ``(x, y, z, roll, pitch, heave)``: the Delta's effector in the Delta's
base frame (m), then the platform's tilt (rad) and height (m).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from coop_env.geometry import DELTA, DeltaGeometry, RRSGeometry
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rrs_kernels import RRSParams
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask

N_AXES: Final = 6
N_ACTIONS: Final = 12
AXES: Final = ("x", "y", "z", "roll", "pitch", "heave")

TRAIL: Final = 64
"""Configurations that a state can remember for ``mask_visited``."""


class TaskParams(NamedTuple):
    """What decides a move, as numba takes it.

    ``chamfer`` and ``tolerance`` (m) and ``angle_tolerance`` (rad) decide a contact and an
    insertion; ``max_moves`` truncates; ``visited`` is the number of configurations back to which
    masks forbid to go; ``imperfect`` says that a sim-to-real knob is turned.
    """

    chamfer: float
    tolerance: float
    angle_tolerance: float
    max_moves: int = 300
    mask_singularities: bool = False
    visited: int = 0
    imperfect: bool = False


class RewardParams(NamedTuple):
    """Scales of the reward as numba takes them; NaN in ``insertion_bonus`` means "as printed".

    NaN in ``gamma`` means plain differences. See :mod:`coop_env.simulation.rewards`.
    """

    paper: bool
    step_cost: float
    distance_scale: float
    angle_scale: float
    insertion_bonus: float
    violation_penalty: float
    duplicate_penalty: float
    gamma: float
    task_time: float = PAPER_TASK.task_time


class EnvParams(NamedTuple):
    """Everything the step kernel needs besides the state.

    ``layout`` is a record of :func:`layout_dtype`: numba passes it as one pointer, and its number
    of holes is known when a kernel is compiled.
    """

    rrs: RRSParams
    delta: DeltaParams
    task: TaskParams
    reward: RewardParams
    layout: Any


@lru_cache
def layout_dtype(n_holes: int) -> np.dtype[np.void]:
    """Lattice, dome, start ranges and bodies; see :class:`InsertionTask` for the fields."""
    names = (
        "dt", "dome_radius", "singular_margin", "start_tilt", "start_planar", "clearance_min",
        "clearance_max", "start_sigma", "effector_radius", "forearm_radius", "spoke_radius",
        "limb_radius",
    )  # fmt: skip
    arrays = [("step", "f8", (N_AXES,)), ("normals", "f8", (n_holes, 3))]
    return np.dtype([*arrays, *((name, "f8") for name in names)], align=True)


def make_layout(task: InsertionTask) -> np.void:
    """The record of a task's numbers; ``normals`` (n, 3) are unit vectors, platform frame."""
    record = np.zeros(1, layout_dtype(len(task.holes)))
    low, high = task.start_clearance
    values = {"clearance_min": low, "clearance_max": high, "step": task.steps}
    values["normals"] = task.hole_normals
    for name in record.dtype.names or ():
        record[name] = values[name] if name in values else getattr(task, name)
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
        ValueError: ``pose_model`` is neither ``"exact"`` nor ``"paper"``.
    """
    return EnvParams(
        rrs_kernels.make_params(rrs, pose_model),
        delta_kernels.make_params(delta),
        TaskParams(task.chamfer, task.tolerance, task.angle_tolerance, **flags),
        reward._replace(task_time=task.task_time),
        make_layout(task),
    )


def pack(p: EnvParams) -> NDArray[np.void]:
    """The parameters as an array (1,): numba takes it ten times faster than nested tuples."""
    numbers = [*p.rrs, *p.delta, *p.task, *p.reward]
    packed = np.zeros(1, [("numbers", "f8", (len(numbers),)), ("layout", p.layout.dtype)])
    packed["numbers"], packed["layout"] = numbers, p.layout
    return packed


@njit(cache=True, inline="always")  # numba returns no tuple that holds a record
def unpack(packed: np.ndarray) -> EnvParams:
    """The inverse of :func:`pack`; ``layout`` stays where it is."""
    v = packed[0].numbers
    return EnvParams(
        RRSParams(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10] != 0.0, v[11]),
        DeltaParams(v[12], v[13], v[14], v[15], v[16], v[17], v[18], v[19]),
        TaskParams(v[20], v[21], v[22], int(v[23]), v[24] != 0.0, int(v[25]), v[26] != 0.0),
        RewardParams(v[27] != 0.0, v[28], v[29], v[30], v[31], v[32], v[33], v[34], v[35]),
        packed[0].layout,
    )
