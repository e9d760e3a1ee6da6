"""Planners on a machine that stands elsewhere than their model."""

import math
from collections import Counter
from functools import partial
from typing import Any

import numpy as np
import pytest

from benchmarks.evaluation.evaluate import begin_episodes, follow
from benchmarks.methods.base import Plan
from benchmarks.methods.episodes import Episode
from benchmarks.methods.lattice_search import make_lattice
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.replanning import Replanner, solutions
from benchmarks.methods.rrt_connect import RRTConnect, execute
from benchmarks.protocol.presets import PlannerSettings
from coop_env import CoopInsertionEnv, SimToReal

STARTS = 12
UNSURE: dict[str, Any] = {"base_position_error": 0.003, "base_tilt_error": math.radians(1.0)}


def play(planner: Any, sim_to_real: dict[str, Any] | None) -> list[Episode]:
    knobs = SimToReal(**sim_to_real) if sim_to_real else None
    episodes = begin_episodes({"reward": "progress", "sim_to_real": knobs}, 0, STARTS, "validate")
    for episode in episodes:
        planner(episode)
    return episodes


def rate(episodes: list[Episode]) -> float:
    return float(np.mean([bool(episode.insertions) for episode in episodes]))


def optimum(real: bool) -> Any:
    oracle = LatticeOracle(real=real)
    return lambda episode: follow(episode, oracle.plan)


@pytest.mark.slow
def test_on_the_machine_that_is_modelled_the_plan_is_the_optimums() -> None:
    best = play(optimum(False), None)
    for searches in (False, True):
        ours = play(Replanner(searches, 2_000_000).play, None)
        assert [e.insertions[:1] for e in ours] == [e.insertions[:1] for e in best]
        assert all(e.collisions == 0 for e in ours)


@pytest.mark.slow
def test_who_searches_finds_what_a_plan_alone_does_not() -> None:
    plan = play(Replanner(False, 2_000_000).play, UNSURE)
    result = play(Replanner(True, 2_000_000).play, UNSURE)
    ceiling = play(optimum(True), UNSURE)
    assert rate(plan) + 0.1 < rate(result) <= rate(ceiling)
    assert rate(play(optimum(False), UNSURE)) < rate(ceiling)
    # who knows the machine is not refused, and gets there first
    assert all(e.violations == 0 and e.failure != "inexact" for e in ceiling)
    for best, ours in zip(ceiling, result, strict=True):
        if ours.insertions:
            assert best.insertions[0] <= ours.insertions[0]


def test_a_refused_move_is_not_tried_again() -> None:
    tried: Counter[tuple[int, bytes, int]] = Counter()

    class Watched(Episode):
        def move(self, action: int) -> dict[str, Any]:
            here = self.env.state["offset"].tobytes()
            info = super().move(action)
            if info["violation"]:
                tried[self.number, here, action] += 1
            return info

    far: dict[str, Any] = {name: 3.0 * bound for name, bound in UNSURE.items()}
    for episode in begin_episodes({"sim_to_real": SimToReal(**far)}, 0, STARTS, "validate"):
        watched = Watched(episode.env, episode.number, episode.reset_seed)
        Replanner(True, 2_000_000).play(watched)
    assert len(tried) > 5
    # only what everything else has been tried before is tried once more
    assert sum(count > 1 for count in tried.values()) <= 0.2 * len(tried)


def test_rings_are_searched_from_the_inside() -> None:
    (episode,) = begin_episodes({"sim_to_real": SimToReal(**UNSURE)}, 0, 1, "validate")
    p = episode.env.params
    model = p._replace(task=p.task._replace(imperfect=False))
    lattice = make_lattice(np.array(episode.env.state["start"]), model)
    inner, none = solutions(lattice, 0, 1.0)
    points, rings = solutions(lattice, 0, 2.0)
    assert none.max() == 0
    assert set(inner) == set(points[rings == 0])
    assert rings.max() == 4
    assert len(points) > 5 * len(inner)


def test_rrt_connect_plans_again_where_a_plan_did_not_insert() -> None:
    """Beside who does not, with the same first plans: OMPL's draws follow those before."""
    rrt, first = RRTConnect(PlannerSettings(time_limit=100.0)), dict[int, Plan]()

    def play_one(episode: Episode, again: bool) -> None:
        def plan(env: CoopInsertionEnv) -> Plan:
            if episode.moves:
                return rrt.plan(env)
            if episode.number not in first:
                first[episode.number] = rrt.plan(env)
            return first[episode.number]

        execute(episode, plan, again=again)

    once, again = (play(partial(play_one, again=each), UNSURE) for each in (False, True))
    assert rate(again) > rate(once)


def test_the_real_optimum_says_when_a_machine_does_not_do_as_planned() -> None:
    """With backlash no configuration says where the joints are."""
    failures = Counter(e.failure for e in play(optimum(True), {"backlash": 0.02}))
    assert failures["inexact"] > 0
    assert set(failures) <= {"", "infeasible", "inexact"}
