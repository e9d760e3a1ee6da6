"""OMPL's RRT-Connect as the paper's classical baseline: plan, round to moves, run open loop.

The 3-RRS is planned to the nominal alignment pose, then the Delta to the hole. Both calls search
the six-dimensional configuration space scaled so that one move is one unit along every axis, with
the environment's own test of validity and collision; the axes of the robot that waits are held.
"""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from benchmarks.methods.base import Plan, workspace
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.presets import PlannerSettings
from coop_env.env import CoopInsertionEnv
from coop_env.kinematics.rrs_kernels import platform_pose
from coop_env.simulation import collision
from coop_env.simulation.state import VALID
from coop_env.simulation.task import N_AXES

Configuration = NDArray[np.float64]
Moves = list[int]

HELD: Final = 1e-3  # half-width, in moves, of an axis that may not move: it rounds to nothing
RETREAT: Final = 3  # moves up out of a hole that has just been filled
RESOLUTION: Final = 0.25  # moves between two states that are tested along an edge
SPACING: Final = 0.1  # moves between two points of a path that is rounded


class RRTConnect:
    """Plans to an insertion in the current target with OMPL's RRT-Connect.

    Args:
        limits: of each of the two planning calls. Iterations are termination checks: they run out
            before the time does, so that results do not depend on the machine's load.
        seed: of OMPL's global generator, 1 or above. OMPL takes it once per process, before the
            first sampler is made: plans repeat from process to process, not within one.
    """

    def __init__(self, limits: PlannerSettings, seed: int = 1) -> None:
        self.limits = limits
        ou.setLogLevel(ou.LOG_NONE)
        ou.RNG.setSeed(seed)

    def plan(self, env: CoopInsertionEnv) -> Plan:
        """Plan from the environment's state to its current target, without changing it.

        Returns:
            ``"solved"`` with the rounded moves, or ``"no alignment pose"``,
            ``"no plan (3-RRS)"``, ``"no plan (Delta)"`` without any.
        """
        begun = time.perf_counter()
        target = int(env.state["target"])
        moves = retreat(env)
        status = "solved"
        for robot, moving, aim in (
            ("3-RRS", (3, 4, 5), alignment_pose),
            ("Delta", (0, 1, 2), _above_hole),
        ):
            # kinematics are known exactly, so the coordinator knows where the rounded moves lead
            start = env.configuration + units(env) * displacement(moves)
            goal = aim(env, start, target)
            if goal is None:
                status = "no alignment pose"
                break
            path = self._search(env, start, goal, moving)
            if path is None:
                status = f"no plan ({robot})"
                break
            moves += round_path((path - start) / units(env))
        result = np.array(moves, dtype=np.int64) if status == "solved" else None
        return Plan(status, result, time.perf_counter() - begun)

    def _search(
        self, env: CoopInsertionEnv, start: Configuration, goal: Configuration,
        moving: Sequence[int],
    ) -> Configuration | None:  # fmt: skip
        """A dense path (n, 6) in SI units from start to goal, or None."""
        setup = _problem(env, start, goal, moving)
        planner = og.RRTConnect(setup.getSpaceInformation())
        planner.setRange(4.0)
        setup.setPlanner(planner)
        checks, deadline = itertools.count(1), time.perf_counter() + self.limits.time_limit

        def out_of_budget() -> bool:
            return next(checks) > self.limits.max_iterations or time.perf_counter() > deadline

        setup.setup()
        setup.solve(ob.PlannerTerminationCondition(out_of_budget))
        if not setup.haveExactSolutionPath():
            return None
        path = setup.getSolutionPath()
        path.interpolate(max(2, math.ceil(path.length() / SPACING)))
        states = np.array([state[0:N_AXES] for state in path.getStates()], dtype=np.float64)
        return states * units(env) + start


def _problem(
    env: CoopInsertionEnv, start: Configuration, goal: Configuration, moving: Sequence[int]
) -> Any:
    """The OMPL problem in units of moves relative to ``start``."""
    space = ob.RealVectorStateSpace(N_AXES)
    bounds = ob.RealVectorBounds(N_AXES)
    unit = units(env)
    low, high = (workspace(env.params) - start) / unit * np.isin(range(N_AXES), moving)
    for axis in range(N_AXES):
        bounds.setLow(axis, float(low[axis]) - HELD)
        bounds.setHigh(axis, float(high[axis]) + HELD)
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)

    def is_valid(state: Any) -> bool:
        c = np.array(state[0:N_AXES]) * unit + start
        # the peg may touch the dome within a hole's chamfer, as when it moves
        return env.configuration_status(c) == VALID

    setup.setStateValidityChecker(is_valid)
    extent = space.getMaximumExtent()
    setup.getSpaceInformation().setStateValidityCheckingResolution(RESOLUTION / extent)
    first, last = space.allocState(), space.allocState()
    first[0:N_AXES] = [0.0] * N_AXES
    last[0:N_AXES] = [float(x) for x in (goal - start) / unit]
    setup.setStartAndGoalStates(first, last)
    return setup


def units(env: CoopInsertionEnv) -> Configuration:
    """One move along each axis (6,), SI units."""
    return np.array(env.task.steps)


def retreat(env: CoopInsertionEnv) -> Moves:
    """Moves straight up while the peg stands in a filled hole; none elsewhere."""
    state = env.state
    if not np.any(state["inside"].astype(bool) & state["filled"].astype(bool)):
        return []
    up = np.zeros(N_AXES)
    for steps in range(1, RETREAT + 1):
        up[2] = steps * units(env)[2]
        if env.configuration_status(env.configuration + up) != VALID:
            return [4] * (steps - 1)
    return [4] * RETREAT


def alignment_pose(env: CoopInsertionEnv, now: Configuration, hole: int) -> Configuration | None:
    """The configuration ``now`` (6,) with the platform turned so that the hole's normal is upright.

    The smallest rotation that turns the hole's normal h upright gives the platform the normal
    (-h_x, -h_y, h_z). The heave is the nearest lattice height at which that is valid, None if none.
    """
    hx, hy, hz = env.task.hole_normals[hole]
    pitch, roll = math.asin(-hx), math.atan2(hy, hz)
    for steps in (0, 1, -1, 2, -2):
        goal = now.copy()
        goal[3:6] = roll, pitch, now[5] + steps * units(env)[5]
        if env.configuration_status(goal) == VALID:
            return goal
    return None


def _above_hole(env: CoopInsertionEnv, configuration: Configuration, hole: int) -> Configuration:
    """The configuration with the peg's tip in the hole's mouth, the platform as it is."""
    roll, pitch, heave = (float(x) for x in configuration[3:6])
    pose = platform_pose(roll, pitch, heave, env.params.rrs)
    goal = configuration.copy()
    goal[0:3] = collision.hole(pose, hole, env.params)[0]
    goal[2] -= env.params.delta.base_height - env.params.delta.peg_length
    return goal


def round_path(path: Configuration) -> Moves:
    """Moves along a dense path (n, 6), in moves from its start: the axis moves that lags most."""
    at = np.zeros(N_AXES, dtype=np.int64)
    moves: Moves = []
    for point in path:
        while True:
            lag = point - at
            axis = int(np.argmax(np.abs(lag)))
            if abs(lag[axis]) <= 0.5:
                break
            move = 2 * axis + int(lag[axis] < 0.0)
            at[axis] += 1 - 2 * (move % 2)
            moves.append(move)
    return moves


def displacement(moves: Sequence[int]) -> NDArray[np.int64]:
    """Where moves lead on the lattice, (6,)."""
    counts = np.bincount(moves, minlength=2 * N_AXES)
    return counts[0::2] - counts[1::2]


PlanFunction = Callable[[CoopInsertionEnv], Plan]


def execute(
    episode: Episode, plan: PlanFunction, finish: PlanFunction | None = None, again: bool = False
) -> None:
    """Fill hole after hole, each by one plan run open loop, until one fails; its cause is kept.

    Args:
        episode: is played.
        plan: the planner.
        finish: a second planner, from where the first one's moves led without an insertion.
        again: leave a plan where a move is refused, and plan again, until there is no plan.
    """
    while not episode.over:
        moves = episode.moves
        cause = _attempt(episode, plan, again)
        if again and cause and episode.moves > moves:
            episode.failure = cause
            continue
        if cause and cause != "singularity" and finish is not None:
            cause = _attempt(episode, finish)
        if cause:
            episode.failure = cause
            return


def _attempt(episode: Episode, plan: PlanFunction, stop: bool = False) -> str:
    """Plan once and make the moves; returns why it failed. ``stop`` ends it at a refused move."""
    answer = plan(episode.env)
    filled, refused = len(episode.insertions), 0
    if not filled:
        episode.plan_seconds = float(np.nansum([episode.plan_seconds, answer.seconds]))
    if answer.moves is None:
        return "no plan"
    info: dict[str, Any] = {}
    for move in answer.moves[: episode.moves_left]:
        info = episode.move(int(move))
        refused += bool(info["violation"])
        if len(episode.insertions) > filled:
            return ""
        if episode.over or (stop and refused):
            break
    return _cause(episode, info, refused)


def _cause(episode: Episode, info: dict[str, Any], refused: int) -> str:
    if info.get("singular"):
        return "singularity"
    if episode.over:
        return "out of time"
    if refused:  # all later moves started from elsewhere
        return "collision"
    if not info or info["distance"] >= episode.env.task.tolerance:
        return "precision"
    return "alignment"
