"""Kernels of the exact lattice search: the lattice of an episode, its goals, and A*.

The lattice of an episode is its start plus whole moves along six axes. It is the product of the
Delta's three axes and the 3-RRS's three; only collisions couple the two. Shortest paths within each
sub-lattice alone are therefore a lower bound that no collision-free path can beat, and a tight one.
"""

import heapq
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods.base import tip_distance, workspace
from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_forward_kernels, rrs_kernels
from coop_env.kinematics.rrs_kernels import Pose
from coop_env.kinematics.singularity import Row
from coop_env.simulation import machine, state
from coop_env.simulation.collision import collides, hole
from coop_env.simulation.state import Configuration
from coop_env.simulation.task import EnvParams

UNREACHED: Final = 1 << 20  # above any path, and sums of two stay small integers
NODE_LIMIT: Final = -1
INFEASIBLE: Final = -2
# how far a real machine may be from its model at most, beyond which it is not asked
TILT_SLACK: Final = 0.3  # rad
REACH_SLACK: Final = 0.02  # m
BARRED: Final = 255  # of a point, in place of the move that led there


class Lattice(NamedTuple):
    """Lattice points around ``start``, numbered in C order; one lattice serves every target.

    ``low`` (6,) is the least offset on each axis, in moves. A point's number is the number of its
    Delta node times ``rrs_free.size``, plus that of its 3-RRS node; ``strides`` (6,) are the
    numbers that one move on an axis adds. The flat ``delta_free`` and ``rrs_free`` mark the nodes
    that a robot's own limits (and, of the 3-RRS, its singularities) allow. The outermost never are,
    so that one move from a free node leads to a node.

    With ``p.task.imperfect`` it is the lattice of the commands of a real ``machine``, a record of
    :data:`coop_env.simulation.machine.MACHINE`.
    """

    start: NDArray[np.float64]
    low: NDArray[np.int64]
    shape: NDArray[np.int64]
    strides: NDArray[np.int64]
    delta_free: NDArray[np.bool_]
    rrs_free: NDArray[np.bool_]
    p: EnvParams
    machine: Any


def make_lattice(start: NDArray[np.float64], p: EnvParams, real: Any = None) -> Lattice:
    """The lattice of an episode from a configuration (6,), of a ``real`` machine if imperfect."""
    record = np.void(np.zeros(1, machine.MACHINE)[0] if real is None else real)
    low, high = (workspace(p) - start) / p.layout["step"]
    # Rounding may let the kernels accept a node on the limit, so one more is beyond it for certain.
    first = np.floor(low).astype(np.int64) - 1
    shape = np.ceil(high).astype(np.int64) + 2 - first
    strides = np.append(np.cumprod(shape[:0:-1])[::-1], 1)
    delta_free, rrs_free = (np.zeros(part.prod(), np.bool_) for part in (shape[:3], shape[3:]))
    lattice = Lattice(start, first, shape, strides, delta_free, rrs_free, p, record)
    fill_free(lattice)
    return lattice


@njit(cache=True)
def point_at(lattice: Lattice, offset: NDArray[np.int64]) -> int:
    """Number of the lattice point at six offsets from the start."""
    return ((offset - lattice.low) * lattice.strides).sum()


@njit(cache=True)
def configuration_at(lattice: Lattice, point: int) -> Configuration:
    """The configuration of a lattice point, to the bit as the environment has it."""
    strides, shape, low = lattice.strides, lattice.shape, lattice.low
    offset = (
        point // strides[0] % shape[0] + low[0],
        point // strides[1] % shape[1] + low[1],
        point // strides[2] % shape[2] + low[2],
        point // strides[3] % shape[3] + low[3],
        point // strides[4] % shape[4] + low[4],
        point // strides[5] % shape[5] + low[5],
    )  # no array, whose making would take most of the time
    return state.lattice_configuration(lattice.start, offset, lattice.p)


@njit(cache=True)
def fill_free(lattice: Lattice) -> None:
    """Write which nodes are free."""
    p, n_rrs = lattice.p, lattice.rrs_free.size
    start = point_at(lattice, np.zeros(6, np.int64))
    for node in range(lattice.delta_free.size):
        c = configuration_at(lattice, node * n_rrs + start % n_rrs)
        lattice.delta_free[node] = state.delta_valid(c, p)
    for node in range(n_rrs):
        c = configuration_at(lattice, start // n_rrs * n_rrs + node)
        lattice.rrs_free[node] = state.rrs_valid(c, p) and not state.is_singular(
            real_sigma(lattice, c) if p.task.imperfect
            else rrs_kernels.sigma_at(c[3], c[4], c[5], p.rrs), p
        )  # fmt: skip


@njit(cache=True)
def real_sigma(lattice: Lattice, c: Configuration) -> float:
    """Signed sigma_min of the real machine where the model is at a configuration; NaN if open."""
    m, p = lattice.machine, lattice.p
    real = machine.real_params(m, p)
    _, theta, _, q = state.joint_angles(c, p)
    _, q = machine.answer(m, theta, q)
    closed, tilt, _ = rrs_forward_kernels.forward(q, c[3], c[4], c[5], real.rrs)
    if not closed:
        return np.nan
    pose = rrs_kernels.platform_pose(tilt[0], tilt[1], tilt[2], real.rrs)
    return rrs_kernels.signed_sigma_min(pose, q, real.rrs)


@njit(cache=True)
def placed(lattice: Lattice, c: Configuration) -> tuple[bool, Row, Row, Pose, Row]:
    """Whether both robots can be assembled at a configuration; effector, theta, pose and q there.

    For an imperfect machine these are the real ones, the pose as the Delta meets it.
    """
    m, p = lattice.machine, lattice.p
    _, theta, pose, q = state.joint_angles(c, p)
    if not p.task.imperfect:
        return True, (c[0], c[1], c[2]), theta, pose, q
    real = machine.real_params(m, p)
    theta, q = machine.answer(m, theta, q)
    delta_closed, at = delta_kernels.forward(theta, real.delta)
    rrs_closed, tilt, _ = rrs_forward_kernels.forward(q, c[3], c[4], c[5], real.rrs)
    pose = machine.displaced(m, rrs_kernels.platform_pose(tilt[0], tilt[1], tilt[2], real.rrs))
    return delta_closed and rrs_closed, at, theta, pose, q


@njit(cache=True)
def distances(
    free: NDArray[np.bool_], strides: NDArray[np.int64], source: int, out: NDArray[np.int32]
) -> None:
    """Moves from a free node to each node of one robot, by breadth-first search."""
    out[:] = UNREACHED
    queue = np.empty(free.size, np.int64)
    queue[0] = source
    out[source] = 0
    head, tail = 0, 1
    while head < tail:
        node = queue[head]
        head += 1
        for stride in strides:
            for other in (node + stride, node - stride):
                if free[other] and out[other] == UNREACHED:
                    out[other] = out[node] + 1
                    queue[tail] = other
                    tail += 1


@njit(cache=True)
def goals(lattice: Lattice, target: int) -> NDArray[np.int64]:
    """All free, collision-free lattice points (n,) that meet the target's insertion criterion."""
    p, start, result = lattice.p, lattice.start, []
    n_rrs, step = lattice.rrs_free.size, p.layout.step
    some_delta = point_at(lattice, np.zeros(6, np.int64)) // n_rrs
    reach = int(p.task.tolerance / step[0]) + 1
    nearest, shape, strides = np.empty(3, np.int64), lattice.shape, lattice.strides
    for rrs_node in range(n_rrs):
        if not lattice.rrs_free[rrs_node]:
            continue
        c = configuration_at(lattice, some_delta * n_rrs + rrs_node)
        pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
        mouth, normal = hole(pose, target, p)
        if p.task.imperfect:
            believed = state.alignment_angle(normal[0], normal[1], normal[2])
            if believed >= p.task.angle_tolerance + TILT_SLACK:
                continue
            mouth, normal = hole(placed(lattice, c)[3], target, p)
        if state.alignment_angle(normal[0], normal[1], normal[2]) >= p.task.angle_tolerance:
            continue
        above = mouth[2] - p.delta.base_height + p.delta.peg_length
        for k, wanted in enumerate((mouth[0], mouth[1], above)):
            nearest[k] = round((wanted - start[k]) / step[k]) - lattice.low[k]
        for x in range(max(nearest[0] - reach, 0), min(nearest[0] + reach + 1, shape[0])):
            for y in range(max(nearest[1] - reach, 0), min(nearest[1] + reach + 1, shape[1])):
                for z in range(max(nearest[2] - reach, 0), min(nearest[2] + reach + 1, shape[2])):
                    point = x * strides[0] + y * strides[1] + z * strides[2] + rrs_node
                    if _meets(lattice, point, mouth) and not _point_collides(lattice, point):
                        result.append(point)
    return np.array(result, np.int64)


@njit(cache=True)
def _meets(lattice: Lattice, point: int, mouth: tuple[float, float, float]) -> bool:
    """Whether the Delta's node is free and has the peg's tip in a mouth."""
    p = lattice.p
    if not lattice.delta_free[point // lattice.rrs_free.size]:
        return False
    c = configuration_at(lattice, point)
    distance = tip_distance((c[0], c[1], c[2]), mouth, p)
    if p.task.imperfect and distance < p.task.tolerance + REACH_SLACK:
        distance = tip_distance(placed(lattice, c)[1], mouth, p)
    return distance < p.task.tolerance


@njit(cache=True)
def _point_collides(lattice: Lattice, point: int) -> bool:
    p = lattice.p
    closed, at, theta, pose, q = placed(lattice, configuration_at(lattice, point))
    if not p.task.imperfect:
        return collides(at[0], at[1], at[2], theta, pose, q, p)
    real = machine.real_params(lattice.machine, p)
    return not closed or collides(at[0], at[1], at[2], theta, pose, q, real)


def single_jumps(lattice: Lattice) -> NDArray[np.int64]:
    """The change of a point's number by each of the 12 moves of one robot."""
    return (lattice.strides[:, None] * np.array([1, -1])).ravel()


def joint_jumps(lattice: Lattice) -> NDArray[np.int64]:
    """The change by each of the 49 joint actions: both robots move, or one or both hold."""
    choices = np.append(single_jumps(lattice).reshape(2, 6), np.zeros((2, 1), np.int64), axis=1)
    return (choices[0][:, None] + choices[1]).ravel()


@njit(cache=True)
def lower_bound(
    point: int, to_delta: NDArray[np.int32], to_rrs: NDArray[np.int32], at_once: bool
) -> int:
    """Least moves to a goal if nothing collided, or UNREACHED; ``to_*`` (goals, nodes) by robot.

    The robots' moves add up, unless both move ``at_once``: then the longer of two paths counts.
    """
    delta_node, rrs_node = point // to_rrs.shape[1], point % to_rrs.shape[1]
    least = UNREACHED
    for g in range(to_delta.shape[0]):
        a, b = to_delta[g, delta_node], to_rrs[g, rrs_node]
        least = min(least, max(a, b) if at_once else a + b)
    return least


@njit(cache=True)
def a_star(
    lattice: Lattice, source: int, to_delta: NDArray[np.int32], to_rrs: NDArray[np.int32],
    came_by: NDArray[np.uint8], node_limit: int, jumps: NDArray[np.int64],
) -> tuple[int, int, NDArray[np.int64]]:  # fmt: skip
    """Shortest collision-free path from a lattice point to the nearest goal.

    The bound is exact in each sub-lattice, so it is consistent and a point's first expansion is
    optimal. Of equal total lengths the latest entry goes first, which runs straight to the goal
    where nothing is in the way.

    Args:
        came_by: zeros, one for each lattice point; becomes 1 + the move that led there.
        jumps: of :func:`single_jumps`, or of :func:`joint_jumps` where both robots move at once.

    Returns:
        Length (or INFEASIBLE or NODE_LIMIT), the goal's point, the points written in ``came_by``.
    """
    n_rrs, at_once = lattice.rrs_free.size, len(jumps) > 12
    bound = lower_bound(source, to_delta, to_rrs, at_once)
    if bound >= UNREACHED:
        return INFEASIBLE, -1, np.array([source])
    entries = [
        (bound, 0, source, 0, len(jumps) + 1)
    ]  # total length, -entry, point, moves so far, 1 + move
    pushed, expanded, written = 0, 0, [source]
    while len(entries) > 0:
        total, _, point, g, by = heapq.heappop(entries)
        if came_by[point] != 0:
            continue
        written.append(point)
        if g > 0 and _point_collides(lattice, point):
            came_by[point] = BARRED
            continue
        came_by[point] = by
        if total == g and g > 0:
            return g, point, np.array(written)
        expanded += 1
        if expanded > node_limit:
            return NODE_LIMIT, -1, np.array(written)
        for move in range(len(jumps)):
            other = point + jumps[move]
            free = lattice.delta_free[other // n_rrs] and lattice.rrs_free[other % n_rrs]
            if not free or came_by[other] != 0:
                continue
            total = g + 1 + lower_bound(other, to_delta, to_rrs, at_once)
            if total < UNREACHED:
                pushed += 1
                heapq.heappush(entries, (total, -pushed, other, g + 1, move + 1))
    return INFEASIBLE, -1, np.array(written)


def trace_back(
    point: int, length: int, came_by: NDArray[np.uint8], jumps: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The moves (length,) that led to a lattice point, in order."""
    moves = np.empty(length, np.int64)
    for i in reversed(range(length)):
        moves[i] = move = int(came_by[point]) - 1
        point -= int(jumps[move])
    return moves


class Paths:
    """Shortest paths on a lattice that avoid its ``barred`` points; distances are cached."""

    def __init__(self, lattice: Lattice, node_limit: int, at_once: bool = False) -> None:
        self.lattice, self.node_limit, self.at_once = lattice, node_limit, at_once
        self.barred: set[int] = set()
        self._jumps = joint_jumps(lattice) if at_once else single_jumps(lattice)
        self._maps: dict[tuple[bool, int], NDArray[np.int32]] = {}
        # clean between searches: a fresh one would cost more than most of them
        self._came_by = np.zeros(lattice.delta_free.size * lattice.rrs_free.size, np.uint8)

    def between(self, here: int, ends: NDArray[np.int64]) -> tuple[int, int, NDArray[np.int64]]:
        """A shortest path to the nearest of some points: its length, lower bound and moves.

        The length may be INFEASIBLE or NODE_LIMIT, the bound -1 if none is near.
        """
        lattice, came_by, barred = self.lattice, self._came_by, [*self.barred]
        n_rrs = lattice.rrs_free.size
        to_delta = self._distances(lattice.delta_free, lattice.strides[:3] // n_rrs, ends // n_rrs)
        to_rrs = self._distances(lattice.rrs_free, lattice.strides[3:], ends % n_rrs)
        near = to_delta[:, here // n_rrs] + to_rrs[:, here % n_rrs] < UNREACHED
        if not near.any():
            return INFEASIBLE, -1, np.empty(0, np.int64)
        to_delta, to_rrs = to_delta[near], to_rrs[near]
        came_by[barred] = BARRED
        length, point, written = a_star(
            lattice, here, to_delta, to_rrs, came_by, self.node_limit, self._jumps
        )
        moves = trace_back(point, max(length, 0), came_by, self._jumps)
        came_by[barred] = came_by[written] = 0
        return length, int(lower_bound(here, to_delta, to_rrs, self.at_once)), moves

    def _distances(
        self, free: NDArray[np.bool_], strides: NDArray[np.int64], nodes: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        """Moves (n, all nodes) of one robot to nodes (n,)."""
        keys = [(free is self.lattice.rrs_free, node) for node in nodes.tolist()]
        for key in {*keys} - self._maps.keys():
            self._maps[key] = np.empty(free.size, np.int32)
            distances(free, strides, key[1], self._maps[key])
        return np.array([self._maps[key] for key in keys], np.int32).reshape(-1, free.size)
