"""The 3-RRS's scalar kernels as numpy gufuncs: no formula here, only packing.

Core dimension n = 3; m = 12 holds an ``RRSParams`` as floats.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import boolean, float64

from coop_env.compilation import guvectorize, njit
from coop_env.kinematics import rrs_forward_kernels as fk
from coop_env.kinematics import rrs_kernels as rrs
from coop_env.kinematics.singularity import Matrix3

_V, _M, _T = float64[:], float64[:, :], float64[:, :, :]
_S, _B = float64[:], boolean[:]  # a scalar output is a one-element array


@njit(cache=True)
def _params(a: Any) -> rrs.RRSParams:
    return rrs.RRSParams(
        a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10] != 0.0, a[11]
    )


@njit(cache=True)
def _put(out: Any, m: Matrix3) -> None:
    for i in range(3):
        out[i, 0], out[i, 1], out[i, 2] = m[i][0], m[i][1], m[i][2]


@guvectorize([(_V, _V, _V, _M, _V)], "(n),(m)->(n),(n,n),(n)", cache=True)
def pose(rph: Any, params: Any, position: Any, rotation: Any, plane_offset: Any) -> None:
    """Platform centre, rotation, and each spherical joint's distance from its limb plane."""
    p = _params(params)
    at = rrs.platform_pose(rph[0], rph[1], rph[2], p)
    position[0], position[1], position[2] = at.x, at.y, at.z
    _put(rotation, ((at.r00, at.r01, at.r02), (at.r10, at.r11, at.r12), (at.r20, at.r21, at.r22)))
    for i in range(3):
        r = rrs.joint_offset(at, i, p.platform_radius)
        plane_offset[i] = rrs.LIMB_COS[i] * (at.y + r[1]) - rrs.LIMB_SIN[i] * (at.x + r[0])


@guvectorize([(_V, _V, _V, _V, _B, _B)], "(n),(m)->(n),(n),(),()", cache=True)
def inverse(rph: Any, params: Any, q: Any, margin: Any, reachable: Any, valid: Any) -> None:
    """Actuated angles, 1 - |c| of each limb, whether real, whether also within all limits."""
    p = _params(params)
    at = rrs.platform_pose(rph[0], rph[1], rph[2], p)
    reachable[0], angles = rrs.inverse(at, p)
    for i in range(3):
        q[i] = angles[i] if reachable[0] else math.nan
        margin[i] = 1.0 - abs(rrs.limb_triangle(at, i, p)[2])
    valid[0] = rrs.is_valid(rph[0], rph[1], rph[2], p)


@guvectorize([(_V, _V, _M, _V, _S)], "(n),(m)->(n,n),(n),()", cache=True)
def jacobian(rph: Any, params: Any, matrix: Any, values: Any, signed: Any) -> None:
    """J, its singular values, and the least with its sign; NaN where unreachable."""
    p = _params(params)
    at = rrs.platform_pose(rph[0], rph[1], rph[2], p)
    reachable, q = rrs.inverse(at, p)
    if not reachable:
        matrix[:] = math.nan
        values[:] = math.nan
        signed[0] = math.nan
        return
    j, sigma, signed[0] = rrs.singular_state(at, q, p)
    _put(matrix, j)
    values[0], values[1], values[2] = sigma


@guvectorize([(_V, _V, _V, _V, _S, _B)], "(n),(n),(m)->(n),(),()", cache=True)
def forward(q: Any, previous: Any, params: Any, rph: Any, residual: Any, converged: Any) -> None:
    """Pose of q on the branch of the previous pose."""
    converged[0], x, residual[0] = fk.forward(
        (q[0], q[1], q[2]), previous[0], previous[1], previous[2], _params(params)
    )
    rph[0], rph[1], rph[2] = x[0], x[1], x[2]


@guvectorize([(_V, _V, _M)], "(n),(m)->(n,n)", cache=True)
def twist_matrix(rph: Any, params: Any, matrix: Any) -> None:
    """Columns: (wx, wy, vz / eta) per unit rate of roll, pitch and heave."""
    p = _params(params)
    at = rrs.platform_pose(rph[0], rph[1], rph[2], p)
    w_roll, w_pitch, _ = fk.angular_velocities(rph[0], rph[1], at, p)
    _put(
        matrix,
        (
            (w_roll[0], w_pitch[0], 0.0),
            (w_roll[1], w_pitch[1], 0.0),
            (0.0, 0.0, 1.0 / p.characteristic_length),
        ),
    )


@guvectorize([(_V, _V, _T)], "(n),(m)->(n,n,n)", cache=True)
def limb_points(rph: Any, params: Any, points: Any) -> None:
    """Per limb: base joint, elbow, spherical joint. The elbow is NaN where unreachable."""
    p = _params(params)
    at = rrs.platform_pose(rph[0], rph[1], rph[2], p)
    for i in range(3):
        _, q = rrs.limb_ik(at, i, p)
        _put(points[i], rrs.limb_points(at, q, i, p))


def pack(params: rrs.RRSParams) -> np.ndarray:
    """An ``RRSParams`` as the gufuncs take it."""
    return np.array([float(value) for value in params])
