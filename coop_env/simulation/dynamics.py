"""The MDP's transition: one scalar kernel over one row of state.

The single environment (a batch of one), the batched environment and the planners all call it, so a
row of a batch is bit-identical to an environment of its own.
"""

from __future__ import annotations

import math

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.simulation import machine, rewards
from coop_env.simulation.collision import below_ceiling, collides, peg_tip
from coop_env.simulation.state import (
    COLLISION,
    INVALID,
    SINGULAR,
    VALID,
    Configuration,
    Record,
    aim,
    configuration_status,
    hole_angle,
    hole_distance,
    is_singular,
    joint_angles,
    leave,
    nearest_open_hole,
    neighbour,
    open_holes,
    place_delta,
    place_rrs,
    update_inside,
    update_mask,
)
from coop_env.simulation.task import N_AXES, EnvParams

__all__ = [
    "COLLISION",
    "INVALID",
    "SINGULAR",
    "VALID",
    "begin",
    "configuration_status",
    "settle",
    "step",
]


@njit(cache=True)
def begin(s: Record, c: Configuration, active: np.ndarray, filled: np.ndarray, p: EnvParams) -> int:
    """Start an episode at a configuration with the given holes; returns the configuration's status.

    The target is left to :func:`coop_env.simulation.state.aim`. Nothing is written unless it is
    VALID.
    """
    valid, theta, pose, q = joint_angles(c, p)
    if not valid:
        return INVALID
    if collides(c[0], c[1], c[2], theta, pose, q, p):
        return COLLISION
    sigma = rrs_kernels.signed_sigma_min(pose, q, p.rrs)
    if is_singular(sigma, p):
        return SINGULAR
    for k in range(N_AXES):
        s.start[k] = c[k]
        s.offset[k] = 0
    s.active[:] = active
    s.filled[:] = filled
    s.sigma = sigma
    s.moves = 0
    s.trailed = 0
    s.refused[:] = 0
    s.insertions = 0
    s.energy = 0.0
    s.over = False
    place_delta(s, c, theta, peg_tip(c[0], c[1], c[2], p.delta))
    place_rrs(s, c, pose, q, p)
    update_inside(s, p.task.tolerance, p)
    update_mask(s, True, True, p)
    return VALID


@njit(cache=True)
def settle(s: Record, p: EnvParams) -> int:
    """Let the imperfect machine in ``s`` take the pose of a state begun; returns its status.

    The joints come to rest at what is commanded, without play; a machine that collides, that is
    singular, or that starts in a hole is refused.
    """
    m = s.machine
    for k in range(3):
        m.joints[k], m.joints[3 + k] = s.theta[k], s.q[k]
    for k in range(N_AXES):
        m.actual[k] = s.configuration[k]
    c = s.configuration
    status = _follow(s, (c[0], c[1], c[2], c[3], c[4], c[5]), p)
    s.energy = 0.0
    if status == VALID and s.inside.sum() > 0:
        return COLLISION
    return status


@njit(cache=True)
def _move_delta(s: Record, action: int, p: EnvParams) -> int:
    """Try a move of the Delta, with what the state holds of the 3-RRS."""
    c = neighbour(s, action, p)
    if not delta_kernels.within_limits(c[0], c[1], c[2], p.delta):
        return INVALID
    real, theta = delta_kernels.inverse(c[0], c[1], c[2], p.delta)
    if not real:
        return INVALID
    if below_ceiling(c, p):
        pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
        if collides(c[0], c[1], c[2], theta, pose, (s.q[0], s.q[1], s.q[2]), p):
            return COLLISION
    for k in range(3):
        s.energy += abs(theta[k] - s.theta[k])
    place_delta(s, c, theta, peg_tip(c[0], c[1], c[2], p.delta))
    return VALID


@njit(cache=True)
def _move_rrs(s: Record, action: int, p: EnvParams) -> int:
    """Try a move of the 3-RRS, with what the state holds of the Delta."""
    c = neighbour(s, action, p)
    if not rrs_kernels.within_limits(c[3], c[4], c[5], p.rrs):
        return INVALID
    pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
    real, q = rrs_kernels.inverse(pose, p.rrs)
    if not (real and rrs_kernels.joints_within_limits(q, p.rrs)):
        return INVALID
    theta = (s.theta[0], s.theta[1], s.theta[2])
    if below_ceiling(c, p) and collides(c[0], c[1], c[2], theta, pose, q, p):
        return COLLISION
    for k in range(3):
        s.energy += abs(q[k] - s.q[k])
    place_rrs(s, c, pose, q, p)
    s.sigma = rrs_kernels.signed_sigma_min(pose, q, p.rrs)
    return SINGULAR if is_singular(s.sigma, p) else VALID


@njit(cache=True)
def _follow(s: Record, c: Configuration, p: EnvParams) -> int:
    """Let the imperfect machine follow a command: its model plans, its real links move.

    The state's configuration is the model's; angles, tip, mouths and sigma are the real ones.
    """
    valid, theta, _, q = joint_angles(c, p)
    if not valid:
        return INVALID
    m = s.machine
    real = machine.real_params(m, p)
    joints = machine.answer(m, theta, q)
    closed, at, tilt = machine.forward(m, joints, real)
    if not closed:
        return INVALID
    theta, q = (joints[0], joints[1], joints[2]), (joints[3], joints[4], joints[5])
    pose = rrs_kernels.platform_pose(tilt[0], tilt[1], tilt[2], real.rrs)
    met = machine.displaced(m, pose)
    if collides(at[0], at[1], at[2], theta, met, q, real):
        return COLLISION
    for k in range(3):
        s.energy += abs(theta[k] - s.theta[k]) + abs(q[k] - s.q[k])
        m.actual[k], m.actual[3 + k] = at[k], tilt[k]
    for k in range(6):
        m.joints[k] = joints[k]
    place_delta(s, c, theta, peg_tip(at[0], at[1], at[2], real.delta))
    place_rrs(s, c, met, q, p)
    update_inside(s, m.tolerance, p)
    s.sigma = rrs_kernels.signed_sigma_min(pose, q, real.rrs)
    return SINGULAR if is_singular(s.sigma, p) else VALID


@njit(cache=True)
def _attempt(s: Record, action: int, p: EnvParams) -> int:
    """Try a move: VALID and SINGULAR ones are executed, INVALID and COLLISION ones are not."""
    rrs = action >= 6
    if p.task.imperfect:
        status = _follow(s, neighbour(s, action, p), p)
    elif rrs:
        status = _move_rrs(s, action, p)
    else:
        status = _move_delta(s, action, p)
    if status in (INVALID, COLLISION):
        if p.task.refused:
            s.refused[action] = 1
            update_mask(s, True, True, p)
        return status
    s.refused[:] = 0
    if p.task.visited > 0:
        leave(s)
    s.offset[action // 2] += 1 - 2 * (action % 2)
    if not p.task.imperfect:
        update_inside(s, p.task.tolerance, p)
    update_mask(s, not rrs, rrs, p)
    return status


@njit(cache=True)
def _due(s: Record, action: int, p: EnvParams) -> int:
    """The action that is executed now: with latency the last one, -1 at first."""
    if not (p.task.imperfect and s.machine.latency):
        return action
    late = s.machine.pending
    s.machine.pending = action
    return late


@njit(cache=True)
def _inserts(s: Record, p: EnvParams) -> bool:
    """Whether the peg goes into the target: the criterion, and with a rough chamfer the luck."""
    if s.inside[s.target] == 0 or s.filled[s.target] == 1:
        return False
    return not p.task.imperfect or machine.uniform(s.machine) < s.machine.insertion_probability


@njit(cache=True)
def _in_filled_holes(s: Record) -> int:
    """The filled holes whose criterion the peg meets, as the bits of a number."""
    bits = 0
    for i in range(len(s.inside)):
        if s.filled[i] == 1 and s.inside[i] == 1:
            bits |= 1 << i
    return bits


@njit(cache=True)
def step(s: Record, action: int, p: EnvParams, out: Record) -> None:
    """One move of one environment: writes the next state to ``s`` and what happened to ``out``."""
    before = _in_filled_holes(s)
    distance, angle = s.distance, s.angle
    due = _due(s, action, p)
    status = _attempt(s, due, p) if due >= 0 else VALID
    s.moves += 1
    v, target = status != VALID, s.target
    s.distance, s.angle = hole_distance(s, target), hole_angle(s, target)
    u = not v and _in_filled_holes(s) & ~before != 0
    z = not v and due >= 0 and _inserts(s, p)
    if z:
        s.filled[target] = 1
        s.insertions += 1
    out.alignment_error, out.distance = s.angle, s.distance
    after = (s.distance, s.angle)
    n_open = open_holes(s)
    terminated = status == SINGULAR or n_open == 0
    if z and n_open > 0:
        aim(s, nearest_open_hole(s))
        if p.task.visited > 0:  # the way to the next hole may lead back
            s.trailed = 0
            update_mask(s, True, True, p)
    _reward(s, (v, z, u, terminated), (distance, angle), after, p, out)
    out.inserted = z
    out.inserted_hole = target if z else -1
    out.collision = status == COLLISION
    out.violation = v
    out.duplicate = u
    out.singular = status == SINGULAR
    _report(s, p, out)
    out.terminated = terminated
    out.truncated = not terminated and s.moves >= p.task.max_moves
    s.over = out.terminated or out.truncated


@njit(cache=True)
def _report(s: Record, p: EnvParams, out: Record) -> None:
    out.success = s.insertions > 0
    out.n_filled = s.filled.sum()
    out.sigma_min = s.sigma
    out.target = s.target
    out.time = s.moves * p.layout.dt
    out.energy = s.energy


@njit(cache=True)
def _reward(
    s: Record, flags: tuple[bool, bool, bool, bool],
    before: tuple[float, float], after: tuple[float, float], p: EnvParams, out: Record,
) -> None:  # fmt: skip
    v, z, u, terminated = flags
    n_filled, time = s.filled.sum(), s.moves * p.layout.dt
    if p.reward.paper:
        terms = rewards.paper_terms(v, z, u, n_filled, time, before[0], after[0], p.reward)
    else:
        if not math.isnan(p.reward.gamma):
            # The potential of the next state: towards its own target, nought once it is terminal.
            after = (0.0, 0.0) if terminated else (s.distance, s.angle)
        d, a = (before[0], after[0]), (before[1], after[1])
        terms = rewards.progress_terms(v, z, u, n_filled, time, d, a, p.reward)
    total = 0.0
    for k in range(len(terms)):
        out.terms[k] = terms[k]
        total += terms[k]
    out.reward = total
