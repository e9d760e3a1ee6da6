"""What is fixed about the task: lattice of moves, dome, holes, limits, and the kernels' parameters.

World frame: the 3-RRS's base, z up. The Delta's base frame lies ``base_height`` above it on the
same axis. A configuration is ``(x, y, z, roll, pitch, heave)``: the Delta's effector in the Delta's
base frame (m), then the platform's tilt (rad) and height (m).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.geometry import DELTA, DeltaGeometry, RRSGeometry
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rrs_kernels import RRSParams

N_AXES: Final = 6
N_ACTIONS: Final = 12
AXES: Final = ("x", "y", "z", "roll", "pitch", "heave")
STEP: Final = (0.02, 0.02, 0.02, 0.03, 0.03, 0.02)
"""One move along each axis: 0.02 m and 0.03 rad (paper, action space)."""

DT: Final = 0.2
"""Duration of one move, s, so that 300 moves last the paper's 60 s."""
TASK_TIME: Final = 60.0
"""T_task of the reward's time bonus, s."""

DOME_RADIUS: Final = 0.10
N_HOLES: Final = 6
HOLE_POLAR: Final = tuple(math.radians(a) for a in (30.0, 30.0, 30.0, 30.0, 10.0, 10.0))
HOLE_AZIMUTH: Final = tuple(math.radians(a) for a in (45.0, 135.0, 225.0, 315.0, 0.0, 180.0))
HOLE_NORMALS: Final = tuple(
    (math.sin(p) * math.cos(a), math.sin(p) * math.sin(a), math.cos(p))
    for p, a in zip(HOLE_POLAR, HOLE_AZIMUTH, strict=True)
)
"""Outward unit normals of the holes in the platform's frame; mouths lie on the dome along them."""
STAGE_HOLES: Final = ((1, 1, 1, 1, 0, 0), (1, 1, 1, 1, 1, 1))
"""Active holes of the curriculum's stages C0 (four peripheral) and C1 (all six)."""

SINGULAR_MARGIN: Final = 0.05
"""A move to signed sigma_min below this ends the episode."""

# Start states (see docs/fidelity.md: the paper gives none).
START_SIGMA: Final = 0.15
START_TILT: Final = 0.5
START_PLANAR: Final = 0.06
START_CLEARANCE: Final = (0.05, 0.15)

TRAIL: Final = 64
"""Configurations that a state can remember for ``mask_visited``."""

# Collision bodies, m. The paper mentions none; docs/fidelity.md says why these.
EFFECTOR_RADIUS: Final = 0.04
FOREARM_RADIUS: Final = 0.010
SPOKE_RADIUS: Final = 0.008
LIMB_RADIUS: Final = 0.008


class TaskParams(NamedTuple):
    """What may vary from one environment to another, as numba takes it.

    ``chamfer`` (m) and ``angle_tolerance`` (rad) decide an insertion; ``max_moves`` truncates;
    ``visited`` is the number of configurations back to which masks forbid to go; ``imperfect`` says
    that a sim-to-real knob is turned.
    """

    chamfer: float = 0.010
    angle_tolerance: float = math.radians(5.0)
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


class EnvParams(NamedTuple):
    """Everything the step kernel needs besides the state."""

    rrs: RRSParams
    delta: DeltaParams
    task: TaskParams
    reward: RewardParams


def make_params(
    rrs: RRSGeometry,
    reward: RewardParams,
    *,
    delta: DeltaGeometry = DELTA,
    pose_model: str = "exact",
    task: TaskParams | None = None,
) -> EnvParams:
    """Geometries, task and reward as the kernels take them.

    Raises:
        ValueError: ``pose_model`` is neither ``"exact"`` nor ``"paper"``.
    """
    return EnvParams(
        rrs_kernels.make_params(rrs, pose_model),
        delta_kernels.make_params(delta),
        TaskParams() if task is None else task,
        reward,
    )


def pack(p: EnvParams) -> NDArray[np.float64]:
    """The parameters as one vector: numba takes an array ten times faster than nested tuples."""
    return np.array([*p.rrs, *p.delta, *p.task, *p.reward], np.float64)


@njit(cache=True)
def unpack(v: np.ndarray) -> EnvParams:
    """The inverse of :func:`pack`."""
    return EnvParams(
        RRSParams(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10] != 0.0, v[11]),
        DeltaParams(v[12], v[13], v[14], v[15], v[16], v[17], v[18], v[19]),
        TaskParams(v[20], v[21], int(v[22]), v[23] != 0.0, int(v[24]), v[25] != 0.0),
        RewardParams(v[26] != 0.0, v[27], v[28], v[29], v[30], v[31], v[32], v[33]),
    )
