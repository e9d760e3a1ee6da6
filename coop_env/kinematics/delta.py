"""The Delta robot, batched: ``(..., 3)`` in, ``(..., m)`` out, for any ``DeltaGeometry``.

Positions are of the effector's centre, in m, in the Delta's base frame, z up, so the effector hangs
at negative z. Limbs have azimuths 0, 120 and 240 degrees; their actuated angles theta are measured
down from the outward horizontal, working mode "knees out".

Out of reach gives NaN and ``reachable=False``, and so does NaN. Every function raises
:class:`~coop_env.kinematics.rrs.ShapeError` for a wrong last axis and :class:`TypeError` for what
is not real numbers.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coop_env.geometry import DELTA, DeltaGeometry
from coop_env.kinematics import delta_kernels as kernels
from coop_env.kinematics._batch import Bools, Floats, as_points, over_rows
from coop_env.kinematics._batch import ShapeError as ShapeError
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN
from coop_env.kinematics.singularity import manipulability


class Inverse(NamedTuple):
    """Actuated angles ``(..., 3)`` in rad, NaN where not ``reachable`` ``(...)``."""

    theta: Floats
    reachable: Bools


class Forward(NamedTuple):
    """Positions ``(..., 3)`` in m, NaN where not ``reachable``; ``residual`` ``(...)`` in m."""

    position: Floats
    residual: Floats
    reachable: Bools


_params = lru_cache(maxsize=256)(kernels.make_params)


def _given(position: ArrayLike, geometry: DeltaGeometry) -> tuple[Any, Floats]:
    return _params(geometry), as_points("position", position, "x", "y", "z")


@over_rows("3f8", "3f8", "?", "?")
def _inverse(
    p: Any, x: Any, y: Any, z: Any, theta: Any, margin: Any, reachable: Any, valid: Any
) -> None:
    for n in range(len(x)):
        reachable[n], angles = kernels.inverse(x[n], y[n], z[n], p)
        for i in range(3):
            theta[n, i] = angles[i] if reachable[n] else math.nan
            margin[n, i] = 1.0 - abs(kernels.limb_triangle(x[n], y[n], z[n], i, p)[1])
        valid[n] = kernels.is_valid(x[n], y[n], z[n], p)


def inverse(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Inverse:
    """Actuated angles of a position, knees out; limits are not applied (see :func:`is_valid`).

    >>> theta, reachable = inverse([[0.0, 0.0, -0.5], [0.1, -0.05, -0.45], [0.0, 0.0, -0.9]])
    >>> theta.round(6)
    array([[0.640713, 0.640713, 0.640713],
           [0.195992, 0.760383, 0.523628],
           [     nan,      nan,      nan]])
    >>> reachable.tolist()
    [True, True, False]
    """
    theta, _, reachable, _ = _inverse(*_given(position, geometry))
    return Inverse(theta, reachable)


@over_rows("3f8", "f8", "?")
def _forward(p: Any, a: Any, b: Any, c: Any, position: Any, residual: Any, reachable: Any) -> None:
    for n in range(len(a)):
        theta = (a[n], b[n], c[n])
        reachable[n], at = kernels.forward(theta, p)
        position[n] = at
        residual[n] = 0.0 if reachable[n] else math.nan
        for i in range(3):
            k = kernels.knee(theta[i], i, p)
            d = math.sqrt((at[0] - k[0]) ** 2 + (at[1] - k[1]) ** 2 + (at[2] - k[2]) ** 2)
            residual[n] = max(residual[n], abs(d - p.distal_length))


def forward(theta: ArrayLike, geometry: DeltaGeometry = DELTA) -> Forward:
    """Position of actuated angles ``(..., 3)``, by three spheres, in home's assembly mode.

    >>> found = forward([0.195992144, 0.760383495, 0.523628320])
    >>> found.position.round(6).tolist(), bool(found.reachable)
    ([0.1, -0.05, -0.45], True)
    """
    angles = as_points("theta", theta, "theta0", "theta1", "theta2")
    return Forward(*_forward(_params(geometry), angles))


def is_valid(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Bools:
    """Whether positions lie in the paper's W_Delta (sign error corrected) and all limbs reach.

    ``z`` in ``[-(l_a + l_p), -|l_a - l_p|]`` and ``sqrt(x^2 + y^2) <= 0.8 min(l_a, l_p)``.
    Limbs of other lengths may reach places beyond a parallel singularity, which are not valid.

    >>> is_valid([[0.0, 0.0, -0.5], [0.0, 0.0, -0.2], [0.17, 0.0, -0.4]]).tolist()
    [True, False, False]
    """
    return _inverse(*_given(position, geometry))[3]


def workspace_margin(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Distance ``(...)`` in m to the nearest bound of W_Delta; negative outside.

    >>> workspace_margin([[0.0, 0.0, -0.5], [0.0, 0.0, -0.2]]).round(6).tolist()
    [0.15, -0.05]
    """
    x, y, z = np.moveaxis(as_points("position", position, "x", "y", "z"), -1, 0)
    low = -(geometry.proximal_length + geometry.distal_length)
    high = -abs(geometry.proximal_length - geometry.distal_length)
    return np.minimum(np.minimum(z - low, high - z), geometry.planar_limit - np.hypot(x, y))


def limb_margin(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """``1 - |k|`` of each limb ``(..., 3)``, k the cosine at the base joint; negative out of reach.

    >>> limb_margin([[0.0, 0.0, -0.5], [0.0, 0.0, -0.9]]).round(3)
    array([[ 0.536,  0.536,  0.536],
           [-0.809, -0.809, -0.809]])
    """
    return _inverse(*_given(position, geometry))[1]


@over_rows("(3,3)f8", "f8", "f8")
def _jacobian(p: Any, x: Any, y: Any, z: Any, matrix: Any, signed: Any, kappa: Any) -> None:
    matrix[:], signed[:], kappa[:] = math.nan, math.nan, math.nan
    for n in range(len(x)):
        reachable, theta = kernels.inverse(x[n], y[n], z[n], p)
        if reachable:
            a, b = kernels.jacobian_parts(x[n], y[n], z[n], theta, p)
            # Hanging on the axis, the three distal links always make a negative determinant.
            j, signed[n], kappa[n] = manipulability(a, b, -1.0)
            matrix[n, 0], matrix[n, 1], matrix[n, 2] = j


def jacobian(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """J ``(..., 3, 3)`` with ``thetadot = J v / l_a``, dimensionless; NaN out of reach.

    ``J = B^-1 A``; A's rows are l_a times the distal links' directions, B_i the crank's leverage.

    >>> jacobian([0.0, 0.0, -0.5]).round(4)
    array([[-0.5357,  0.    , -0.848 ],
           [ 0.2678, -0.4639, -0.848 ],
           [ 0.2678,  0.4639, -0.848 ]])
    """
    return _jacobian(*_given(position, geometry))[0]


def signed_sigma_min(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Least singular value of J ``(...)``, negative beyond a parallel singularity.

    >>> float(signed_sigma_min([0.0, 0.0, -0.5]).round(4))
    0.6561
    """
    return _jacobian(*_given(position, geometry))[1]


def condition_number(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """kappa ``(...)``, greatest over least singular value of J, at least 1; NaN out of reach.

    >>> float(condition_number([0.0, 0.0, -0.5]).round(4))
    2.2387
    """
    return _jacobian(*_given(position, geometry))[2]


@over_rows("(3,3,3)f8")
def _limb_points(p: Any, x: Any, y: Any, z: Any, points: Any) -> None:
    for n in range(len(x)):
        for i in range(3):
            c, s = LIMB_COS[i], LIMB_SIN[i]
            _, theta = kernels.limb_ik(x[n], y[n], z[n], i, p)
            k = kernels.knee(theta, i, p)
            re = p.effector_radius
            points[n, i, 0] = (p.base_radius * c, p.base_radius * s, 0.0)
            points[n, i, 1] = (k[0] + re * c, k[1] + re * s, k[2])
            points[n, i, 2] = (x[n] + re * c, y[n] + re * s, z[n])


def limb_points(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Base joint, knee and effector joint of each limb ``(..., 3 limbs, 3 points, 3)``, m.

    >>> limb_points([0.0, 0.0, -0.5])[0].round(4)
    array([[ 0.12  ,  0.    ,  0.    ],
           [ 0.2803,  0.    , -0.1196],
           [ 0.04  ,  0.    , -0.5   ]])
    """
    return _limb_points(*_given(position, geometry))[0]
