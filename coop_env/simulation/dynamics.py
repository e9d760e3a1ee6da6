"""The MDP's transition: one scalar kernel over one row of state.

Single environment, batch, team and planners all call it, so they agree to the last bit. numba
compiles what a kernel calls once more with the kernel; ``inline="always"`` spares one such level.
"""

import math

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels
from coop_env.kinematics.rrs_kernels import Pose
from coop_env.kinematics.singularity import Row
from coop_env.simulation import machine, rewards, state
from coop_env.simulation.collision import below_ceiling, collides, peg_tip
from coop_env.simulation.state import HOLD, VALID, Configuration, Record
from coop_env.simulation.task import N_AXES, EnvParams


@njit(cache=True, inline="always")
def begin(s: Record, c: Configuration, active: np.ndarray, filled: np.ndarray, p: EnvParams) -> int:
    """Start an episode, without its target; returns the configuration's status.

    Nothing is written unless it is VALID.
    """
    status = state.configuration_status(c, p)
    if status != VALID:
        return status
    _, theta, pose, q = state.joint_angles(c, p)
    for k in range(N_AXES):
        s.start[k] = c[k]
        s.offset[k] = 0
    for hole in range(len(active)):  # `s.active[:] =` would take numba a second more to compile
        s.active[hole], s.filled[hole] = active[hole], filled[hole]
    s.moves = 0
    s.trailed = 0
    s.insertions = 0
    s.energy = 0.0
    s.over = False
    stand(s, c, theta, pose, q, rrs_kernels.signed_sigma_min(pose, q, p.rrs), p)
    return VALID


@njit(cache=True, inline="always")
def stand(
    s: Record, c: Configuration, theta: Row, pose: Pose, q: Row, sigma: float, p: EnvParams
) -> None:
    """Put the nominal machine at a configuration, and write all dependent fields."""
    s.refused[:] = 0
    s.sigma = sigma
    state.place_delta(s, c, theta, peg_tip(c[0], c[1], c[2], p.delta))
    state.place_rrs(s, c, pose, q, p)
    state.update_inside(s, p.task.tolerance, p)
    state.update_mask(s, True, True, p)


@njit(cache=True)
def settle(s: Record, p: EnvParams) -> int:
    """Put the imperfect machine where a begun state commands it; returns the status."""
    m = s.machine
    for k in range(3):
        m.joints[k], m.joints[3 + k] = s.theta[k], s.q[k]
    for k in range(N_AXES):
        m.actual[k] = s.configuration[k]
    c = s.configuration
    status = _follow(s, (c[0], c[1], c[2], c[3], c[4], c[5]), p)
    s.energy = 0.0
    return status


@njit(cache=True)
def _move(s: Record, delta: int, rrs: int, p: EnvParams) -> tuple[int, int]:
    """Try a move of the Delta, of the 3-RRS, or both; the status of each.

    A robot whose own limits forbid its move stays, and the other's is tried alone. If the robots
    would touch where they arrive, neither moves. VALID and SINGULAR moves are executed.
    """
    c = state.neighbour(s, HOLD, p)
    theta, q = (s.theta[0], s.theta[1], s.theta[2]), (s.q[0], s.q[1], s.q[2])
    delta_status, rrs_status = VALID, VALID
    if delta != HOLD:
        to = state.neighbour(s, delta, p)
        valid, angles = state.delta_angles(to, p)
        if valid:
            c, theta = (to[0], to[1], to[2], c[3], c[4], c[5]), angles
        else:
            delta, delta_status = HOLD, state.INVALID
    if rrs != HOLD:
        to = state.neighbour(s, rrs, p)
        valid, pose, angles = state.rrs_angles(to, p)
        if valid:
            c, q = (c[0], c[1], c[2], to[3], to[4], to[5]), angles
        else:
            rrs, rrs_status = HOLD, state.INVALID
    if delta == HOLD and rrs == HOLD:
        return delta_status, rrs_status
    if below_ceiling(c, p):
        if rrs == HOLD:
            pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
        if collides(c[0], c[1], c[2], theta, pose, q, p):
            delta_status = delta_status if delta == HOLD else state.COLLISION
            return delta_status, rrs_status if rrs == HOLD else state.COLLISION
    if delta != HOLD:
        for k in range(3):
            s.energy += abs(theta[k] - s.theta[k])
        state.place_delta(s, c, theta, peg_tip(c[0], c[1], c[2], p.delta))
    if rrs != HOLD:
        for k in range(3):
            s.energy += abs(q[k] - s.q[k])
        state.place_rrs(s, c, pose, q, p)
        s.sigma = rrs_kernels.signed_sigma_min(pose, q, p.rrs)
        if state.is_singular(s.sigma, p):
            rrs_status = state.SINGULAR
    return delta_status, rrs_status


@njit(cache=True)
def _follow(s: Record, c: Configuration, p: EnvParams) -> int:
    """Let the imperfect machine follow a command: its model plans, its real links move.

    The state's configuration is the model's; angles, tip, mouths and sigma are the real ones.
    """
    valid, theta, _, q = state.joint_angles(c, p)
    if not valid:
        return state.INVALID
    m = s.machine
    real = machine.real_params(m, p)
    theta, q = machine.answer(m, theta, q)
    closed, at, tilt = machine.forward(m, theta, q, real)
    if not closed:
        return state.INVALID
    pose = rrs_kernels.platform_pose(tilt[0], tilt[1], tilt[2], real.rrs)
    met = machine.displaced(m, pose)
    if collides(at[0], at[1], at[2], theta, met, q, real):
        return state.COLLISION
    for k in range(3):
        s.energy += abs(theta[k] - s.theta[k]) + abs(q[k] - s.q[k])
        m.actual[k], m.actual[3 + k] = at[k], tilt[k]
        m.joints[k], m.joints[3 + k] = theta[k], q[k]
    state.place_delta(s, c, theta, peg_tip(at[0], at[1], at[2], real.delta))
    state.place_rrs(s, c, met, q, p)
    state.update_inside(s, m.tolerance, p)
    s.sigma = rrs_kernels.signed_sigma_min(pose, q, real.rrs)
    return state.SINGULAR if state.is_singular(s.sigma, p) else VALID


@njit(cache=True, inline="always")
def _attempt(s: Record, delta: int, rrs: int, p: EnvParams) -> tuple[int, int]:
    """Try a move of one robot or both, and write its effects; the status of each, 0 for HOLD."""
    if delta == HOLD and rrs == HOLD:
        return VALID, VALID
    if p.task.imperfect:  # one robot at a time
        status = _follow(s, state.neighbour(s, max(delta, rrs), p), p)
        delta_status, rrs_status = (VALID, status) if delta == HOLD else (status, VALID)
    else:
        delta_status, rrs_status = _move(s, delta, rrs, p)
    delta_moved = delta != HOLD and delta_status in (VALID, state.SINGULAR)
    rrs_moved = rrs != HOLD and rrs_status in (VALID, state.SINGULAR)
    if not (delta_moved or rrs_moved):
        if p.task.refused:
            s.refused[max(delta, rrs)] = 1
            state.update_mask(s, True, True, p)
        return delta_status, rrs_status
    s.refused[:] = 0
    if p.task.visited > 0:
        state.leave(s)
    if delta_moved:
        s.offset[delta // 2] += 1 - 2 * (delta % 2)
    if rrs_moved:
        s.offset[rrs // 2] += 1 - 2 * (rrs % 2)
    if not p.task.imperfect:
        state.update_inside(s, p.task.tolerance, p)
    state.update_mask(s, delta_moved, rrs_moved, p)
    return delta_status, rrs_status


@njit(cache=True)
def _inserts(s: Record, p: EnvParams) -> bool:
    """Whether the peg goes into the target: the criterion, and an imperfect machine's chance."""
    if s.inside[s.target] == 0 or s.filled[s.target] == 1:
        return False
    return not p.task.imperfect or machine.uniform(s.machine) < s.machine.insertion_probability


@njit(cache=True)
def _in_filled_holes(s: Record) -> int:
    """The filled holes whose criterion the peg meets, as the bits of a number."""
    return state.bits(s.filled) & state.bits(s.inside)


@njit(cache=True, inline="always")
def step(s: Record, action: int, p: EnvParams, out: Record) -> None:
    """One move of one robot; with latency the last action is executed now, HOLD at first."""
    due = action
    if p.task.imperfect and s.machine.latency:
        due = s.machine.pending
        s.machine.pending = action
    tick(s, due if due < 6 else HOLD, due if due >= 6 else HOLD, p, out)


@njit(cache=True, inline="always")
def tick(s: Record, delta: int, rrs: int, p: EnvParams, out: Record) -> None:
    """One time step, in which the Delta moves (0 to 5), the 3-RRS (6 to 11), both, or none (HOLD).

    Writes the next state to ``s`` and what happened to ``out``. A hole is filled by what was
    executed, also where the other robot's limits refused its move. With ``p.task.imperfect`` or
    ``p.task.refused`` one robot must hold.
    """
    before = _in_filled_holes(s)
    delta_status, rrs_status = _attempt(s, delta, rrs, p)
    singular = delta_status == state.SINGULAR or rrs_status == state.SINGULAR
    collision = delta_status == state.COLLISION or rrs_status == state.COLLISION
    arrived = (delta != HOLD and delta_status == VALID) or (rrs != HOLD and rrs_status == VALID)
    arrived = arrived and not singular
    v, target = delta_status != VALID or rrs_status != VALID, s.target
    u = arrived and _in_filled_holes(s) & ~before != 0
    z = arrived and _inserts(s, p)
    if z:
        s.filled[target] = 1
    n_open = state.open_holes(s)
    terminated = singular or n_open == 0 or (collision and p.task.fatal)
    if z and n_open > 0:
        target = state.nearest_open_hole(s)
    out.collision, out.singular = collision, singular
    conclude(s, (v, z, u, terminated, terminated and n_open > 0), target, p, out)


@njit(cache=True)
def conclude(
    s: Record, flags: tuple[bool, bool, bool, bool, bool], target: int, p: EnvParams, out: Record
) -> None:
    """Count the move, aim at the next target, and complete ``out``.

    ``flags``: a violation, an insertion, an entry to a filled hole, the episode's end, a failure.
    """
    v, z, u, terminated, _ = flags
    aimed, before = s.target, (s.distance, s.angle)
    s.moves += 1
    s.insertions += z
    after = (state.hole_distance(s, aimed), state.hole_angle(s, aimed))
    out.distance, out.alignment_error = after
    state.aim(s, target)
    if p.task.visited > 0 and target != aimed:  # the way to the next hole may lead back
        s.trailed = 0
        state.update_mask(s, True, True, p)
    _reward(s, flags, before, after, p, out)
    out.violation, out.inserted, out.duplicate = v, z, u
    out.inserted_hole = aimed if z else -1
    out.terminated = terminated
    out.truncated = not terminated and s.moves >= p.task.max_moves
    s.over = out.terminated or out.truncated
    out.success = s.insertions > 0
    out.n_filled = state.filled_holes(s)
    out.all_filled = state.open_holes(s) == 0
    out.sigma_min = s.sigma
    out.target = s.target
    out.time = s.moves * p.layout.dt
    out.energy = s.energy


@njit(cache=True)
def _reward(
    s: Record, flags: tuple[bool, bool, bool, bool, bool],
    before: tuple[float, float], after: tuple[float, float], p: EnvParams, out: Record,
) -> None:  # fmt: skip
    """Write the reward and its terms; ``before``, ``after``: distance and angle to one hole."""
    v, z, u, terminated, failed = flags
    filled, time = state.filled_holes(s), s.moves * p.layout.dt
    if not math.isnan(p.reward.gamma):
        # The potential of the next state: towards its own target, nought once it is terminal.
        after = (0.0, 0.0) if terminated else (s.distance, s.angle)
    d, a = (before[0], after[0]), (before[1], after[1])
    terms = rewards.terms(v, z, u, filled, time, d, a, p.reward)
    if failed and not p.reward.paper:
        left = p.task.max_moves - s.moves + 1  # this move is counted already
        terms = rewards.failure_terms(terms, left, p.reward)
    total = 0.0
    for k in range(len(terms)):
        out.terms[k] = terms[k]
        total += terms[k]
    out.reward = total
