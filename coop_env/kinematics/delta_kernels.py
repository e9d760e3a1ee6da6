"""Scalar kernels of the Delta robot: inverse and forward kinematics, Jacobian and workspace.

Frame: the Delta's base, z up, so that the effector's z is negative. Limb i has azimuth 0, 120, 240
degrees. theta is measured down from the outward horizontal; the working mode is "knees out".
"""

import math
from typing import NamedTuple

from coop_env.compilation import njit
from coop_env.geometry import DeltaGeometry
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN, LIMIT_SLACK
from coop_env.kinematics.singularity import Matrix3, Row, cross, dot, minus


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
def limb_triangle(x: float, y: float, z: float, limb: int, p: DeltaParams) -> tuple[float, float]:
    """(radial, k): the effector's joint seen from the base joint, and the cosine there.

    The limb reaches iff |k| <= 1, so 1 - |k| is its margin; NaN on the base joint itself.
    """
    c, s = LIMB_COS[limb], LIMB_SIN[limb]
    radial = c * x + s * y + p.effector_radius - p.base_radius
    tangential = c * y - s * x
    r = math.hypot(radial, z)
    if not r > 0.0:
        return radial, math.nan
    crank, rod = p.proximal_length, p.distal_length
    d2 = radial * radial + tangential * tangential + z * z
    return radial, (d2 + crank * crank - rod * rod) / (2.0 * crank * r)


@njit(cache=True)
def limb_ik(x: float, y: float, z: float, limb: int, p: DeltaParams) -> tuple[bool, float]:
    """Whether a limb's actuated angle theta is real, and theta (rad, knee out; NaN if not)."""
    radial, k = limb_triangle(x, y, z, limb, p)
    if not abs(k) <= 1.0:
        return False, math.nan
    return True, math.atan2(-z, radial) - math.acos(k)


@njit(cache=True)
def inverse(x: float, y: float, z: float, p: DeltaParams) -> tuple[bool, Row]:
    """Whether all three actuated angles are real, and (theta0, theta1, theta2), rad."""
    ok0, t0 = limb_ik(x, y, z, 0, p)
    ok1, t1 = limb_ik(x, y, z, 1, p)
    ok2, t2 = limb_ik(x, y, z, 2, p)
    return ok0 and ok1 and ok2, (t0, t1, t2)


@njit(cache=True)
def knee(theta: float, limb: int, p: DeltaParams) -> Row:
    """A knee moved inwards by the effector's radius: the effector's centre lies l_p from it, m."""
    return _knee_at(math.cos(theta), math.sin(theta), limb, p)


@njit(cache=True)
def _knee_at(cos: float, sin: float, limb: int, p: DeltaParams) -> Row:
    reach = p.base_radius - p.effector_radius + p.proximal_length * cos
    return reach * LIMB_COS[limb], reach * LIMB_SIN[limb], -p.proximal_length * sin


@njit(cache=True)
def _knee_below(x: float, y: float, z: float, limb: int, p: DeltaParams) -> Row:
    """:func:`knee` of a position, without its angle: masks ask for six a step. NaN out of reach."""
    radial, k = limb_triangle(x, y, z, limb, p)
    if not abs(k) <= 1.0:
        return math.nan, math.nan, math.nan
    r, s = math.hypot(radial, z), math.sqrt(1.0 - k * k)
    return _knee_at((radial * k - z * s) / r, -(z * k + radial * s) / r, limb, p)


@njit(cache=True)
def forward(theta: Row, p: DeltaParams) -> tuple[bool, Row]:
    """Whether the limbs of three actuated angles meet, and the effector's centre, m (NaN if not).

    The spheres of radius l_p about the three moved knees meet in two points, mirror images in the
    knees' plane; of the two assembly modes this is the one in which the effector hangs at home.
    """
    nan = (math.nan, math.nan, math.nan)
    a, b, c = knee(theta[0], 0, p), knee(theta[1], 1, p), knee(theta[2], 2, p)
    e, f = minus(b, a), minus(c, a)
    n = cross(e, f)
    nn, ee, ff = dot(n, n), dot(e, e), dot(f, f)
    if not nn > 1e-12 * ee * ff:  # knees in a line: no plane to mirror in
        return False, nan
    # m: from knee a to the centre of the circle through the three knees
    w = cross((ee * f[0] - ff * e[0], ee * f[1] - ff * e[1], ee * f[2] - ff * e[2]), n)
    m = (w[0] / (2.0 * nn), w[1] / (2.0 * nn), w[2] / (2.0 * nn))
    h2 = p.distal_length * p.distal_length - dot(m, m)
    if not h2 >= 0.0:
        return False, nan
    h = -math.sqrt(h2 / nn)
    return True, (a[0] + m[0] + h * n[0], a[1] + m[1] + h * n[1], a[2] + m[2] + h * n[2])


@njit(cache=True)
def jacobian_parts(x: float, y: float, z: float, theta: Row, p: DeltaParams) -> tuple[Matrix3, Row]:
    """A by rows (the distal links' directions, l_a long) and the diagonal of B, both in m.

    ``B thetadot = A v / l_a`` with v the effector's velocity.
    """
    a0, b0 = _limb_row(x, y, z, theta[0], 0, p)
    a1, b1 = _limb_row(x, y, z, theta[1], 1, p)
    a2, b2 = _limb_row(x, y, z, theta[2], 2, p)
    return (a0, a1, a2), (b0, b1, b2)


@njit(cache=True)
def _limb_row(
    x: float, y: float, z: float, theta: float, limb: int, p: DeltaParams
) -> tuple[Row, float]:
    k = knee(theta, limb, p)
    dx = (x - k[0]) / p.distal_length
    dy = (y - k[1]) / p.distal_length
    dz = (z - k[2]) / p.distal_length
    inward = dx * LIMB_COS[limb] + dy * LIMB_SIN[limb]
    b = -p.proximal_length * (math.sin(theta) * inward + math.cos(theta) * dz)
    return (p.proximal_length * dx, p.proximal_length * dy, p.proximal_length * dz), b


@njit(cache=True)
def within_limits(x: float, y: float, z: float, p: DeltaParams) -> bool:
    """Whether a position lies in the paper's W_Delta, its sign error corrected (NaN does not).

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
    """Whether a position is within the workspace, real on all limbs, and in home's assembly mode.

    The other mode lies beyond the plane through the knees, across a parallel singularity.
    """
    if not within_limits(x, y, z, p):
        return False
    a, b = _knee_below(x, y, z, 0, p), _knee_below(x, y, z, 1, p)
    n = cross(minus(b, a), minus(_knee_below(x, y, z, 2, p), a))
    # on the side that :func:`forward` takes; NaN is on none
    return dot(minus((x, y, z), a), n) < 0.0


def make_params(geometry: DeltaGeometry) -> DeltaParams:
    """A geometry as the kernels take it."""
    return DeltaParams(*(getattr(geometry, name) for name in DeltaParams._fields))
