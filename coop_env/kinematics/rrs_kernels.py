"""Scalar kernels of the 3-RRS: pose, inverse kinematics, Jacobian, signed sigma_min.

Library, step kernel, planners and design stage all call these. Frame: the 3-RRS's base, z up.
Limb i has azimuth 0, 120 or 240 degrees, radial direction u_i and tangential t_i.
"""

import math
from typing import Final, NamedTuple

from coop_env.compilation import njit
from coop_env.errors import ArgumentError
from coop_env.geometry import RRSGeometry
from coop_env.kinematics.singularity import Matrix3, Row, cross, manipulability, solve_3x3

_H: Final = math.sqrt(3.0) / 2.0
LIMB_COS: Final = (1.0, -0.5, -0.5)
LIMB_SIN: Final = (0.0, _H, -_H)
# A lattice of moves lands on a limit only up to rounding; this much beyond it still counts.
LIMIT_SLACK: Final = 1e-12


class RRSParams(NamedTuple):
    """A geometry as numba takes it; see :class:`coop_env.geometry.RRSGeometry` for the fields."""

    base_radius: float
    proximal_length: float
    platform_radius: float
    distal_length: float
    joint_min: float
    joint_max: float
    max_tilt: float
    heave_min: float
    heave_max: float
    characteristic_length: float
    exact: bool
    home_sign: float


class Pose(NamedTuple):
    """Platform centre (m) and rotation matrix by rows, in the 3-RRS's base frame."""

    x: float
    y: float
    z: float
    r00: float
    r01: float
    r02: float
    r10: float
    r11: float
    r12: float
    r20: float
    r21: float
    r22: float


@njit(cache=True)
def platform_pose(roll: float, pitch: float, heave: float, p: RRSParams) -> Pose:
    """Pose of the platform at (roll, pitch, heave).

    With ``p.exact`` it has zero torsion and the parasitic x, y that keep each spherical joint in
    its limb's plane. Otherwise it is the paper's ``Rx Ry`` on the axis.
    """
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    nx, ny, nz = sp, -sr * cp, cr * cp  # Rx(roll) Ry(pitch) z
    if p.exact:
        k = 1.0 / (1.0 + nz)
        half = 0.5 * p.platform_radius * k
        return Pose(
            half * (ny * ny - nx * nx), 2.0 * half * nx * ny, heave,
            1.0 - k * nx * nx, -k * nx * ny, nx,
            -k * nx * ny, 1.0 - k * ny * ny, ny,
            -nx, -ny, nz,
        )  # fmt: skip
    return Pose(0.0, 0.0, heave, cp, 0.0, nx, sr * sp, cr, ny, -cr * sp, sr, nz)


@njit(cache=True)
def joint_offset(pose: Pose, limb: int, platform_radius: float) -> Row:
    """r_i = Rp R u_i: platform centre to spherical joint of a limb, base frame, m."""
    c, s = LIMB_COS[limb] * platform_radius, LIMB_SIN[limb] * platform_radius
    return (
        pose.r00 * c + pose.r01 * s,
        pose.r10 * c + pose.r11 * s,
        pose.r20 * c + pose.r21 * s,
    )


@njit(cache=True)
def limb_triangle(pose: Pose, limb: int, p: RRSParams) -> Row:
    """(radial, height, c): a spherical joint seen from its base joint, and the crank's cosine.

    The limb reaches iff |c| <= 1, so 1 - |c| is its margin; NaN on the base joint itself.
    """
    r = joint_offset(pose, limb, p.platform_radius)
    radial = LIMB_COS[limb] * (pose.x + r[0]) + LIMB_SIN[limb] * (pose.y + r[1]) - p.base_radius
    height = pose.z + r[2]
    d2 = radial * radial + height * height
    if not d2 > 0.0:
        return radial, height, math.nan
    c = (p.proximal_length * p.proximal_length + d2 - p.distal_length * p.distal_length) / (
        2.0 * p.proximal_length * math.sqrt(d2)
    )
    return radial, height, c


@njit(cache=True)
def limb_ik(pose: Pose, limb: int, p: RRSParams) -> tuple[bool, float]:
    """Whether a limb's actuated angle q is real, and q in (-pi, pi], elbow out (NaN if not), rad.

    |c| <= 1 also refuses joints nearer than ``L2 - L1``, which the paper's ``|D - L1| <= L2`` lets
    pass.
    """
    radial, height, c = limb_triangle(pose, limb, p)
    if not abs(c) <= 1.0:
        return False, math.nan
    q = math.atan2(height, radial) - math.acos(c)
    return True, q if q > -math.pi else q + 2.0 * math.pi


@njit(cache=True)
def limb_points(pose: Pose, q: float, limb: int, p: RRSParams) -> tuple[Row, Row, Row]:
    """Base joint, elbow and spherical joint of a limb at its actuated angle, base frame, m."""
    c, s = LIMB_COS[limb], LIMB_SIN[limb]
    reach = p.base_radius + p.proximal_length * math.cos(q)
    r = joint_offset(pose, limb, p.platform_radius)
    return (
        (p.base_radius * c, p.base_radius * s, 0.0),
        (reach * c, reach * s, p.proximal_length * math.sin(q)),
        (pose.x + r[0], pose.y + r[1], pose.z + r[2]),
    )


@njit(cache=True)
def inverse(pose: Pose, p: RRSParams) -> tuple[bool, Row]:
    """Whether all three actuated angles of a pose are real, and (q0, q1, q2), rad."""
    ok0, q0 = limb_ik(pose, 0, p)
    ok1, q1 = limb_ik(pose, 1, p)
    ok2, q2 = limb_ik(pose, 2, p)
    return ok0 and ok1 and ok2, (q0, q1, q2)


@njit(cache=True)
def within_limits(roll: float, pitch: float, heave: float, p: RRSParams) -> bool:
    """Whether tilt and heave lie in the paper's W_RRS (NaN does not)."""
    return (
        abs(roll) <= p.max_tilt + LIMIT_SLACK
        and abs(pitch) <= p.max_tilt + LIMIT_SLACK
        and p.heave_min - LIMIT_SLACK <= heave <= p.heave_max + LIMIT_SLACK
    )


@njit(cache=True)
def joints_within_limits(q: Row, p: RRSParams) -> bool:
    """Whether all three actuated angles lie within the joint limits (NaN does not)."""
    low, high = p.joint_min - LIMIT_SLACK, p.joint_max + LIMIT_SLACK
    return low <= q[0] <= high and low <= q[1] <= high and low <= q[2] <= high


@njit(cache=True)
def is_valid(roll: float, pitch: float, heave: float, p: RRSParams) -> bool:
    """Whether a pose is within tilt and heave limits, reachable, and within the joint limits."""
    if not within_limits(roll, pitch, heave, p):
        return False
    reachable, q = inverse(platform_pose(roll, pitch, heave, p), p)
    return reachable and joints_within_limits(q, p)


@njit(cache=True)
def _plane(pose: Pose, limb: int, platform_radius: float) -> tuple[Row, float, float]:
    """A limb plane's factors of (vx, vy, wz), and those of wx and wy, moved to the right side."""
    tx, ty = -LIMB_SIN[limb], LIMB_COS[limb]
    r = joint_offset(pose, limb, platform_radius)
    return (tx, ty, r[0] * ty - r[1] * tx), r[2] * ty, -r[2] * tx  # as t_z = 0


@njit(cache=True)
def parasitic_rates(pose: Pose, platform_radius: float) -> tuple[Row, Row]:
    """(vx, vy, wz) per unit wx and per unit wy, from the three limb-plane constraints.

    ``t_i . v + (r_i x t_i) . w = 0`` for i = 0, 1, 2, solved by Cramer's rule.
    """
    m0, x0, y0 = _plane(pose, 0, platform_radius)
    m1, x1, y1 = _plane(pose, 1, platform_radius)
    m2, x2, y2 = _plane(pose, 2, platform_radius)
    return solve_3x3((m0, m1, m2), (x0, x1, x2)), solve_3x3((m0, m1, m2), (y0, y1, y2))


@njit(cache=True)
def _limb_rows(
    pose: Pose, limb: int, q: float, rate_x: Row, rate_y: Row, p: RRSParams
) -> tuple[Row, float]:
    """A limb's row of A and its entry of the diagonal B."""
    u, w = LIMB_COS[limb], LIMB_SIN[limb]
    r = joint_offset(pose, limb, p.platform_radius)
    reach = p.base_radius + p.proximal_length * math.cos(q)
    dx = (pose.x + r[0] - reach * u) / p.distal_length
    dy = (pose.y + r[1] - reach * w) / p.distal_length
    dz = (pose.z + r[2] - p.proximal_length * math.sin(q)) / p.distal_length
    mx, my, mz = cross(r, (dx, dy, dz))
    row = (
        mx + dx * rate_x[0] + dy * rate_x[1] + mz * rate_x[2],
        my + dx * rate_y[0] + dy * rate_y[1] + mz * rate_y[2],
        dz * p.characteristic_length,
    )
    b = p.proximal_length * (-math.sin(q) * (dx * u + dy * w) + math.cos(q) * dz)
    return row, b


@njit(cache=True)
def jacobian_parts(pose: Pose, q: Row, p: RRSParams) -> tuple[Matrix3, Row]:
    """A by rows and the diagonal of B, with ``B qdot = A (wx, wy, vz / eta)``; both in m."""
    rate_x, rate_y = parasitic_rates(pose, p.platform_radius)
    a0, b0 = _limb_rows(pose, 0, q[0], rate_x, rate_y, p)
    a1, b1 = _limb_rows(pose, 1, q[1], rate_x, rate_y, p)
    a2, b2 = _limb_rows(pose, 2, q[2], rate_x, rate_y, p)
    return (a0, a1, a2), (b0, b1, b2)


@njit(cache=True)
def signed_sigma_min(pose: Pose, q: Row, p: RRSParams) -> float:
    """Least singular value of J, with the sign of det A relative to home.

    It is zero at a type II (parallel) singularity. Unsigned, sigma would rise again beyond it, and
    a coarse grid would step across without notice.
    """
    a, b = jacobian_parts(pose, q, p)
    return manipulability(a, b, p.home_sign)[1]


@njit(cache=True)
def sigma_at(roll: float, pitch: float, heave: float, p: RRSParams) -> float:
    """Signed sigma_min at a pose; NaN where a limb cannot reach it."""
    pose = platform_pose(roll, pitch, heave, p)
    reachable, q = inverse(pose, p)
    if not reachable:
        return math.nan
    return signed_sigma_min(pose, q, p)


def make_params(geometry: RRSGeometry, pose_model: str = "exact") -> RRSParams:
    """A geometry and a pose model, ``"exact"`` or ``"paper"``, as the kernels take them."""
    if pose_model not in ("exact", "paper"):
        raise ArgumentError(f"pose_model = {pose_model!r}: must be 'exact' or 'paper'")
    own = [getattr(geometry, name) for name in RRSParams._fields[:-2]]
    p = RRSParams._make([*own, pose_model == "exact", 1.0])
    # A home that cannot be assembled leaves NaN here; its sigma is NaN everywhere it matters.
    home = sigma_at(0.0, 0.0, geometry.home_heave, p)
    return p._replace(home_sign=-1.0 if home < 0.0 else 1.0)
