"""The Delta's scalar kernels as numpy gufuncs: no formula here, only packing.

Core dimension n = 3; m = 8 holds a ``DeltaParams`` as floats.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import boolean, float64

from coop_env.compilation import guvectorize, njit
from coop_env.kinematics import delta_kernels as delta
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN
from coop_env.kinematics.singularity import determinant_3x3, singular_values_3x3

_V, _M, _T = float64[:], float64[:, :], float64[:, :, :]
_S, _B = float64[:], boolean[:]  # a scalar output is a one-element array


@njit(cache=True)
def _params(a: Any) -> delta.DeltaParams:
    return delta.DeltaParams(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7])


@guvectorize([(_V, _V, _V, _V, _B, _B)], "(n),(m)->(n),(n),(),()", cache=True)
def inverse(xyz: Any, params: Any, theta: Any, margin: Any, reachable: Any, valid: Any) -> None:
    """Actuated angles, 1 - |k| of each limb, whether real, whether also within the workspace."""
    p = _params(params)
    reachable[0], angles = delta.inverse(xyz[0], xyz[1], xyz[2], p)
    for i in range(3):
        theta[i] = angles[i] if reachable[0] else math.nan
        margin[i] = 1.0 - abs(delta.limb_triangle(xyz[0], xyz[1], xyz[2], i, p)[1])
    valid[0] = delta.is_valid(xyz[0], xyz[1], xyz[2], p)


@guvectorize([(_V, _V, _V, _S, _B)], "(n),(m)->(n),(),()", cache=True)
def forward(theta: Any, params: Any, xyz: Any, residual: Any, reachable: Any) -> None:
    """Effector of three actuated angles, and the largest error of a distal length."""
    p = _params(params)
    reachable[0], x = delta.forward((theta[0], theta[1], theta[2]), p)
    xyz[0], xyz[1], xyz[2] = x[0], x[1], x[2]
    residual[0] = math.nan
    if reachable[0]:
        residual[0] = 0.0
        for i in range(3):
            k = delta.knee(theta[i], i, p)
            d = math.sqrt((x[0] - k[0]) ** 2 + (x[1] - k[1]) ** 2 + (x[2] - k[2]) ** 2)
            residual[0] = max(residual[0], abs(d - p.distal_length))


@guvectorize([(_V, _V, _M, _V, _S)], "(n),(m)->(n,n),(n),()", cache=True)
def jacobian(xyz: Any, params: Any, matrix: Any, values: Any, signed: Any) -> None:
    """J = l_a B^-1 A, its singular values, and the least with its sign; NaN where unreachable."""
    p = _params(params)
    reachable, theta = delta.inverse(xyz[0], xyz[1], xyz[2], p)
    matrix[:] = math.nan
    values[:] = math.nan
    signed[0] = math.nan
    if not reachable:
        return
    a, b = delta.jacobian_parts(xyz[0], xyz[1], xyz[2], theta, p)
    if b[0] == 0.0 or b[1] == 0.0 or b[2] == 0.0:
        return
    for i in range(3):
        for k in range(3):
            matrix[i, k] = p.proximal_length * a[i][k] / b[i]
    high, mid, low = singular_values_3x3(
        (
            (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
            (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
            (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
        )
    )
    values[0], values[1], values[2] = high, mid, low
    # Hanging on the axis, the three distal links always make a negative determinant.
    signed[0] = math.copysign(low, -determinant_3x3(a))


@guvectorize([(_V, _V, _T)], "(n),(m)->(n,n,n)", cache=True)
def limb_points(xyz: Any, params: Any, points: Any) -> None:
    """Per limb: base joint, knee, effector joint. The knee is NaN where unreachable."""
    p = _params(params)
    for i in range(3):
        c, s = LIMB_COS[i], LIMB_SIN[i]
        _, theta = delta.limb_ik(xyz[0], xyz[1], xyz[2], i, p)
        k = delta.knee(theta, i, p)
        re = p.effector_radius
        points[i, 0, 0], points[i, 0, 1], points[i, 0, 2] = (
            p.base_radius * c,
            p.base_radius * s,
            0.0,
        )
        points[i, 1, 0], points[i, 1, 1], points[i, 1, 2] = k[0] + re * c, k[1] + re * s, k[2]
        points[i, 2, 0], points[i, 2, 1] = xyz[0] + re * c, xyz[1] + re * s
        points[i, 2, 2] = xyz[2]


def pack(params: delta.DeltaParams) -> np.ndarray:
    """A ``DeltaParams`` as the gufuncs take it."""
    return np.array([float(value) for value in params])
