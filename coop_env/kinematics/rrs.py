"""The 3-RRS, batched: ``(..., 3)`` in, ``(..., m)`` out, for any ``RRSGeometry``.

A pose is (roll, pitch, heave) in rad, rad, m, in the 3-RRS's base frame, z up; the normal of the
platform is ``Rx(roll) Ry(pitch) z``. Limbs have azimuths 0, 120 and 240 degrees; their actuated
angles q are measured up from the outward horizontal, elbow out. x, y and yaw are parasitic: the
mechanism forces them (``pose_model="exact"``). ``pose_model="paper"`` puts the centre on the axis
and the rotation at ``Rx Ry``, as the paper has it; then the spherical joints leave their limbs'
planes by :func:`plane_offset`.

An unreachable pose gives NaN and ``reachable=False``, and so does NaN. Every function raises
:class:`ShapeError` for a wrong last axis, :class:`TypeError` for what is not real numbers and
:class:`ValueError` for an unknown pose model.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coop_env.geometry import OPTIMIZED, RRSGeometry
from coop_env.kinematics import rrs_forward_kernels as fk
from coop_env.kinematics import rrs_kernels as kernels
from coop_env.kinematics._batch import Bools, Floats, as_points, over_rows, require_broadcast
from coop_env.kinematics._batch import ShapeError as ShapeError
from coop_env.kinematics.singularity import manipulability


class PlatformPose(NamedTuple):
    """The platform's centre ``(..., 3)``, m, and rotation matrix ``(..., 3, 3)``."""

    position: Floats
    rotation: Floats


class Inverse(NamedTuple):
    """Actuated angles ``(..., 3)`` in rad, NaN where not ``reachable`` ``(...)``."""

    q: Floats
    reachable: Bools


class Forward(NamedTuple):
    """Poses ``(..., 3)``, NaN where not ``converged``; ``residual`` ``(...)`` in m."""

    pose: Floats
    residual: Floats
    converged: Bools


_params = lru_cache(maxsize=256)(kernels.make_params)


def _pose(value: ArrayLike, name: str = "pose") -> Floats:
    return as_points(name, value, "roll", "pitch", "heave")


def _given(pose: ArrayLike, geometry: RRSGeometry, pose_model: str) -> tuple[Any, Floats]:
    return _params(geometry, pose_model), _pose(pose)


@over_rows("3f8", "(3,3)f8", "3f8")
def _poses(
    p: Any, roll: Any, pitch: Any, heave: Any, position: Any, rotation: Any, offset: Any
) -> None:
    for n in range(len(roll)):
        at = kernels.platform_pose(roll[n], pitch[n], heave[n], p)
        position[n] = (at.x, at.y, at.z)
        rotation[n, 0] = (at.r00, at.r01, at.r02)
        rotation[n, 1] = (at.r10, at.r11, at.r12)
        rotation[n, 2] = (at.r20, at.r21, at.r22)
        for i in range(3):
            r = kernels.joint_offset(at, i, p.platform_radius)
            c, s = kernels.LIMB_COS[i], kernels.LIMB_SIN[i]
            offset[n, i] = c * (at.y + r[1]) - s * (at.x + r[0])


def platform_pose(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> PlatformPose:
    """Centre and rotation of the platform.

    Exact: zero torsion, ``R`` the least rotation that takes z to the normal n, and
    ``x = Rp k (ny^2 - nx^2) / 2``, ``y = Rp k nx ny`` with ``k = 1 / (1 + nz)``.

    >>> at = platform_pose([0.2, 0.4, 0.22])
    >>> at.position.round(6)
    array([-0.003459, -0.004172,  0.22    ])
    >>> at.rotation[:, 2].round(6)  # the normal
    array([ 0.389418, -0.182987,  0.902701])
    """
    position, rotation, _ = _poses(*_given(pose, geometry, pose_model))
    return PlatformPose(position, rotation)


def parasitic(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """Parasitic motion (x, y, yaw) ``(..., 3)`` in m, m, rad, which nobody commands.

    yaw is psi in ``R = Rx(roll) Ry(pitch) Rz(psi)``; all three are zero in the paper's model.

    >>> parasitic([0.3, 0.3, 0.22]).round(6)
    array([-0.000222, -0.004859, -0.045676])
    >>> parasitic([0.3, 0.3, 0.22], pose_model="paper").tolist()
    [0.0, 0.0, 0.0]
    """
    at, r = platform_pose(pose, geometry, pose_model)
    yaw = np.arctan2(-r[..., 0, 1], r[..., 0, 0]) + 0.0  # no negative zero
    return np.concatenate([at[..., :2], yaw[..., None]], axis=-1)


def plane_offset(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """Distance ``(..., 3)`` in m by which each spherical joint lies out of its limb's plane.

    A revolute joint keeps the limb in its plane, so anything but zero cannot be built.

    >>> np.abs(plane_offset([0.3, 0.3, 0.22])).max() < 1e-16
    np.True_
    >>> (plane_offset([0.3, 0.3, 0.22], pose_model="paper") * 1e3).round(2)  # mm
    array([9.73, 2.43, 2.43])
    """
    return _poses(*_given(pose, geometry, pose_model))[2]


@over_rows("3f8", "3f8", "?", "?")
def _inverse(
    p: Any, roll: Any, pitch: Any, heave: Any, q: Any, margin: Any, reachable: Any, valid: Any
) -> None:
    for n in range(len(roll)):
        at = kernels.platform_pose(roll[n], pitch[n], heave[n], p)
        reachable[n], angles = kernels.inverse(at, p)
        for i in range(3):
            q[n, i] = angles[i] if reachable[n] else math.nan
            margin[n, i] = 1.0 - abs(kernels.limb_triangle(at, i, p)[2])
        valid[n] = kernels.is_valid(roll[n], pitch[n], heave[n], p)


def inverse(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Inverse:
    """Actuated angles of a pose, elbow out; limits are not applied (see :func:`is_valid`).

    With s the spherical joint, ``D^2 = (u.s - Rb)^2 + s_z^2`` and
    ``c = (L1^2 + D^2 - L2^2) / (2 L1 D)``: reachable iff ``|c| <= 1`` on all three limbs, and
    ``q = atan2(s_z, u.s - Rb) - acos c``, in (-pi, pi].

    >>> q, reachable = inverse([[0.0, 0.0, 0.21], [0.2, -0.1, 0.23], [0.0, 0.0, 0.5]])
    >>> q.round(6)
    array([[0.492879, 0.492879, 0.492879],
           [0.719939, 0.741311, 0.489148],
           [     nan,      nan,      nan]])
    >>> reachable.tolist()
    [True, True, False]
    """
    q, _, reachable, _ = _inverse(*_given(pose, geometry, pose_model))
    return Inverse(q, reachable)


def is_valid(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Bools:
    """Whether poses are reachable and within tilt, heave and joint limits ``(...)``.

    >>> is_valid([[0.0, 0.0, 0.21], [0.0, 0.0, 0.20], [0.8, 0.0, 0.21]]).tolist()
    [True, False, False]
    """
    return _inverse(*_given(pose, geometry, pose_model))[3]


def joint_margin(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """Angle ``(..., 3)`` in rad from each actuated joint to its nearer limit; negative beyond it.

    >>> np.degrees(joint_margin([0.0, 0.0, 0.21])).round(3)
    array([16.24, 16.24, 16.24])
    """
    q = inverse(pose, geometry, pose_model).q
    return np.minimum(q - geometry.joint_min, geometry.joint_max - q)


def limb_margin(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """``1 - |c|`` of each limb ``(..., 3)``, dimensionless; zero stretched or folded, negative
    out of reach.

    >>> limb_margin([[0.0, 0.0, 0.21], [0.0, 0.0, 0.5]]).round(3)
    array([[ 0.814,  0.814,  0.814],
           [-1.074, -1.074, -1.074]])
    """
    return _inverse(*_given(pose, geometry, pose_model))[1]


@over_rows("(3,3)f8", "f8", "f8")
def _jacobian(
    p: Any, roll: Any, pitch: Any, heave: Any, matrix: Any, signed: Any, kappa: Any
) -> None:
    matrix[:], signed[:], kappa[:] = math.nan, math.nan, math.nan
    for n in range(len(roll)):
        at = kernels.platform_pose(roll[n], pitch[n], heave[n], p)
        reachable, q = kernels.inverse(at, p)
        if reachable:
            a, b = kernels.jacobian_parts(at, q, p)
            j, signed[n], kappa[n] = manipulability(a, b, p.home_sign)
            matrix[n, 0], matrix[n, 1], matrix[n, 2] = j


def jacobian(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """J ``(..., 3, 3)`` with ``qdot = J (wx, wy, vz / eta)``, dimensionless; NaN out of reach.

    ``J = B^-1 A``: A's rows are the distal links' wrenches with (vx, vy, wz) eliminated through the
    three limb planes, ``B_i = L1 (d_i . n_q)``. With the paper's pose it is the mechanism's
    Jacobian at a place where the mechanism cannot be.

    >>> jacobian([0.0, 0.0, 0.21]).round(4)
    array([[ 0.    , -0.8121,  0.9003],
           [ 0.7033,  0.406 ,  0.9003],
           [-0.7033,  0.406 ,  0.9003]])
    """
    return _jacobian(*_given(pose, geometry, pose_model))[0]


def signed_sigma_min(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """Least singular value of J ``(...)`` with the sign of det A relative to home.

    It passes through zero at a type II (parallel) singularity and is negative beyond, where the
    unsigned value rises again; NaN out of reach.

    >>> roll = np.radians([0.0, 30.0, 36.0, 44.0])
    >>> signed_sigma_min(np.stack([roll, 0 * roll, 0 * roll + 0.21], axis=-1)).round(3)
    array([ 0.995,  0.263,  0.03 , -0.318])
    """
    return _jacobian(*_given(pose, geometry, pose_model))[1]


def condition_number(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """kappa ``(...)``, greatest over least singular value of J, at least 1; NaN out of reach.

    >>> float(condition_number([0.0, 0.0, 0.21]).round(4))
    1.5678
    """
    return _jacobian(*_given(pose, geometry, pose_model))[2]


@over_rows("(3,3)f8")
def _twist_matrix(p: Any, roll: Any, pitch: Any, heave: Any, matrix: Any) -> None:
    matrix[:] = 0.0
    for n in range(len(roll)):
        at = kernels.platform_pose(roll[n], pitch[n], heave[n], p)
        per_roll, per_pitch = fk.twists(roll[n], pitch[n], at, p)
        for i in range(2):
            matrix[n, i, 0], matrix[n, i, 1] = per_roll[2 + i], per_pitch[2 + i]
        matrix[n, 2, 2] = 1.0 / p.characteristic_length


def twist_matrix(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """E ``(..., 3, 3)`` with ``(wx, wy, vz / eta) = E (rolldot, pitchdot, heavedot)``.

    roll and pitch are angles of the normal, not integrals of wx and wy; at home the two agree.

    >>> twist_matrix([0.0, 0.0, 0.21]).round(4)
    array([[1.    , 0.    , 0.    ],
           [0.    , 1.    , 0.    ],
           [0.    , 0.    , 8.0972]])
    """
    return _twist_matrix(*_given(pose, geometry, pose_model))[0]


def joint_rates(pose: ArrayLike, rates: ArrayLike, geometry: RRSGeometry = OPTIMIZED) -> Floats:
    """Actuated rates ``(..., 3)`` in rad/s for rates (rolldot, pitchdot, heavedot), exact model.

    >>> joint_rates([0.0, 0.0, 0.21], [0.1, 0.0, 0.0]).round(4)
    array([ 0.    ,  0.0703, -0.0703])
    """
    at, speed = _pose(pose), as_points("rates", rates, "rolldot", "pitchdot", "heavedot")
    require_broadcast("pose", at, "rates", speed)
    return np.einsum(
        "...ij,...jk,...k->...i", jacobian(at, geometry), twist_matrix(at, geometry), speed
    )


@over_rows("3f8", "f8", "?")
def _forward(
    p: Any, q0: Any, q1: Any, q2: Any, roll: Any, pitch: Any, heave: Any,
    pose: Any, residual: Any, converged: Any,
) -> None:  # fmt: skip
    for n in range(len(q0)):
        q = (q0[n], q1[n], q2[n])
        converged[n], pose[n], residual[n] = fk.forward(q, roll[n], pitch[n], heave[n], p)


def forward(
    q: ArrayLike, previous: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Forward:
    """Poses of actuated angles, on the branch of the poses before them.

    Up to 16 poses close the limbs for one q ``(..., 3)``. This walks q in a straight line from the
    angles of ``previous`` ``(..., 3)`` and tracks the pose by Newton's method, in steps short
    enough that it contracts, with det A kept on its side. Where the branch ends on the way, in a
    parallel singularity, it says ``converged=False`` and gives NaN. A long step can pass over a gap
    in which no pose of the branch closes the limbs: give waypoints. The residual is the largest
    error of a distal link's closing, m; where it did not converge, at the last pose on the branch.

    >>> home = [0.0, 0.0, 0.21]
    >>> found = forward(inverse([0.2, -0.1, 0.23]).q, home)
    >>> found.pose.round(9), bool(found.converged), bool(found.residual < 1e-12)
    (array([ 0.2 , -0.1 ,  0.23]), True, True)
    >>> forward([1.5, 0.1, 0.1], home).converged  # the limbs cannot close from here
    np.False_
    """
    angles = as_points("q", q, "q0", "q1", "q2")
    before = _pose(previous, "previous")
    require_broadcast("q", angles, "previous", before)
    return Forward(*_forward(_params(geometry, pose_model), angles, before))


@over_rows("(3,3,3)f8")
def _limb_points(p: Any, roll: Any, pitch: Any, heave: Any, points: Any) -> None:
    for n in range(len(roll)):
        at = kernels.platform_pose(roll[n], pitch[n], heave[n], p)
        for i in range(3):
            _, q = kernels.limb_ik(at, i, p)
            points[n, i, 0], points[n, i, 1], points[n, i, 2] = kernels.limb_points(at, q, i, p)


def limb_points(
    pose: ArrayLike, geometry: RRSGeometry = OPTIMIZED, pose_model: str = "exact"
) -> Floats:
    """Base joint, elbow and spherical joint of each limb ``(..., 3 limbs, 3 points, 3)``, m.

    >>> limb_points([0.0, 0.0, 0.21])[0].round(4)
    array([[0.1778, 0.    , 0.    ],
           [0.268 , 0.    , 0.0485],
           [0.1114, 0.    , 0.21  ]])
    """
    return _limb_points(*_given(pose, geometry, pose_model))[0]
