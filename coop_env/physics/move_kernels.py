"""What the kinematic model makes of a move that the twin has made; no collision stops it here."""

from __future__ import annotations

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import dynamics
from coop_env.simulation.collision import peg_tip
from coop_env.simulation.state import (
    Configuration,
    Record,
    aim,
    hole_angle,
    hole_distance,
    joint_angles,
    leave,
    neighbour,
    place_delta,
    place_rrs,
    update_inside,
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
    s.refused[:] = 0
    for k in range(3):
        s.energy += abs(theta[k] - s.theta[k]) + abs(q[k] - s.q[k])
    place_delta(s, c, theta, peg_tip(c[0], c[1], c[2], p.delta))
    place_rrs(s, c, pose, q, p)
    s.sigma = rrs_kernels.signed_sigma_min(pose, q, p.rrs)
    update_inside(s, p.task.tolerance, p)
    update_mask(s, True, True, p)


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
    before: np.ndarray,
    flags: tuple[bool, bool, bool, bool, bool],
    target: int,
    packed: np.ndarray,
    outcomes: np.ndarray,
) -> None:
    """Count the move, write its reward and outcome, and aim at the next target.

    Args:
        states: (1,), with the holes that are filled and active after the move.
        before: (1,), the state before it.
        flags: a violation, an insertion, an entry to a filled hole, the episode's end, that it
            ends in failure.
        target: the next one.
        packed: the parameters.
        outcomes: (1,), what is written to.
    """
    p, s, out = unpack(packed), states[0], outcomes[0]
    v, z, u, terminated, failed = flags
    aimed = before[0].target
    s.moves += 1
    s.insertions += z
    s.distance, s.angle = hole_distance(s, aimed), hole_angle(s, aimed)
    out.alignment_error, out.distance = s.angle, s.distance
    after = (s.distance, s.angle)
    aim(s, target)
    if p.task.visited > 0 and target != aimed:  # the way to the next hole may lead back
        s.trailed = 0
        update_mask(s, True, True, p)
    was = (before[0].distance, before[0].angle)
    dynamics.reward_of(s, (v, z, u, terminated, failed), was, after, p, out)
    out.inserted, out.inserted_hole = z, aimed if z else -1
    out.violation, out.duplicate = v, u
    out.collision = out.singular = False
    dynamics.report(s, p, out)
    out.terminated = terminated
    out.truncated = not terminated and s.moves >= p.task.max_moves
    s.over = out.terminated or out.truncated
