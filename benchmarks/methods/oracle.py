"""The exact optimum on the lattice of moves: ceiling of success, floor of time for every method."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods import lattice_search as search
from benchmarks.methods.base import Plan, modelled
from benchmarks.methods.lattice_search import Paths
from coop_env.simulation import dynamics, joint
from coop_env.simulation.state import OUTCOME, VALID, aim
from coop_env.simulation.task import N_ACTIONS, EnvParams


class LatticeOracle:
    """Shortest feasible move sequence to an insertion in the current target.

    Limits, collisions and singularities are the environment's own kernels', so a plan's moves
    succeed in it, and no sequence of fewer does. Each plan is tried on a copy of the state.

    Args:
        node_limit: pairs of lattice nodes to expand before giving up with ``"node_limit"``.
        real: with sim-to-real knobs, plan on the real machine, which nobody else knows, not on its
            model. Exact where the base is displaced and the joints are coarse, without backlash,
            latency and chance.
        at_once: both robots move in each tick, as in ``CoopInsertionJoint-v0``: the fewest ticks,
            and a plan of joint actions.
    """

    def __init__(
        self, node_limit: int = 2_000_000, real: bool = False, at_once: bool = False
    ) -> None:
        self.node_limit, self.real, self.at_once = node_limit, real, at_once
        self._paths: Paths | None = None

    def plan(self, env: Any) -> Plan:
        """Plan from the environment's current state, without changing it.

        Returns:
            ``"solved"`` with the moves, ``"infeasible"`` if no sequence of moves inserts, or
            ``"node_limit"``; ``"inexact"`` if a real machine does not do as planned.
        """
        return self._plan(*self._known(env))

    def plan_episode(self, env: Any) -> list[Plan]:
        """One plan per hole, each from where the last one ends, without changing ``env``.

        The last has no moves if it failed: ``"timeout"`` if it is too long for the moves left.
        """
        state, p = self._known(env)
        plans: list[Plan] = []
        while not state["over"]:
            plan = self._plan(state, p)
            if plan.moves is not None and len(plan.moves) > p.task.max_moves - state["moves"]:
                plan = Plan("timeout", None, plan.seconds)
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
        paths, target = self._paths_of(state, p), int(state["target"])
        source = int(search.point_at(paths.lattice, state["offset"].astype(np.int64)))
        length, bound, moves = paths.between(source, search.goals(paths.lattice, target))
        if bound == 0 and not 0 < length <= 2:
            # Already in the hole, but only a move can insert: one there and one back.
            moves, length = self._there_and_back(state, p)
        status = "solved"
        if length < 0:
            status = "node_limit" if length == search.NODE_LIMIT else "infeasible"
        elif not self._execute(state.copy(), moves, p):
            if not p.task.imperfect:
                raise RuntimeError(
                    f"the plan for hole {target} does not insert in the environment's own kernel: "
                    "the search and the environment disagree (a defect, please report it)"
                )
            status = "inexact"
        return Plan(status, moves if status == "solved" else None, time.perf_counter() - began)

    def _paths_of(self, state: Any, p: EnvParams) -> Paths:
        """Paths on the lattice of the state's episode, made anew where the last was another's."""
        known, machine = self._paths, state["machine"]
        if (
            known is None
            or p is not known.lattice.p
            or np.any(known.lattice.start != state["start"])
            or (p.task.imperfect and np.any(known.lattice.machine["base"] != machine["base"]))
        ):
            real = machine if p.task.imperfect else None
            lattice = search.make_lattice(np.array(state["start"]), p, real)
            known = self._paths = Paths(lattice, self.node_limit, self.at_once)
        return known

    def _there_and_back(self, state: Any, p: EnvParams) -> tuple[NDArray[np.int64], int]:
        for action in range(N_ACTIONS):
            moves = np.array([action, action ^ 1])
            if self.at_once:
                moves = np.array([joint.as_joint(int(move)) for move in moves])
            if self._execute(state.copy(), moves, p):
                return moves, 2
        return moves, search.INFEASIBLE

    def _execute(self, state: Any, moves: NDArray[np.int64], p: EnvParams) -> bool:
        """Make moves on ``state``, even beyond its limit; True if exactly the last one inserts."""
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


def _nominal(state: Any, p: EnvParams) -> tuple[Any, EnvParams]:
    """The state and parameters as the controller's model has them."""
    if not p.task.imperfect:
        return state, p
    p = modelled(p)
    twin = np.zeros(1, state.dtype)[0]
    at = tuple(state["configuration"].tolist())
    if dynamics.begin(twin, at, state["active"], state["filled"], p) != VALID:
        # only the real machine can stand here
        raise ValueError("the model takes this state for a collision or singular: reset first")
    aim(twin, int(state["target"]))
    twin["moves"] = state["moves"]
    return twin, p
