"""The Delta robot, batched: ``(..., 3)`` in, ``(..., m)`` out, for any ``DeltaGeometry``.

Positions are of the effector's centre, in m, in the Delta's base frame, z up, so the effector hangs
at negative z. Limbs have azimuths 0, 120 and 240 degrees; their actuated angles theta are measured
down from the outward horizontal, working mode "knees out".

Out of reach gives NaN and ``reachable=False``, and so does NaN. Every function raises
:class:`~coop_env.kinematics.rrs.ShapeError` for a wrong last axis and :class:`TypeError` for what
is not real numbers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coop_env.compilation import compiling_alone
from coop_env.geometry import DELTA, DeltaGeometry
from coop_env.kinematics._batch import Bools, Floats, ShapeError, as_points, quiet
from coop_env.kinematics.delta_kernels import make_params

with compiling_alone():
    from coop_env.kinematics import _delta_gufuncs as gufuncs

__all__ = [
    "Forward",
    "Inverse",
    "ShapeError",
    "condition_number",
    "forward",
    "inverse",
    "is_valid",
    "jacobian",
    "limb_margin",
    "limb_points",
    "signed_sigma_min",
    "singular_values",
    "workspace_margin",
]


class Inverse(NamedTuple):
    """Actuated angles ``(..., 3)`` in rad, NaN where not ``reachable`` ``(...)``."""

    theta: Floats
    reachable: Bools


class Forward(NamedTuple):
    """Positions ``(..., 3)`` in m, NaN where not ``reachable``; ``residual`` ``(...)`` in m."""

    position: Floats
    residual: Floats
    reachable: Bools


@lru_cache(maxsize=256)
def _packed(geometry: DeltaGeometry) -> np.ndarray:
    return gufuncs.pack(make_params(geometry))


def _position(value: ArrayLike) -> Floats:
    return as_points("position", value, "x", "y", "z")


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
    with quiet():
        theta, _, reachable, _ = gufuncs.inverse(_position(position), _packed(geometry))
    return Inverse(theta, reachable)


def forward(theta: ArrayLike, geometry: DeltaGeometry = DELTA) -> Forward:
    """Position of actuated angles ``(..., 3)``, by three spheres; the effector hangs below.

    >>> found = forward([0.195992144, 0.760383495, 0.523628320])
    >>> found.position.round(6).tolist(), bool(found.reachable)
    ([0.1, -0.05, -0.45], True)
    """
    angles = as_points("theta", theta, "theta0", "theta1", "theta2")
    with quiet():
        return Forward(*gufuncs.forward(angles, _packed(geometry)))


def is_valid(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Bools:
    """Whether positions lie in the paper's W_Delta (sign slip mended) and all limbs reach.

    ``z`` in ``[-(l_a + l_p), -|l_a - l_p|]`` and ``sqrt(x^2 + y^2) <= 0.8 min(l_a, l_p)``.

    >>> is_valid([[0.0, 0.0, -0.5], [0.0, 0.0, -0.2], [0.17, 0.0, -0.4]]).tolist()
    [True, False, False]
    """
    with quiet():
        return gufuncs.inverse(_position(position), _packed(geometry))[3]


def workspace_margin(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Distance ``(...)`` in m to the nearest bound of W_Delta; negative outside.

    >>> workspace_margin([[0.0, 0.0, -0.5], [0.0, 0.0, -0.2]]).round(6).tolist()
    [0.15, -0.05]
    """
    x, y, z = np.moveaxis(_position(position), -1, 0)
    low = -(geometry.proximal_length + geometry.distal_length)
    high = -abs(geometry.proximal_length - geometry.distal_length)
    return np.minimum(np.minimum(z - low, high - z), geometry.planar_limit - np.hypot(x, y))


def limb_margin(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """``1 - |k|`` of each limb ``(..., 3)``, k the cosine at the base joint; negative out of reach.

    >>> limb_margin([[0.0, 0.0, -0.5], [0.0, 0.0, -0.9]]).round(3)
    array([[ 0.536,  0.536,  0.536],
           [-0.809, -0.809, -0.809]])
    """
    with quiet():
        return gufuncs.inverse(_position(position), _packed(geometry))[1]


def jacobian(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """J ``(..., 3, 3)`` with ``thetadot = J v / l_a``, dimensionless; NaN out of reach.

    ``J = l_a B^-1 A``; A's rows are unit vectors along the distal links, B_i the crank's leverage.

    >>> jacobian([0.0, 0.0, -0.5]).round(4)
    array([[-0.5357,  0.    , -0.848 ],
           [ 0.2678, -0.4639, -0.848 ],
           [ 0.2678,  0.4639, -0.848 ]])
    """
    with quiet():
        return gufuncs.jacobian(_position(position), _packed(geometry))[0]


def singular_values(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Singular values of J ``(..., 3)``, descending; NaN out of reach.

    >>> singular_values([0.0, 0.0, -0.5]).round(4)
    array([1.4687, 0.6561, 0.6561])
    """
    with quiet():
        return gufuncs.jacobian(_position(position), _packed(geometry))[1]


def signed_sigma_min(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Least singular value of J ``(...)``, negative beyond a parallel singularity.

    >>> float(signed_sigma_min([0.0, 0.0, -0.5]).round(4))
    0.6561
    """
    with quiet():
        return gufuncs.jacobian(_position(position), _packed(geometry))[2]


def condition_number(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """kappa ``(...)``, greatest over least singular value of J, at least 1; NaN out of reach.

    >>> float(condition_number([0.0, 0.0, -0.5]).round(4))
    2.2387
    """
    values = singular_values(position, geometry)
    with quiet():
        return values[..., 0] / values[..., 2]


def limb_points(position: ArrayLike, geometry: DeltaGeometry = DELTA) -> Floats:
    """Base joint, knee and effector joint of each limb ``(..., 3 limbs, 3 points, 3)``, m.

    >>> limb_points([0.0, 0.0, -0.5])[0].round(4)
    array([[ 0.12  ,  0.    ,  0.    ],
           [ 0.2803,  0.    , -0.1196],
           [ 0.04  ,  0.    , -0.5   ]])
    """
    with quiet():
        return gufuncs.limb_points(_position(position), _packed(geometry))
