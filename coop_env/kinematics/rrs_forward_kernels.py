"""Scalar kernels of the 3-RRS's forward kinematics: continuation that stays on its branch.

Given actuated angles q, up to 16 platform poses close the limbs. Which of them the machine is in
follows from where it was, so the solver walks q from the previous pose's angles to the goal's and
tracks the pose, refusing steps in which Newton's method may have left the branch.
"""

import math
from typing import Final

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels as rrs
from coop_env.kinematics.singularity import Matrix3, Row, cross, determinant_3x3, minus, solve_3x3

Twist = tuple[float, float, float, float, float]  # vx, vy, wx, wy, wz

_TOLERANCE: Final = 1e-14  # relative to eta; some 50 times the rounding of the residual
_MAX_NEWTON: Final = 12
_CONTRACTION: Final = 0.25  # Newton's corrections must shrink at least so fast, or the step halves
_MAX_MOVE: Final = 0.1  # largest change of the pose in one step, rad and heave / eta
_MIN_FRACTION: Final = 1e-10  # of the way in q; below it the branch ends: a parallel singularity


@njit(cache=True)
def twists(roll: float, pitch: float, pose: rrs.Pose, p: rrs.RRSParams) -> tuple[Twist, Twist]:
    """The platform's twist per unit rate of roll and of pitch, base frame.

    In the exact model w turns the normal as asked, and vx, vy and the part of w along the normal
    follow from the limb planes. In the paper's model it is that of ``Rx Ry``.
    """
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    if not p.exact:
        return (0.0, 0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, cr, sr)
    per_x, per_y = rrs.parasitic_rates(pose, p.platform_radius)
    n = (pose.r02, pose.r12, pose.r22)
    return (
        _turning(n, (0.0, -cr * cp, -sr * cp), per_x, per_y),
        _turning(n, (cp, sr * sp, -cr * sp), per_x, per_y),
    )


@njit(cache=True)
def _turning(n: Row, rate: Row, per_x: Row, per_y: Row) -> Twist:
    """The twist with ``w x n = rate``; (vx, vy, wz) are ``per_x wx + per_y wy``."""
    mx, my, mz = cross(n, rate)
    along = (per_x[2] * mx + per_y[2] * my - mz) / (n[2] - per_x[2] * n[0] - per_y[2] * n[1])
    wx, wy, wz = mx + along * n[0], my + along * n[1], mz + along * n[2]
    return per_x[0] * wx + per_y[0] * wy, per_x[1] * wx + per_y[1] * wy, wx, wy, wz


@njit(cache=True)
def closure(
    roll: float, pitch: float, heave: float, q: Row, p: rrs.RRSParams
) -> tuple[Row, Matrix3]:
    """How far each distal link is from closing, over eta, and its derivative by the pose.

    ``f_i = (D_i^2 - L2^2) / (2 L2 eta)``, D_i from elbow to spherical joint in the limb's plane;
    columns of the derivative are roll, pitch and heave / eta.
    """
    pose = rrs.platform_pose(roll, pitch, heave, p)
    per_roll, per_pitch = twists(roll, pitch, pose, p)
    f0, g0 = _limb_closure(pose, 0, q[0], per_roll, per_pitch, p)
    f1, g1 = _limb_closure(pose, 1, q[1], per_roll, per_pitch, p)
    f2, g2 = _limb_closure(pose, 2, q[2], per_roll, per_pitch, p)
    return (f0, f1, f2), (g0, g1, g2)


@njit(cache=True)
def _limb_closure(
    pose: rrs.Pose, limb: int, q: float, per_roll: Twist, per_pitch: Twist, p: rrs.RRSParams
) -> tuple[float, Row]:
    radial, height, _ = rrs.limb_triangle(pose, limb, p)
    er = radial - p.proximal_length * math.cos(q)
    ez = height - p.proximal_length * math.sin(q)
    scale = 1.0 / (p.distal_length * p.characteristic_length)
    f = 0.5 * scale * (er * er + ez * ez - p.distal_length * p.distal_length)
    r = rrs.joint_offset(pose, limb, p.platform_radius)
    roll = _joint_rate(r, limb, er, ez, per_roll)
    pitch = _joint_rate(r, limb, er, ez, per_pitch)
    return f, (scale * roll, scale * pitch, scale * ez * p.characteristic_length)


@njit(cache=True)
def _joint_rate(r: Row, limb: int, er: float, ez: float, twist: Twist) -> float:
    """Velocity along (er, ez) of the spherical joint at r from the platform's centre."""
    vx, vy, wx, wy, wz = twist
    dx = vx + wy * r[2] - wz * r[1]
    dy = vy + wz * r[0] - wx * r[2]
    dz = wx * r[1] - wy * r[0]
    return er * (rrs.LIMB_COS[limb] * dx + rrs.LIMB_SIN[limb] * dy) + ez * dz


@njit(cache=True)
def _norm(v: Row) -> float:
    return max(abs(v[0]), abs(v[1]), abs(v[2]))


@njit(cache=True)
def _correct(x: Row, q: Row, side: float, p: rrs.RRSParams) -> tuple[bool, Row]:
    """Newton's method from ``x`` (roll, pitch, heave / eta) to the pose of q on the same branch.

    Refused if the first corrections do not contract, if the pose moves far, or if the determinant
    leaves its side: each is a sign that another branch is being reached.
    """
    eta = p.characteristic_length
    y = x
    last = math.inf
    for _ in range(_MAX_NEWTON):
        f, g = closure(y[0], y[1], y[2] * eta, q, p)
        if not determinant_3x3(g) * side > 0.0:
            return False, x
        if _norm(f) <= _TOLERANCE:
            return True, y
        d = solve_3x3(g, f)
        size = _norm(d)
        if size <= 1e-15:  # no more digits to gain
            return _norm(f) <= 100.0 * _TOLERANCE, y
        if not size <= max(_CONTRACTION * last, 1e-12):
            return False, x
        y = minus(y, d)
        if _norm(minus(y, x)) > _MAX_MOVE:
            return False, x
        last = size
    return False, x


@njit(cache=True)
def forward(
    q: Row, roll: float, pitch: float, heave: float, p: rrs.RRSParams
) -> tuple[bool, Row, float]:
    """Whether q was reached by continuation from a pose, its pose (NaN if not), and the residual.

    The residual is the largest error of a distal link's closing at the last pose, m.
    """
    nan = (math.nan, math.nan, math.nan)
    eta = p.characteristic_length
    reachable, start = rrs.inverse(rrs.platform_pose(roll, pitch, heave, p), p)
    if not (reachable and math.isfinite(q[0] + q[1] + q[2])):
        return False, nan, math.nan
    x = (roll, pitch, heave / eta)
    side = determinant_3x3(closure(roll, pitch, heave, start, p)[1])
    done, step = 0.0, 1.0
    while done < 1.0:
        end = min(done + step, 1.0)
        goal = (
            start[0] + end * (q[0] - start[0]),
            start[1] + end * (q[1] - start[1]),
            start[2] + end * (q[2] - start[2]),
        )
        if end == 1.0:
            goal = q
        ok, x = _correct(x, goal, side, p)
        if ok:
            done, step = end, 2.0 * step
        else:
            step = 0.5 * (end - done)
            if step < _MIN_FRACTION:
                return False, nan, eta * _norm(closure(x[0], x[1], x[2] * eta, q, p)[0])
    residual = eta * _norm(closure(x[0], x[1], x[2] * eta, q, p)[0])
    return True, (x[0], x[1], x[2] * eta), residual
