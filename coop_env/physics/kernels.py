"""Compiled functions that run on each row between two calls of the engine.

``take`` and the kernels after it keep the kinematic model in step with the twin's moves; no
collision stops it. ``packed`` is :func:`coop_env.simulation.task.pack` of the machine.
"""

import math

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_forward_kernels, rrs_kernels
from coop_env.kinematics.rrs_kernels import Pose
from coop_env.simulation import dynamics
from coop_env.simulation.collision import hole, peg_tip
from coop_env.simulation.state import (
    Configuration,
    Record,
    joint_angles,
    leave,
    neighbour,
    update_mask,
)
from coop_env.simulation.task import EnvParams, unpack


@njit(cache=True)
def perceive(
    joints: np.ndarray, believed: np.ndarray, holes: np.ndarray, packed: np.ndarray
) -> np.ndarray:
    """(n, 5): tip - mouth, m, and x, y of the hole's normal, as measured joints (n, 6) have them.

    ``believed`` (n, 6), from which the 3-RRS's branch is followed, become the configurations now. A
    machine that has snapped may have no pose on its old branch: it keeps the last.
    """
    p = unpack(packed)
    result = np.empty((joints.shape[0], 5))
    for i in range(joints.shape[0]):
        a, b = joints[i], believed[i]
        ok_delta, position = delta_kernels.forward((a[0], a[1], a[2]), p.delta)
        ok_rrs, tilt, _ = rrs_forward_kernels.forward((a[3], a[4], a[5]), b[3], b[4], b[5], p.rrs)
        for k in range(3):
            if ok_delta:
                b[k] = position[k]
            if ok_rrs:
                b[3 + k] = tilt[k]
        tip = peg_tip(b[0], b[1], b[2], p.delta)
        mouth, normal = hole(rrs_kernels.platform_pose(b[3], b[4], b[5], p.rrs), holes[i], p)
        for k in range(3):
            result[i, k] = tip[k] - mouth[k]
        result[i, 3], result[i, 4] = normal[0], normal[1]
    return result


@njit(cache=True)
def insertion(
    tip: np.ndarray, platform: np.ndarray, rotation: np.ndarray, holes: np.ndarray,
    mouth_radius: float, packed: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(n, 4): depth of the tip below the real mouth, distance from the axis, m; misalignment, rad.

    Outside ``mouth_radius`` depth is at most 0; the last column is depth without that limit, m.
    ``tip`` (n, 3), ``platform`` (its centre, n, 3) and ``rotation`` (n, 3, 3): world frame.
    """
    p = unpack(packed)
    result = np.empty((tip.shape[0], 4))
    for i in range(tip.shape[0]):
        c, (x, y, z) = platform[i], rotation[i]
        pose = Pose(c[0], c[1], c[2], x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])
        mouth, n = hole(pose, holes[i], p)
        x, y, z = tip[i, 0] - mouth[0], tip[i, 1] - mouth[1], tip[i, 2] - mouth[2]
        depth = -(x * n[0] + y * n[1] + z * n[2])
        x, y, z = x + depth * n[0], y + depth * n[1], z + depth * n[2]
        lateral = math.sqrt(x * x + y * y + z * z)
        result[i, 0] = depth if lateral <= mouth_radius else min(depth, 0.0)
        result[i, 1] = lateral
        result[i, 2] = math.atan2(math.hypot(n[0], n[1]), n[2])
        result[i, 3] = depth
    return result


@njit(cache=True)
def take(states: np.ndarray, action: int, packed: np.ndarray) -> bool:
    """Put the model of ``states (1,)`` where a move leads; False beyond the robots' limits."""
    p, s = unpack(packed), states[0]
    c = neighbour(s, action, p)
    if not joint_angles(c, p)[0]:
        refuse(states, action, packed)
        return False
    if p.task.visited > 0:
        leave(s)
    s.offset[action // 2] += 1 - 2 * (action % 2)
    _stand(s, c, p)
    return True


@njit(cache=True)
def begin_again(states: np.ndarray, configuration: np.ndarray, packed: np.ndarray) -> None:
    """Put the model of ``states (1,)`` at a configuration (6,), which begins another lattice."""
    p, s, c = unpack(packed), states[0], configuration
    s.start[:] = c
    s.offset[:] = 0
    s.trailed = 0
    _stand(s, (c[0], c[1], c[2], c[3], c[4], c[5]), p)


@njit(cache=True)
def _stand(s: Record, c: Configuration, p: EnvParams) -> None:
    _, theta, pose, q = joint_angles(c, p)
    for k in range(3):
        s.energy += abs(theta[k] - s.theta[k]) + abs(q[k] - s.q[k])
    dynamics.stand(s, c, theta, pose, q, rrs_kernels.signed_sigma_min(pose, q, p.rrs), p)


@njit(cache=True)
def refuse(states: np.ndarray, action: int, packed: np.ndarray) -> None:
    """Remember, if masks do, that a move was refused at the present configuration."""
    p, s = unpack(packed), states[0]
    if p.task.refused:
        s.refused[action] = 1
        update_mask(s, True, True, p)


@njit(cache=True)
def conclude(
    states: np.ndarray, flags: tuple[bool, bool, bool, bool, bool], target: int,
    packed: np.ndarray, outcomes: np.ndarray,
) -> None:  # fmt: skip
    """:func:`coop_env.simulation.dynamics.conclude` of ``states (1,)``, ``outcomes (1,)``."""
    outcomes[0].collision = outcomes[0].singular = False
    dynamics.conclude(states[0], flags, target, unpack(packed), outcomes[0])
