"""Kernels of the exact lattice search: the two robots' sub-lattices, goals, and A*.

The lattice of an episode is its start plus whole moves along six axes. It is the product of the
Delta's three axes and the 3-RRS's three; only collisions couple the two. Shortest paths within each
sub-lattice alone are therefore a lower bound that no collision-free path can beat, and a tight one.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

import coop_env
from coop_env.compilation import drop_stale_kernels
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import state
from coop_env.simulation.collision import collides, hole, peg_tip
from coop_env.simulation.state import Configuration
from coop_env.simulation.task import EnvParams

drop_stale_kernels(Path(__file__).parent, Path(coop_env.__file__).parent)

UNREACHED: Final = 1 << 20  # above any path, and sums of two stay small integers
NODE_LIMIT: Final = -1
INFEASIBLE: Final = -2


class Grid(NamedTuple):
    """One robot's sub-lattice: offsets ``low`` to ``low + shape - 1`` on its three axes.

    ``free (size,)`` marks the nodes that its own limits (and, of the 3-RRS, its singularities)
    allow; nodes are numbered in C order.
    """

    low: NDArray[np.int64]
    shape: NDArray[np.int64]
    free: NDArray[np.bool_]


@njit(cache=True)
def node_offset(grid: Grid, node: int, axis: int) -> int:
    """Offset from the episode's start, in moves, of a node along one of the grid's axes."""
    n1, n2 = grid.shape[1], grid.shape[2]
    if axis == 0:
        return grid.low[0] + node // (n1 * n2)
    if axis == 1:
        return grid.low[1] + (node // n2) % n1
    return grid.low[2] + node % n2


@njit(cache=True)
def node_at(grid: Grid, offset: NDArray[np.int64]) -> int:
    """Number of the node at three offsets."""
    i, j, k = offset[0] - grid.low[0], offset[1] - grid.low[1], offset[2] - grid.low[2]
    return (i * grid.shape[1] + j) * grid.shape[2] + k


@njit(cache=True)
def neighbour(grid: Grid, node: int, move: int) -> int:
    """The free node one move away (``2 k`` is + and ``2 k + 1`` - on axis k), or -1."""
    axis, sign = move // 2, 1 - 2 * (move % 2)
    index = node_offset(grid, node, axis) - grid.low[axis] + sign
    if index < 0 or index >= grid.shape[axis]:
        return -1
    stride = 1
    for k in range(axis + 1, 3):
        stride *= grid.shape[k]
    other = node + sign * stride
    return other if grid.free[other] else -1


@njit(cache=True)
def configuration_at(
    start: NDArray[np.float64], delta: Grid, rrs: Grid, delta_node: int, rrs_node: int, p: EnvParams
) -> Configuration:
    """The configuration of a pair of nodes, to the bit as the environment has it."""
    offset = np.empty(6, np.int64)
    for k in range(3):
        offset[k] = node_offset(delta, delta_node, k)
        offset[3 + k] = node_offset(rrs, rrs_node, k)
    return state.lattice_configuration(start, offset, p)


@njit(cache=True)
def fill_free(start: NDArray[np.float64], delta: Grid, rrs: Grid, p: EnvParams) -> None:
    """Write ``free`` of both grids."""
    some_rrs = node_at(rrs, np.zeros(3, np.int64))
    some_delta = node_at(delta, np.zeros(3, np.int64))
    for node in range(delta.free.size):
        c = configuration_at(start, delta, rrs, node, some_rrs, p)
        delta.free[node] = state.delta_valid(c, p)
    for node in range(rrs.free.size):
        c = configuration_at(start, delta, rrs, some_delta, node, p)
        rrs.free[node] = state.rrs_valid(c, p) and not state.is_singular(
            rrs_kernels.sigma_at(c[3], c[4], c[5], p.rrs), p
        )


@njit(cache=True)
def distances(grid: Grid, source: int, out: NDArray[np.int32]) -> None:
    """Moves from a free node to each node of its grid, by breadth-first search."""
    out[:] = UNREACHED
    queue = np.empty(grid.free.size, np.int64)
    queue[0] = source
    out[source] = 0
    head, tail = 0, 1
    while head < tail:
        node = queue[head]
        head += 1
        for move in range(6):
            other = neighbour(grid, node, move)
            if other >= 0 and out[other] == UNREACHED:
                out[other] = out[node] + 1
                queue[tail] = other
                tail += 1


@njit(cache=True)
def goals(
    start: NDArray[np.float64], delta: Grid, rrs: Grid, target: int, p: EnvParams
) -> NDArray[np.int64]:
    """All free, collision-free pairs of nodes (n, 2) that meet the target's insertion criterion."""
    found = []
    some_delta = node_at(delta, np.zeros(3, np.int64))
    step = p.layout.step
    reach = int(p.task.tolerance / step[0]) + 1
    offset = np.empty(3, np.int64)
    for rrs_node in range(rrs.free.size):
        if not rrs.free[rrs_node]:
            continue
        c = configuration_at(start, delta, rrs, some_delta, rrs_node, p)
        pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
        mouth, normal = hole(pose, target, p)
        if state.alignment_angle(normal[0], normal[1], normal[2]) >= p.task.angle_tolerance:
            continue
        above = mouth[2] - p.delta.base_height + p.delta.peg_length
        for k, wanted in enumerate((mouth[0], mouth[1], above)):
            offset[k] = round((wanted - start[k]) / step[k])
        for i in range(offset[0] - reach, offset[0] + reach + 1):
            for j in range(offset[1] - reach, offset[1] + reach + 1):
                for k in range(offset[2] - reach, offset[2] + reach + 1):
                    node = _goal_node(start, delta, (i, j, k), mouth, p)
                    if node >= 0 and not _pair_collides(start, delta, rrs, node, rrs_node, p):
                        found.append((node, rrs_node))
    out = np.empty((len(found), 2), np.int64)
    for n in range(len(found)):
        out[n, 0], out[n, 1] = found[n]
    return out


@njit(cache=True)
def _goal_node(
    start: NDArray[np.float64], delta: Grid, at: tuple[int, int, int],
    mouth: tuple[float, float, float], p: EnvParams,
) -> int:  # fmt: skip
    for k in range(3):
        if at[k] < delta.low[k] or at[k] >= delta.low[k] + delta.shape[k]:
            return -1
    step = p.layout.step
    tip = peg_tip(
        start[0] + at[0] * step[0], start[1] + at[1] * step[1], start[2] + at[2] * step[2], p.delta
    )
    dx, dy, dz = mouth[0] - tip[0], mouth[1] - tip[1], mouth[2] - tip[2]
    if math.sqrt(dx * dx + dy * dy + dz * dz) >= p.task.tolerance:
        return -1
    node = node_at(delta, np.array(at))
    return node if delta.free[node] else -1


@njit(cache=True)
def _pair_collides(
    start: NDArray[np.float64], delta: Grid, rrs: Grid, delta_node: int, rrs_node: int, p: EnvParams
) -> bool:
    c = configuration_at(start, delta, rrs, delta_node, rrs_node, p)
    _, theta, pose, q = state.joint_angles(c, p)
    return collides(c[0], c[1], c[2], theta, pose, q, p)


@njit(cache=True)
def lower_bound(
    delta_node: int, rrs_node: int, to_delta: NDArray[np.int32], to_rrs: NDArray[np.int32]
) -> int:
    """Least moves to a goal if nothing collided, or UNREACHED; ``to_*`` (goals, nodes) by grid."""
    least = UNREACHED
    for g in range(to_delta.shape[0]):
        least = min(least, to_delta[g, delta_node] + to_rrs[g, rrs_node])
    return least


@njit(cache=True)
def _grow(entries: NDArray[np.int64]) -> NDArray[np.int64]:
    bigger = np.empty((2 * entries.shape[0], entries.shape[1]), np.int64)
    bigger[: entries.shape[0]] = entries
    return bigger


@njit(cache=True)
def a_star(
    start: NDArray[np.float64], delta: Grid, rrs: Grid, source: tuple[int, int],
    to_delta: NDArray[np.int32], to_rrs: NDArray[np.int32], came_by: NDArray[np.uint8],
    node_limit: int, p: EnvParams,
) -> tuple[int, int, int]:  # fmt: skip
    """Shortest collision-free path from ``source`` (Delta node, 3-RRS node) to the nearest goal.

    The bound is exact in each sub-lattice, so it is consistent and a pair's first expansion is
    optimal. The open list is one stack per total length; of equals the deepest goes first, which
    runs straight to the goal where nothing is in the way.

    Args:
        came_by: zeros (Delta nodes x 3-RRS nodes), becomes 1 + the move that led to each pair.

    Returns:
        Length (or INFEASIBLE or NODE_LIMIT), the goal's pair number, and pairs expanded.
    """
    n_rrs = rrs.free.size
    bound = lower_bound(source[0], source[1], to_delta, to_rrs)
    if bound >= UNREACHED:
        return INFEASIBLE, -1, 0
    entries = np.empty((1024, 4), np.int64)  # pair, moves so far, 1 + move, entry below
    heads = np.full(bound + 64, -1, np.int64)
    entries[0] = (source[0] * n_rrs + source[1], 0, 13, -1)
    heads[bound] = 0
    used, expanded, f = 1, 0, bound
    while f < heads.size:
        top = heads[f]
        if top < 0:
            f += 1
            continue
        pair, g, by, below = entries[top]
        heads[f] = below
        if came_by[pair] != 0:
            continue
        a, b = pair // n_rrs, pair % n_rrs
        if g > 0 and _pair_collides(start, delta, rrs, a, b, p):
            came_by[pair] = 255
            continue
        came_by[pair] = by
        if f == g and g > 0:
            return g, pair, expanded
        expanded += 1
        if expanded > node_limit:
            return NODE_LIMIT, -1, expanded
        for move in range(12):
            na, nb = a, b
            if move < 6:
                na = neighbour(delta, a, move)
            else:
                nb = neighbour(rrs, b, move - 6)
            if na < 0 or nb < 0 or came_by[na * n_rrs + nb] != 0:
                continue
            total = g + 1 + lower_bound(na, nb, to_delta, to_rrs)
            if total >= UNREACHED:
                continue
            if total >= heads.size:
                more = np.full(2 * total, -1, np.int64)
                more[: heads.size] = heads
                heads = more
            if used == entries.shape[0]:
                entries = _grow(entries)
            entries[used] = (na * n_rrs + nb, g + 1, move + 1, heads[total])
            heads[total] = used
            used += 1
    return INFEASIBLE, -1, expanded


@njit(cache=True)
def trace_back(
    pair: int, length: int, delta: Grid, rrs: Grid, came_by: NDArray[np.uint8]
) -> NDArray[np.int64]:
    """The moves that led to a pair, in order."""
    moves = np.empty(length, np.int64)
    n_rrs = rrs.free.size
    for i in range(length - 1, -1, -1):
        move = int(came_by[pair]) - 1
        moves[i] = move
        a, b = pair // n_rrs, pair % n_rrs
        if move < 6:
            a = neighbour(delta, a, move ^ 1)
        else:
            b = neighbour(rrs, b, (move - 6) ^ 1)
        pair = a * n_rrs + b
    return moves
