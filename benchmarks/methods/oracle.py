"""The exact optimum on the lattice of moves: ceiling of success, floor of time for every method."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods import lattice_search as search
from benchmarks.methods.base import Plan
from benchmarks.methods.lattice_search import Lattice
from coop_env.simulation import dynamics, joint
from coop_env.simulation.state import OUTCOME, VALID, aim
from coop_env.simulation.task import N_ACTIONS, EnvParams


class LatticeOracle:
    """Shortest feasible move sequence to an insertion in the current target.

    Workspaces, joint limits, collisions and singularities are the environment's own kernels', so a
    plan's moves succeed in it, and no sequence of fewer does. Every plan is run through the
    environment's step kernel on a copy of the state before it is returned.

    Args:
        node_limit: pairs of lattice nodes to expand before giving up with ``"node_limit"``.
        real: with sim-to-real knobs, plan on the real machine, which nobody else knows, and not on
            its model. Exact where the base is displaced and the joints are coarse, without
            backlash, latency and luck.
        at_once: both robots move in each tick, as in ``CoopInsertionJoint-v0``: the fewest ticks
            instead of the fewest moves, and a plan of joint actions. Never longer than the
            sequence of single moves, which is one of the plans that it has to choose from.
    """

    def __init__(
        self, node_limit: int = 2_000_000, real: bool = False, at_once: bool = False
    ) -> None:
        if node_limit < 1:
            raise ValueError(f"node_limit = {node_limit!r}: must be at least 1")
        self.node_limit, self.real, self.at_once = node_limit, real, at_once
        self._lattice: Lattice | None = None

    def plan(self, env: Any) -> Plan:
        """Plan from the environment's current state, without changing it.

        Returns:
            ``"solved"`` with the moves, ``"infeasible"`` if no sequence of moves inserts, or
            ``"node_limit"``; ``"inexact"`` if a real machine does not do as planned. With
            sim-to-real knobs the plan is the nominal model's, as any planner's would be, unless
            the oracle is of the real one. ``detail`` has ``length``, ``expanded`` (pairs),
            ``goals`` (lattice points that meet the criterion) and ``bound`` (moves if nothing
            collided).
        """
        return self._plan(*self._known(env))

    def plan_episode(self, env: Any) -> list[Plan]:
        """One plan per hole, each from where the last one ends, until the holes or moves run out.

        Optimal hole by hole, as the environment itself chooses the next target; ``env`` is not
        changed. The last plan has no moves if it failed: ``"timeout"`` if it is too long for the
        moves left.
        """
        state, p = self._known(env)
        plans: list[Plan] = []
        while not state["over"]:
            plan = self._plan(state, p)
            if plan.moves is not None and len(plan.moves) > p.task.max_moves - state["moves"]:
                plan = Plan("timeout", None, plan.seconds, plan.detail)
            plans.append(plan)
            if plan.moves is None:
                break
            self._execute(state, plan.moves, p)
        return plans

    def _known(self, env: Any) -> tuple[Any, EnvParams]:
        state, p = env.unwrapped.state, env.unwrapped.params
        return (state, p) if self.real else _nominal(state, p)

    def _plan(self, state: Any, p: EnvParams) -> Plan:
        began = time.perf_counter()
        lattice = self._lattice_of(state, p)
        source = int(search.point_at(lattice, state["offset"].astype(np.int64)))
        target = int(state["target"])
        goals = search.goals(lattice, target)
        to_delta, to_rrs, bound = _distances(lattice, goals, source, self.at_once)
        detail: dict[str, Any] = {"goals": len(goals), "expanded": 0}
        length = search.INFEASIBLE
        if len(to_delta):
            # Untouched pages of a large zeroed array cost nothing.
            came_by = np.zeros(lattice.delta_free.size * lattice.rrs_free.size, np.uint8)
            jumps = search.joint_jumps(lattice) if self.at_once else search.single_jumps(lattice)
            length, point, detail["expanded"], _ = search.a_star(
                lattice, source, to_delta, to_rrs, came_by, self.node_limit, jumps
            )
            detail["bound"] = bound
        if bound == 0 and not 0 < length <= 2:
            # Already in the hole, but only a move can insert: one there and one back.
            moves, length = self._there_and_back(state, p)
        elif length > 0:
            moves = search.trace_back(point, length, came_by, jumps)
        if length < 0:
            status = "node_limit" if length == search.NODE_LIMIT else "infeasible"
            return Plan(status, None, time.perf_counter() - began, detail)
        detail["length"] = int(length)
        if not self._execute(state.copy(), moves, p):
            if p.task.imperfect:
                return Plan("inexact", None, time.perf_counter() - began, detail)
            raise RuntimeError(
                f"the plan for hole {target} does not insert in the environment's own kernel: "
                "the search and the environment disagree (a defect, please report it)"
            )
        return Plan("solved", moves, time.perf_counter() - began, detail)

    def _lattice_of(self, state: Any, p: EnvParams) -> Lattice:
        """The lattice of the state's episode, made anew where the last one was another's."""
        known = self._lattice
        start, machine = state["start"], state["machine"]
        if (
            known is None
            or p is not known.p
            or np.any(known.start != start)
            or (p.task.imperfect and np.any(known.machine["base"] != machine["base"]))
        ):
            real = machine if p.task.imperfect else None
            known = self._lattice = search.make_lattice(np.array(start), p, real)
        return known

    def _there_and_back(self, state: Any, p: EnvParams) -> tuple[NDArray[np.int64], int]:
        for action in range(N_ACTIONS):
            there, back = action, action ^ 1
            if self.at_once:
                there, back = joint.as_joint(there), joint.as_joint(back)
            moves = np.array([there, back])
            if self._execute(state.copy(), moves, p):
                return moves, 2
        return moves, search.INFEASIBLE

    def _execute(self, state: Any, moves: NDArray[np.int64], p: EnvParams) -> bool:
        """Run moves through the step kernel on ``state``; True if exactly the last one inserts.

        The kernel does not look at ``over``, so a plan longer than the moves left is run to its
        end.
        """
        step = joint.step if self.at_once else dynamics.step
        outcome = np.zeros(1, OUTCOME)
        inserted = False
        for move in moves:
            if inserted:
                return False
            step(state, int(move), p, outcome[0])
            if outcome["violation"][0]:
                return False
            inserted = bool(outcome["inserted"][0])
        return inserted


def _distances(
    lattice: Lattice, goals: NDArray[np.int64], source: int, at_once: bool
) -> tuple[NDArray[np.int32], NDArray[np.int32], int]:
    """Distances (goals, nodes) to the goals that both robots can reach, and the lower bound."""
    n_rrs = lattice.rrs_free.size
    maps: list[tuple[NDArray[np.int32], NDArray[np.int64]]] = []
    for numbers, free, strides in (
        (goals // n_rrs, lattice.delta_free, lattice.strides[:3] // n_rrs),
        (goals % n_rrs, lattice.rrs_free, lattice.strides[3:]),
    ):
        nodes, inverse = np.unique(numbers, return_inverse=True)
        table = np.empty((len(nodes), free.size), np.int32)
        for row, node in enumerate(nodes):
            search.distances(free, strides, int(node), table[row])
        maps.append((table, inverse))
    (delta, delta_row), (rrs, rrs_row) = maps
    near = delta[delta_row, source // n_rrs] + rrs[rrs_row, source % n_rrs] < search.UNREACHED
    to_delta, to_rrs = delta[delta_row[near]], rrs[rrs_row[near]]
    bound = search.lower_bound(source, to_delta, to_rrs, at_once) if near.any() else -1
    return to_delta, to_rrs, int(bound)


def _nominal(state: Any, p: EnvParams) -> tuple[Any, EnvParams]:
    """The state and parameters as the controller's model has them."""
    if not p.task.imperfect:
        return state, p
    p = p._replace(task=p.task._replace(imperfect=False))
    twin = np.zeros(1, state.dtype)[0]
    at = tuple(state["configuration"].tolist())
    status = dynamics.begin(twin, at, state["active"], state["filled"], p)
    if status != VALID:  # only the real machine can stand here
        raise ValueError("the model takes this state for a collision or singular: reset first")
    aim(twin, int(state["target"]))
    twin["moves"] = state["moves"]
    return twin, p
