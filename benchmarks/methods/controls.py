"""Scripted controls: how well a track's masks and observations do without learning.

*Random* draws from the allowed moves. *Greedy* makes the allowed move after which the potential
``500 d + w a`` is least, with the distance d (m) of the tip from the target's mouth, the angle a
(rad) between the peg and its normal, and a weight w that is chosen on validation starts.
*Lookahead* makes the first of the two allowed moves after which it is least; of equal pairs, the
one with the least potential in between. An insertion counts as the least of all and is made at
once. Ties go to the lower action.

The plain ones see the state as the controller's model knows it. Those from the *observation* have
its 12 numbers, noise included: the target is the hole whose mouth and normal come nearest to them.

Where both robots move at once, a central *greedy* makes the joint move after which the potential is
least. Of two agents each makes the move after which it would be least if the other held, and holds
if none makes it less: in sight of the other the whole potential, else the Delta's d, the 3-RRS's a.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods.base import Chooser, Masks, Observations, misses
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.presets import Controls
from benchmarks.protocol.seeding import derive
from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import joint, state, task
from coop_env.simulation.collision import hole, peg_tip
from coop_env.simulation.observation import PAPER_FIELDS, make_observation
from coop_env.simulation.state import Configuration
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams
from coop_env.team.agents import Team
from coop_env.team.joint_env import CoopInsertionJointEnv

DISTANCE_WEIGHT: Final = 500.0  # per m
INSERTED: Final = -1.0  # below any potential
ROUNDING: Final = 1e-9  # what a move must win, or its robot holds


def control(method: str, weights: Controls, seed: int) -> Callable[[Sequence[Episode]], Chooser]:
    """A function that returns a control's chooser for episodes whose environments are alike."""
    if method == "random":
        return lambda episodes: _random(episodes, seed)
    weight = getattr(weights, f"{method}_angle")
    return lambda episodes: _scripted(method, episodes, weight)


def _random(episodes: Sequence[Episode], seed: int) -> Chooser:
    generators = [np.random.default_rng(derive("planner", seed, e.number)) for e in episodes]

    def choose(_: Observations, masks: Masks, running: Sequence[int]) -> NDArray[Any]:
        rows = zip(masks, running, strict=True)
        return np.array([generators[i].choice(np.flatnonzero(mask)) for mask, i in rows])

    return choose


def _scripted(method: str, episodes: Sequence[Episode], weight: float) -> Chooser:
    env = episodes[0].env
    packed = task.pack(env.params)
    transform = make_observation("paper", True, env.params, env.task.error_bound)[0]

    def choose(observations: Observations, masks: Masks, running: Sequence[int]) -> NDArray[Any]:
        states = np.zeros(len(running), env.state.dtype)
        if method.endswith("_observed"):
            states["mask"] = masks
            seen = observations[:, : len(PAPER_FIELDS)].astype(np.float64)
            believe(states, seen, transform, packed)
        else:
            for row, i in enumerate(running):
                states[row] = episodes[i].env.state
        if isinstance(env, Team):
            return own_choices(states, masks, weight, env.sight, packed)
        if isinstance(env, CoopInsertionJointEnv):
            return joint_choices(states, masks, weight, packed)
        states["mask"] = masks  # under a shield narrower than the state's
        return choices(states, weight, method.startswith("lookahead"), packed)

    return choose


@njit(cache=True)
def potential(c: Configuration, target: int, weight: float, p: EnvParams) -> float:
    """``500 d + weight a`` at a configuration; INSERTED where it inserts."""
    distance, angle = misses(c, target, p)
    if distance < p.task.tolerance and angle < p.task.angle_tolerance:
        return INSERTED
    return DISTANCE_WEIGHT * distance + weight * angle


@njit(cache=True)
def imagine(s: state.Record, action: int, p: EnvParams) -> None:
    """Make a move on a copy of a state by the controller's model: offset, memory and mask."""
    if p.task.visited > 0:
        state.leave(s)
    s.offset[action // 2] += 1 - 2 * (action % 2)
    s.refused[:] = 0
    c = state.lattice_configuration(s.start, s.offset, p)
    s.sigma = rrs_kernels.sigma_at(c[3], c[4], c[5], p.rrs)
    state.update_mask(s, True, True, p)


@njit(cache=True)
def choices(states: np.ndarray, weight: float, ahead: bool, packed: np.ndarray) -> np.ndarray:
    """Choices (n,) of *greedy*, or with ``ahead`` of *lookahead*, in states (n,)."""
    p = task.unpack(packed)
    out = np.empty(states.shape[0], np.int64)
    spare = states[:1].copy()
    after = np.empty(N_ACTIONS)
    for i in range(states.shape[0]):
        s = states[i]
        for action in range(N_ACTIONS):
            after[action] = math.inf
            if s.mask[action] == 1:
                after[action] = potential(state.neighbour(s, action, p), s.target, weight, p)
        out[i] = after.argmin()
        if ahead and after[out[i]] != INSERTED:
            out[i] = _look_ahead(s, spare, after, weight, p)
    return out


@njit(cache=True)
def _look_ahead(
    s: state.Record, spare: np.ndarray, after: np.ndarray, weight: float, p: EnvParams
) -> int:
    """The first of the best two moves; ``after`` (12,) is the potential after one, inf if barred.

    Masks cost most, so first moves are tried in the order of the best that any second move could
    make of them, until none that is left can beat the best found.
    """
    pairs = np.full((N_ACTIONS, N_ACTIONS), math.inf)
    floor = np.full(N_ACTIONS, math.inf)
    for first in range(N_ACTIONS):
        if s.mask[first] == 1:
            axis, sign = first // 2, 1 - 2 * (first % 2)
            s.offset[axis] += sign
            for second in range(N_ACTIONS):
                c = state.neighbour(s, second, p)
                pairs[first, second] = potential(c, s.target, weight, p)
            s.offset[axis] -= sign
            floor[first] = pairs[first].min()
    best, between, choice = math.inf, math.inf, int(after.argmin())
    while True:
        first = int(floor.argmin())
        if not floor[first] < math.inf or floor[first] > best:
            return choice
        floor[first] = math.inf
        spare[0] = s
        imagine(spare[0], first, p)
        least = math.inf
        for second in range(N_ACTIONS):
            if spare[0].mask[second] == 1:
                least = min(least, pairs[first, second])
        if (least, after[first], first) < (best, between, choice):
            best, between, choice = least, after[first], first


@njit(cache=True)
def moved(s: state.Record, delta: int, rrs: int, p: EnvParams) -> Configuration:
    """The configuration to which both robots' choices lead."""
    d = state.neighbour(s, joint.move_of(joint.DELTA, delta), p)
    r = state.neighbour(s, joint.move_of(joint.RRS, rrs), p)
    return d[0], d[1], d[2], r[3], r[4], r[5]


@njit(cache=True)
def joint_choices(
    states: np.ndarray, masks: np.ndarray, weight: float, packed: np.ndarray
) -> np.ndarray:
    """Choices (n,) of a central *greedy* under joint masks (n, 49); at least one robot moves."""
    p = task.unpack(packed)
    out = np.empty(states.shape[0], np.int64)
    for i in range(states.shape[0]):
        least, out[i] = math.inf, joint.N_JOINT - 1
        for action in range(joint.N_JOINT - 1):
            if masks[i, action]:
                c = moved(states[i], action // joint.N_CHOICES, action % joint.N_CHOICES, p)
                after = potential(c, states[i].target, weight, p)
                if after < least:
                    least, out[i] = after, action
    return out


@njit(cache=True)
def own_choices(
    states: np.ndarray, masks: np.ndarray, weight: float, sight: bool, packed: np.ndarray
) -> np.ndarray:
    """Choices (n,) of two *greedy* agents in states (n,) under joint masks (n, 49)."""
    p = task.unpack(packed)
    out = np.empty(states.shape[0], np.int64)
    chosen, hold = np.empty(2, np.int64), joint.HOLD_CHOICE
    for i in range(states.shape[0]):
        for agent in range(2):
            least = math.inf
            for k in range(joint.N_CHOICES):
                choice = (hold + k) % joint.N_CHOICES  # hold first, then the lowest
                delta, rrs = (choice, hold) if agent == joint.DELTA else (hold, choice)
                if not masks[i, joint.N_CHOICES * delta + rrs]:
                    continue
                c = moved(states[i], delta, rrs, p)
                after = potential(c, states[i].target, weight, p)
                if not sight:
                    after = misses(c, states[i].target, p)[agent]
                if after < least - ROUNDING:
                    least, chosen[agent] = after, choice
        out[i] = joint.N_CHOICES * chosen[joint.DELTA] + chosen[joint.RRS]
    return out


@njit(cache=True)
def believe(states: np.ndarray, rows: np.ndarray, o: np.ndarray, packed: np.ndarray) -> None:
    """Write to states (n,) what observations (n, 12) of transform ``o`` show: start, target."""
    p = task.unpack(packed)
    for i in range(states.shape[0]):
        s, si = states[i], rows[i] / o[1, :12] + o[0, :12]
        s.start[:] = si[:N_AXES]
        c = (si[0], si[1], si[2], si[3], si[4], si[5])
        s.target = likeliest_hole(c, rows[i], o, p)


@njit(cache=True)
def likeliest_hole(c: Configuration, row: np.ndarray, o: np.ndarray, p: EnvParams) -> int:
    """The hole whose mouth and normal are nearest to an observation's, in units of its fields."""
    tip = peg_tip(c[0], c[1], c[2], p.delta)
    pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
    best, least = 0, math.inf
    for index in range(p.layout.n_holes):
        mouth, normal = hole(pose, index, p)
        miss = 0.0
        for k in range(3):
            relative = min(max((mouth[k] - tip[k] - o[0, 6 + k]) * o[1, 6 + k], 0.0), 1.0)
            upright = (normal[k] - o[0, 9 + k]) * o[1, 9 + k]
            miss += (relative - row[6 + k]) ** 2 + (upright - row[9 + k]) ** 2
        if miss < least:
            best, least = index, miss
    return best
