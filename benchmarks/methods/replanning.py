"""Planners on a machine that stands elsewhere than their model says: they plan again, or search.

Both plan exactly on the nominal model. On the way they learn the two things that a machine without
sensors shows: a move was refused, so the point it led to is barred; and the peg did not go in.
"""

import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods import lattice_search as search
from benchmarks.methods.base import misses, modelled
from benchmarks.methods.episodes import Episode
from benchmarks.methods.lattice_search import Lattice, Paths
from coop_env.compilation import njit

WIDEST: Final = 2.0  # tolerances within which a configuration is worth a visit
RING: Final = 0.25  # tolerances between two rings, of which the inner is searched first

Points = NDArray[np.int64]


class Replanner:
    """Plays episodes by exact plans on the nominal model, made anew where one has failed.

    Args:
        searches: after a plan that did not insert, visit the configurations around the believed
            solution, ring by ring. Otherwise go to the nearest other configuration that the model
            takes for an insertion, visited or not.
        node_limit: of one search for a path.
    """

    def __init__(self, searches: bool, node_limit: int) -> None:
        self.searches, self.node_limit = searches, node_limit

    def play(self, episode: Episode) -> None:
        """Fill hole after hole until none is left, the time is up or there is nowhere to go."""
        model, start = modelled(episode.env.params), np.array(episode.env.state["start"])
        lattice = search.make_lattice(start, model)
        paths = Paths(lattice, self.node_limit)
        while not episode.over:
            began = time.perf_counter()
            target = int(episode.env.state["target"])
            points, rings = solutions(lattice, target, WIDEST if self.searches else 1.0)
            if not episode.insertions:
                episode.plan_seconds = time.perf_counter() - began
            if not self._fill(episode, paths, points, rings):
                episode.failure = "nowhere to go"
                return

    def _fill(self, episode: Episode, paths: Paths, points: Points, rings: Points) -> bool:
        """Visit point after point until a hole is filled; False if no point can be reached."""
        filled, forgot_at = len(episode.insertions), -1
        lattice, barred = paths.lattice, paths.barred
        number = {point: i for i, point in enumerate(points.tolist())}
        tried = np.zeros(len(points), bool)
        while not episode.over and len(episode.insertions) == filled:
            here = int(search.point_at(lattice, episode.env.state["offset"].astype(np.int64)))
            out = tried.copy()
            out[[number[point] for point in (here, *barred) if point in number]] = True
            if out.all():  # start over, unless a whole round has just led nowhere
                if episode.moves == forgot_at:
                    return False
                forgot_at = episode.moves
                barred.clear()
                tried[:] = False
                continue
            ends = np.append(points, here)[:, None] // lattice.strides % lattice.shape
            distances = np.abs(ends[:-1] - ends[-1]).sum(axis=1)  # if nothing is in the way
            best = np.lexsort((distances, rings, out))[0]
            length, _, moves = paths.between(here, points[[best]])
            if length <= 0:
                tried[best] = True
                continue
            visited = _follow(episode, lattice, here, moves, barred)
            if self.searches:
                tried[[number[point] for point in visited if point in number]] = True
        return True


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


def solutions(lattice: Lattice, target: int, widest: float) -> tuple[Points, Points]:
    """Points (n,) within so many tolerances of the target, and their rings, 0 for an insertion."""
    task = lattice.p.task
    wide = task._replace(
        tolerance=widest * task.tolerance, angle_tolerance=widest * task.angle_tolerance
    )
    points = search.goals(lattice._replace(p=lattice.p._replace(task=wide)), target)
    beyond = np.maximum(_tolerances(lattice, points, target) - 1.0, 0.0)
    return points, np.ceil(beyond / RING).astype(np.int64)


@njit(cache=True)
def _tolerances(lattice: Lattice, points: np.ndarray, target: int) -> np.ndarray:
    """How many tolerances points (n,) miss the target's mouth or axis by, the larger of both."""
    p = lattice.p
    out = np.empty(len(points))
    for i in range(len(points)):
        distance, angle = misses(search.configuration_at(lattice, points[i]), target, p)
        out[i] = max(distance / p.task.tolerance, angle / p.task.angle_tolerance)
    return out
