"""Scripted controls: what a method needs no learning for, under the masks of its track.

*Random* draws from the allowed moves. *Greedy* makes the allowed move after which the potential
``500 d + w a`` is least, with the distance d (m) of the tip from the target's mouth, the angle a
(rad) between the peg and its normal, and a weight w that is chosen on validation starts.
*Lookahead* looks for the least over two allowed moves and makes the first of them. Both take an
insertion for the least there is.

The plain ones see the state, as far as the controller's model knows it: on an imperfect machine
distance, angle and masks are the nominal model's. Those from the *observation* have its 12 numbers,
noise included: they take the configuration as given, and the hole whose mouth and normal come
nearest to what is observed for the target. Masks are a memory where their track's are. Ties go to
the lower action, so that nothing depends on chance but *random*, which draws per episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import coop_env
from benchmarks.errors import BenchmarkError, known
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.plan import CONTROLS
from benchmarks.protocol.presets import Controls
from benchmarks.protocol.seeding import derive
from coop_env.compilation import drop_stale_kernels, njit
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import state, task
from coop_env.simulation.collision import hole, peg_tip
from coop_env.simulation.observation import PAPER_FIELDS, make_observation
from coop_env.simulation.state import Configuration
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams

drop_stale_kernels(Path(__file__).parent, Path(coop_env.__file__).parent)

DISTANCE_WEIGHT: Final = 500.0  # per m
INSERTED: Final = -1.0  # below any potential
AT_ONCE: Final = -2.0  # before what may insert with the move after: it would be put off for ever

Choose = Callable[[NDArray[np.float32], NDArray[np.bool_], Sequence[int]], NDArray[Any]]


def control(method: str, weights: Controls, seed: int) -> Callable[[Sequence[Episode]], Choose]:
    """What plays a control in episodes of one environment's arguments, which it is given.

    It takes observations (n, size), masks (n, 12) and the indices (n,) of the episodes they are of.

    Raises:
        BenchmarkError: the method is no control.
    """
    if method not in CONTROLS:
        raise BenchmarkError(f"unknown control '{method}'; known: {known(CONTROLS)}")
    if method == "random":
        return lambda episodes: _random(episodes, seed)
    ahead = method.startswith("lookahead")
    weight = weights.lookahead_angle if ahead else weights.greedy_angle
    play = _observed if method.endswith("_observed") else _informed
    return lambda episodes: play(episodes, weight, ahead)


def _random(episodes: Sequence[Episode], seed: int) -> Choose:
    generators = [np.random.default_rng(derive("planner", seed, e.number)) for e in episodes]

    def choose(_: Any, masks: NDArray[np.bool_], running: Sequence[int]) -> NDArray[Any]:
        rows = zip(masks, running, strict=True)
        return np.array([generators[i].choice(np.flatnonzero(mask)) for mask, i in rows])

    return choose


def _informed(episodes: Sequence[Episode], weight: float, ahead: bool) -> Choose:
    packed = task.pack(episodes[0].env.params)

    def choose(_: Any, masks: NDArray[np.bool_], running: Sequence[int]) -> NDArray[Any]:
        states = np.empty(len(running), episodes[0].env.state.dtype)
        for row, i in enumerate(running):
            states[row] = episodes[i].env.state
        return costs(states, weight, ahead, packed).argmin(axis=1)

    return choose


def _observed(episodes: Sequence[Episode], weight: float, ahead: bool) -> Choose:
    env = episodes[0].env
    p = env.params
    transform = make_observation("paper", True, p, env.task.error_bound)[0]
    packed = task.pack(p)

    def choose(
        observations: NDArray[np.float32], masks: NDArray[np.bool_], _: Sequence[int]
    ) -> NDArray[Any]:
        seen = observations[:, : len(PAPER_FIELDS)].astype(np.float64)
        return observed_costs(seen, masks, transform, weight, ahead, packed).argmin(axis=1)

    return choose


@njit(cache=True)
def potential(c: Configuration, target: int, weight: float, p: EnvParams) -> float:
    """``500 d + weight a`` at a configuration, as the model has it; INSERTED where it inserts."""
    tip = peg_tip(c[0], c[1], c[2], p.delta)
    mouth, n = hole(rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs), target, p)
    dx, dy, dz = mouth[0] - tip[0], mouth[1] - tip[1], mouth[2] - tip[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    angle = state.alignment_angle(n[0], n[1], n[2])
    if distance < p.task.tolerance and angle < p.task.angle_tolerance:
        return INSERTED
    return DISTANCE_WEIGHT * distance + weight * angle


@njit(cache=True)
def imagine(s: state.Record, action: int, p: EnvParams) -> None:
    """Make a move on a copy of a state as the controller's model would: offset, memory and mask."""
    if p.task.visited > 0:
        state.leave(s)
    s.offset[action // 2] += 1 - 2 * (action % 2)
    s.refused[:] = 0
    c = state.lattice_configuration(s.start, s.offset, p)
    s.sigma = rrs_kernels.sigma_at(c[3], c[4], c[5], p.rrs)
    state.update_mask(s, True, True, p)


@njit(cache=True)
def costs(states: np.ndarray, weight: float, ahead: bool, packed: np.ndarray) -> np.ndarray:
    """The potential (n, 12) that each allowed move of states (n,) leads to, others inf.

    With ``ahead`` the least of it and those after one more allowed move.
    """
    p = task.unpack(packed)
    out = np.full((states.shape[0], N_ACTIONS), np.inf)
    later = states[:1].copy()
    for i in range(states.shape[0]):
        s = states[i]
        for action in range(N_ACTIONS):
            if s.mask[action] == 0:
                continue
            out[i, action] = potential(state.neighbour(s, action, p), s.target, weight, p)
            if out[i, action] == INSERTED:
                out[i, action] = AT_ONCE
            if not ahead or out[i, action] == AT_ONCE:
                continue
            later[0] = s
            imagine(later[0], action, p)
            for second in range(N_ACTIONS):
                if later[0].mask[second] == 1:
                    c = state.neighbour(later[0], second, p)
                    out[i, action] = min(out[i, action], potential(c, s.target, weight, p))
    return out


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


@njit(cache=True)
def _moved(c: Configuration, action: int, p: EnvParams) -> Configuration:
    offset = np.zeros(N_AXES, np.int64)
    offset[action // 2] = 1 - 2 * (action % 2)
    start = np.array([c[0], c[1], c[2], c[3], c[4], c[5]])
    return state.lattice_configuration(start, offset, p)


@njit(cache=True)
def _allowed(c: Configuration, p: EnvParams) -> bool:
    """Whether masks without a memory allow a move to a configuration."""
    if p.task.mask_singularities:
        return state.configuration_status(c, p) == state.VALID
    return state.delta_valid(c, p) and state.rrs_valid(c, p)


@njit(cache=True)
def observed_costs(
    rows: np.ndarray, masks: np.ndarray, o: np.ndarray, weight: float, ahead: bool,
    packed: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """As :func:`costs`, from observations (n, 12) and masks (n, 12) of the first move.

    ``o`` is the observation's transform. Of the second moves those are allowed that lead to what
    the track's masks take for a valid configuration, and do not undo the first.
    """
    p = task.unpack(packed)
    out = np.full((rows.shape[0], N_ACTIONS), np.inf)
    for i in range(rows.shape[0]):
        si = rows[i] / o[1, :12] + o[0, :12]
        here = (si[0], si[1], si[2], si[3], si[4], si[5])
        target = likeliest_hole(here, rows[i], o, p)
        for action in range(N_ACTIONS):
            if not masks[i, action]:
                continue
            there = _moved(here, action, p)
            out[i, action] = potential(there, target, weight, p)
            if out[i, action] == INSERTED:
                out[i, action] = AT_ONCE
            if not ahead or out[i, action] == AT_ONCE:
                continue
            for second in range(N_ACTIONS):
                c = _moved(there, second, p)
                if second != action ^ 1 and _allowed(c, p):
                    out[i, action] = min(out[i, action], potential(c, target, weight, p))
    return out
