"""Kernels of an imperfect machine: its response to the joint angles that its model commands.

:mod:`coop_env.simulation.sim_to_real` draws such machines. With no knob turned nothing here runs.
"""

import math
from typing import Any, Final

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_forward_kernels
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rrs_kernels import Pose, RRSParams
from coop_env.kinematics.singularity import Row, dot
from coop_env.simulation.task import EnvParams, TaskParams

MACHINE: Final = np.dtype(
    [
        # 3-RRS: base_radius, proximal, platform_radius, distal; Delta: base_radius,
        # effector_radius, proximal, distal; m
        ("lengths", "f8", (8,)),
        ("base", "f8", (5,)),  # 3-RRS's base as the Delta meets it: x, y, z, m; roll, pitch, rad
        ("backlash", "f8"),  # rad
        ("resolution", "f8"),  # rad
        ("noise", "f8"),  # of the observation, in units of its range
        ("chamfer", "f8"),  # m
        ("tolerance", "f8"),  # m
        ("insertion_probability", "f8"),
        ("latency", "i8"),
        ("joints", "f8", (6,)),  # where theta and q really are, rad
        ("actual", "f8", (6,)),  # the configuration that follows from them
        ("pending", "i8"),  # the late command, -1 for none
        ("key", "u8"),  # of this row's own random numbers
    ],
    align=True,
)
"""One machine, drawn at reset, and its memory."""

Record = Any


@njit(cache=True)
def uniform(m: Record) -> float:
    """A number in [0, 1) from the row's own generator (splitmix64 by Steele, Lea and Flood)."""
    m.key = m.key + np.uint64(0x9E3779B97F4A7C15)
    z = m.key
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * 2.0**-53


@njit(cache=True)
def gaussian(m: Record) -> float:
    """A standard normal number (Box and Muller)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(m)))
    return radius * math.cos(2.0 * math.pi * uniform(m))


@njit(cache=True, inline="always")  # numba returns no tuple that holds a record
def real_params(m: Record, p: EnvParams) -> EnvParams:
    """The parameters with the machine's own lengths, chamfer, tolerance and base."""
    a, b = m.lengths, m.base
    return EnvParams(
        RRSParams(a[0], a[1], a[2], a[3], *p.rrs[4:]),
        DeltaParams(a[4], a[5], a[6], a[7], *p.delta[4:]),
        TaskParams(
            m.chamfer, m.tolerance, *p.task[2:-7], b[0], b[1], b[2],
            math.cos(b[3]), math.sin(b[3]), math.cos(b[4]), math.sin(b[4]),
        ),
        p.reward,
        p.layout,
    )  # fmt: skip


@njit(cache=True)
def _answer(m: Record, joint: int, command: float) -> float:
    """Where a joint goes: to the nearest encoder count, less what its play takes up."""
    if m.resolution > 0.0:
        command = m.resolution * np.floor(command / m.resolution + 0.5)
    half = 0.5 * m.backlash
    return min(max(m.joints[joint], command - half), command + half)


@njit(cache=True)
def answer(m: Record, theta: Row, q: Row) -> tuple[Row, Row]:
    """Where the six joints go when theta and q are commanded, rad."""
    return (
        (_answer(m, 0, theta[0]), _answer(m, 1, theta[1]), _answer(m, 2, theta[2])),
        (_answer(m, 3, q[0]), _answer(m, 4, q[1]), _answer(m, 5, q[2])),
    )


@njit(cache=True)
def forward(m: Record, theta: Row, q: Row, real: EnvParams) -> tuple[bool, Row, Row]:
    """Effector position and (roll, pitch, heave) of the joints; False if the links cannot close."""
    a = m.actual
    ok_delta, position = delta_kernels.forward(theta, real.delta)
    ok_rrs, tilt, _ = rrs_forward_kernels.forward(q, a[3], a[4], a[5], real.rrs)
    return ok_delta and ok_rrs, position, tilt


@njit(cache=True)
def displaced(m: Record, pose: Pose) -> Pose:
    """The platform's pose with the base where it really stands, as the Delta meets it."""
    b = m.base
    cr, sr, cp, sp = math.cos(b[3]), math.sin(b[3]), math.cos(b[4]), math.sin(b[4])
    e0, e1, e2 = (cp, 0.0, sp), (sr * sp, cr, -sr * cp), (-cr * sp, sr, cr * cp)
    r0 = (pose.r00, pose.r10, pose.r20)
    r1 = (pose.r01, pose.r11, pose.r21)
    r2 = (pose.r02, pose.r12, pose.r22)
    return Pose(
        b[0] + e0[0] * pose.x + e0[1] * pose.y + e0[2] * pose.z,
        b[1] + e1[0] * pose.x + e1[1] * pose.y + e1[2] * pose.z,
        b[2] + e2[0] * pose.x + e2[1] * pose.y + e2[2] * pose.z,
        dot(e0, r0), dot(e0, r1), dot(e0, r2),
        dot(e1, r0), dot(e1, r1), dot(e1, r2),
        dot(e2, r0), dot(e2, r1), dot(e2, r2),
    )  # fmt: skip
