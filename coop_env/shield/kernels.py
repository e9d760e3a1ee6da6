"""A shield's tests of configurations, ways and increments; scalar kernels."""

import math
from typing import Final

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.simulation.collision import (
    below_ceiling,
    collides_elsewhere,
    in_opening,
    peg_meets_dome,
    peg_tip,
)
from coop_env.simulation.state import Configuration, is_singular, joint_angles
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams, unpack

# Between two looks at a way, m and rad, no part of a robot comes nearer to the other by more than
# about a millimetre.
LINEAR_SPACING: Final = 0.002
ANGULAR_SPACING: Final = 0.004
BISECTIONS: Final = 8


@njit(cache=True)
def is_certified(c: Configuration, p: EnvParams, reach: float, clearance: float) -> bool:
    """Whether a configuration keeps its margins, with tightened ``p``.

    A negative clearance says that the robots may touch.
    """
    valid, theta, pose, q = joint_angles(c, p)
    if not valid:
        return False
    for limb in range(3):
        if not abs(delta_kernels.limb_triangle(c[0], c[1], c[2], limb, p.delta)[1]) <= 1.0 - reach:
            return False
        if not abs(rrs_kernels.limb_triangle(pose, limb, p.rrs)[2]) <= 1.0 - reach:
            return False
    if is_singular(rrs_kernels.signed_sigma_min(pose, q, p.rrs), p):
        return False
    if clearance < 0.0 or not below_ceiling(c, p):
        return True
    if peg_meets_dome(c[0], c[1], c[2], pose, p):
        # the true tip, of which `p` has the grown one, must be as far inside of the lead-in
        x, y, z = peg_tip(c[0], c[1], c[2], p.delta)
        opening = p.task.chamfer + p.delta.peg_radius - 2.0 * clearance
        if not in_opening((x, y, z + clearance), pose, opening, p):
            return False
    return not collides_elsewhere(c[0], c[1], c[2], theta, pose, q, p)


@njit(cache=True)
def way_point(c: np.ndarray, a: np.ndarray, t: float) -> Configuration:
    """The configuration at a share of the way from ``c`` along ``a``."""
    return (
        c[0] + t * a[0], c[1] + t * a[1], c[2] + t * a[2],
        c[3] + t * a[3], c[4] + t * a[4], c[5] + t * a[5],
    )  # fmt: skip


@njit(cache=True)
def pieces(a: np.ndarray) -> int:
    """Number of pieces in which an increment (6,) is checked."""
    # motions of both robots, and the platform's two, may add up
    linear = (math.hypot(math.hypot(a[0], a[1]), a[2]) + abs(a[5])) / LINEAR_SPACING
    angular = math.hypot(a[3], a[4]) / ANGULAR_SPACING
    return max(1, math.ceil(linear + angular - 1e-9))


@njit(cache=True)
def free_share(c: np.ndarray, a: np.ndarray, p: EnvParams, reach: float, clearance: float) -> float:
    """The share of the straight way from ``c`` along ``a`` that keeps all margins, 0 to 1."""
    n = pieces(a)
    for i in range(1, n + 1):
        if is_certified(way_point(c, a, i / n), p, reach, clearance):
            continue
        low, high = (i - 1) / n, i / n
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if is_certified(way_point(c, a, middle), p, reach, clearance):
                low = middle
            else:
                high = middle
        return low
    return 1.0


@njit(cache=True)
def project(
    configuration: np.ndarray, increment: np.ndarray, packed: np.ndarray, reach: float,
    clearance: float, result: np.ndarray,
) -> bool:  # fmt: skip
    """Write what is left of an increment (6,) to ``result``; True if that is less than all of it.

    First the share that all axes can go together, then, axis by axis, what more of it can be had:
    where one robot is stopped the other moves on, and a platform slides along a limit.
    """
    p = unpack(packed)
    c, a = configuration, increment
    share = free_share(c, a, p, reach, clearance)
    for k in range(N_AXES):
        result[k] = share * a[k]
    if share == 1.0:
        return False
    for k in range(N_AXES):
        if a[k] == 0.0:
            continue
        low, high = result[k], a[k]
        result[k] = high
        if free_share(c, result, p, reach, clearance) == 1.0:
            continue
        for _ in range(BISECTIONS):
            result[k] = 0.5 * (low + high)
            if free_share(c, result, p, reach, clearance) == 1.0:
                low = result[k]
            else:
                high = result[k]
        result[k] = low
    return True


@njit(cache=True)
def allowed_moves(
    configuration: np.ndarray, steps: np.ndarray, packed: np.ndarray, reach: float,
    clearance: float, mask: np.ndarray,
) -> None:  # fmt: skip
    """Write which of the twelve moves by ``steps (6,)`` keep all margins to ``mask (12,)``."""
    p = unpack(packed)
    a = np.zeros(N_AXES)
    for move in range(N_ACTIONS):
        axis = move // 2
        a[axis] = steps[axis] * (1 - 2 * (move % 2))
        mask[move] = free_share(configuration, a, p, reach, clearance) == 1.0
        a[axis] = 0.0


@njit(cache=True)
def certified(
    configuration: np.ndarray, packed: np.ndarray, reach: float, clearance: float
) -> bool:
    """:func:`is_certified` of a configuration (6,), quick to call from Python."""
    c = configuration
    return is_certified((c[0], c[1], c[2], c[3], c[4], c[5]), unpack(packed), reach, clearance)


@njit(cache=True)
def sigma_after(
    configuration: np.ndarray, steps: np.ndarray, packed: np.ndarray, sigma: np.ndarray
) -> None:
    """Write the signed sigma_min to which each move leads to ``sigma (12,)``; NaN out of reach."""
    p, c = unpack(packed), configuration
    for move in range(N_ACTIONS):
        tilt = [c[3], c[4], c[5]]
        if move >= 6:
            tilt[move // 2 - 3] += steps[move // 2] * (1 - 2 * (move % 2))
        sigma[move] = rrs_kernels.sigma_at(tilt[0], tilt[1], tilt[2], p.rrs)
