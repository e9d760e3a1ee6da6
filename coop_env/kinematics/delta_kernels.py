"""Scalar kernels of the Delta robot: inverse kinematics and workspace.

Frame: the Delta's base, z up, so that the effector's z is negative. Limb i has azimuth 0, 120, 240
degrees. theta is measured down from the outward horizontal; the working mode is "knees out".
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from coop_env.geometry import DeltaGeometry
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN, LIMIT_SLACK
from coop_env.kinematics.singularity import Row


class DeltaParams(NamedTuple):
    """A Delta as numba takes it; see :class:`coop_env.geometry.DeltaGeometry` for the fields."""

    base_radius: float
    effector_radius: float
    proximal_length: float
    distal_length: float
    base_height: float
    peg_length: float
    peg_radius: float
    planar_limit: float


@njit(cache=True)
def limb_ik(x: float, y: float, z: float, limb: int, p: DeltaParams) -> tuple[bool, float]:
    """Actuated angle theta of a limb (rad, knee out), and whether it is real; NaN if it is not."""
    c, s = LIMB_COS[limb], LIMB_SIN[limb]
    radial = c * x + s * y + p.effector_radius - p.base_radius
    tangential = c * y - s * x
    r = math.hypot(radial, z)
    if not r > 0.0:
        return False, math.nan
    k = (
        radial * radial
        + tangential * tangential
        + z * z
        + p.proximal_length * p.proximal_length
        - p.distal_length * p.distal_length
    ) / (2.0 * p.proximal_length * r)
    if not abs(k) <= 1.0:
        return False, math.nan
    return True, math.atan2(-z, radial) - math.acos(k)


@njit(cache=True)
def inverse(x: float, y: float, z: float, p: DeltaParams) -> tuple[bool, Row]:
    """Actuated angles (theta0, theta1, theta2), rad, and whether all three are real."""
    ok0, t0 = limb_ik(x, y, z, 0, p)
    ok1, t1 = limb_ik(x, y, z, 1, p)
    ok2, t2 = limb_ik(x, y, z, 2, p)
    return ok0 and ok1 and ok2, (t0, t1, t2)


@njit(cache=True)
def within_limits(x: float, y: float, z: float, p: DeltaParams) -> bool:
    """Whether a position lies in the paper's W_Delta, its sign slip mended (NaN does not).

    The paper's upper bound on z, -(l_a - l_p), is above the base; -|l_a - l_p| is meant.
    """
    return (
        -(p.proximal_length + p.distal_length) - LIMIT_SLACK
        <= z
        <= -abs(p.proximal_length - p.distal_length) + LIMIT_SLACK
        and math.hypot(x, y) <= p.planar_limit + LIMIT_SLACK
    )


@njit(cache=True)
def is_valid(x: float, y: float, z: float, p: DeltaParams) -> bool:
    """Whether a position is within the workspace and real on all three limbs."""
    return within_limits(x, y, z, p) and inverse(x, y, z, p)[0]


def make_params(geometry: DeltaGeometry) -> DeltaParams:
    """A geometry as the kernels take it."""
    g = geometry
    return DeltaParams(
        g.base_radius,
        g.effector_radius,
        g.proximal_length,
        g.distal_length,
        g.base_height,
        g.peg_length,
        g.peg_radius,
        g.planar_limit,
    )
