"""What the kinematic model makes of a move that the twin has made; no collision stops it here."""

from __future__ import annotations

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import dynamics
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
    states: np.ndarray,
    flags: tuple[bool, bool, bool, bool, bool],
    target: int,
    packed: np.ndarray,
    outcomes: np.ndarray,
) -> None:
    """:func:`coop_env.simulation.dynamics.conclude` of ``states (1,)``, ``outcomes (1,)``."""
    outcomes[0].collision = outcomes[0].singular = False
    dynamics.conclude(states[0], flags, target, unpack(packed), outcomes[0])
