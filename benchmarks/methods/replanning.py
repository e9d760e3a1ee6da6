"""Planners on a machine that stands elsewhere than their model: plan, look, plan again; or search.

Both plan exactly on the nominal model, by the lattice search of the optimum. What they learn on the
way are the two things that a machine without sensors tells: a move was refused, so that the
configuration it led to is barred; and the peg did not go in.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

import coop_env
from benchmarks.methods import lattice_search as search
from benchmarks.methods.episodes import Episode
from benchmarks.methods.lattice_search import Lattice
from coop_env.compilation import drop_stale_kernels, njit
from coop_env.simulation import state
from coop_env.simulation.collision import hole, peg_tip

drop_stale_kernels(Path(__file__).parent, Path(coop_env.__file__).parent)

WIDEST: Final = 2.0  # tolerances within which a configuration is worth a visit
RING: Final = 0.25  # tolerances between two rings, of which the inner is searched first

Points = NDArray[np.int64]


class Replanner:
    """Plays episodes by exact plans on the nominal model, made anew where one has failed.

    Args:
        searches: after a plan that did not insert, visit the configurations around the believed
            solution, ring by ring: in each the nearest that was not visited yet. Otherwise go to
            the nearest other configuration that the model takes for an insertion, visited or not.
        node_limit: of one search for a path.
    """

    def __init__(self, searches: bool, node_limit: int) -> None:
        self.searches, self.node_limit = searches, node_limit

    def play(self, episode: Episode) -> None:
        """Fill hole after hole until none is left, the time is up or there is nowhere to go."""
        p = episode.env.params
        model = p._replace(task=p.task._replace(imperfect=False))
        lattice = search.make_lattice(np.array(episode.env.state["start"]), model)
        barred: set[int] = set()
        while not episode.over:
            began = time.perf_counter()
            target = int(episode.env.state["target"])
            points, rings = solutions(lattice, target, WIDEST if self.searches else 1.0)
            if not episode.insertions:
                episode.plan_seconds = time.perf_counter() - began
            if not self._fill(episode, lattice, points, rings, barred):
                episode.failure = "nowhere to go"
                return

    def _fill(
        self, episode: Episode, lattice: Lattice, points: Points, rings: Points, barred: set[int]
    ) -> bool:
        """Visit one point after another until a hole is filled; False if none can be reached."""
        filled, tried, forgot_at = len(episode.insertions), np.zeros(len(points), bool), -1
        while not episode.over and len(episode.insertions) == filled:
            here = int(search.point_at(lattice, episode.env.state["offset"].astype(np.int64)))
            out = tried | (points == here) | np.isin(points, [*barred])
            if out.all():  # once more from the beginning, unless that has just led nowhere
                if episode.moves == forgot_at:
                    return False
                forgot_at = episode.moves
                barred.clear()
                tried[:] = False
                continue
            best = np.lexsort((_moves_between(lattice, points, here), rings, out))[0]
            moves = self._path(lattice, here, int(points[best]), barred)
            if moves is None:
                tried[best] = True
                continue
            visited = _follow(episode, lattice, here, moves, barred)
            if self.searches:
                tried |= np.isin(points, visited)
        return True

    def _path(
        self, lattice: Lattice, here: int, goal: int, barred: set[int]
    ) -> NDArray[np.int64] | None:
        """A shortest path on the model that keeps off what is barred, or None."""
        n_rrs, strides = lattice.rrs_free.size, lattice.strides
        to_delta = np.empty((1, lattice.delta_free.size), np.int32)
        to_rrs = np.empty((1, n_rrs), np.int32)
        search.distances(lattice.delta_free, strides[:3] // n_rrs, goal // n_rrs, to_delta[0])
        search.distances(lattice.rrs_free, strides[3:], goal % n_rrs, to_rrs[0])
        came_by = np.zeros(lattice.delta_free.size * n_rrs, np.uint8)
        came_by[[*barred]] = search.BARRED
        length, point, _ = search.a_star(lattice, here, to_delta, to_rrs, came_by, self.node_limit)
        return search.trace_back(lattice, point, length, came_by) if length > 0 else None


def _follow(
    episode: Episode, lattice: Lattice, here: int, moves: NDArray[np.int64], barred: set[int]
) -> list[int]:
    """Make moves until one is refused, inserts or ends the episode; the points visited."""
    visited = []
    for move in moves.tolist():
        there = here + (1 - 2 * (move % 2)) * int(lattice.strides[move // 2])
        info = episode.move(move)
        if info["violation"]:
            barred.add(there)
            break
        here = there
        visited.append(here)
        if info["inserted"] or episode.over:
            break
    return visited


def _moves_between(lattice: Lattice, points: Points, here: int) -> Points:
    """Least moves (n,) to points if nothing is in the way."""
    ends = np.append(points, here)[:, None] // lattice.strides % lattice.shape
    moves: Points = np.abs(ends[:-1] - ends[-1]).sum(axis=1)
    return moves


def solutions(lattice: Lattice, target: int, widest: float) -> tuple[Points, Points]:
    """Points (n,) within so many tolerances of the target's criterion, and the ring of each.

    Ring 0 is what the model takes for an insertion.
    """
    task = lattice.p.task
    wide = task._replace(
        tolerance=widest * task.tolerance, angle_tolerance=widest * task.angle_tolerance
    )
    points = search.goals(lattice._replace(p=lattice.p._replace(task=wide)), target)
    misses = _misses(lattice, points, target)
    return points, np.ceil(np.maximum(misses - 1.0, 0.0) / RING).astype(np.int64)


@njit(cache=True)
def _misses(lattice: Lattice, points: np.ndarray, target: int) -> np.ndarray:
    """How many tolerances points (n,) miss the target's mouth or axis by, the larger of both."""
    p = lattice.p
    out = np.empty(len(points))
    for i in range(len(points)):
        _, at, _, pose, _ = search.placed(lattice, search.configuration_at(lattice, points[i]))
        tip = peg_tip(at[0], at[1], at[2], p.delta)
        mouth, n = hole(pose, target, p)
        dx, dy, dz = mouth[0] - tip[0], mouth[1] - tip[1], mouth[2] - tip[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        angle = state.alignment_angle(n[0], n[1], n[2])
        out[i] = max(distance / p.task.tolerance, angle / p.task.angle_tolerance)
    return out
