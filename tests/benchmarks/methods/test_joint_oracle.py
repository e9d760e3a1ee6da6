"""The fewest ticks when both robots move at once: executed, and none fewer by brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionJointEnv
from coop_env.simulation.state import INVALID, VALID
from tests.benchmarks.methods.test_oracle import executes

Offset = tuple[int, ...]


@pytest.mark.parametrize("geometry", ["initial", "optimized"])
def test_plans_insert_in_the_environment_and_are_never_longer(geometry: str) -> None:
    env = CoopInsertionJointEnv(geometry=geometry)
    joint, single = LatticeOracle(at_once=True), LatticeOracle()
    solved = shorter = 0
    for seed in range(40):
        env.reset(seed=seed)
        before = env.state.tobytes()
        plan, sequence = joint.plan(env), single.plan(env)
        assert env.state.tobytes() == before
        assert plan.status == sequence.status
        if plan.moves is None or sequence.moves is None:
            continue
        solved += 1
        n = len(plan.moves)
        assert (len(sequence.moves) + 1) // 2 <= n <= len(sequence.moves)
        shorter += n < len(sequence.moves)
        assert executes(env, plan.moves)
    assert solved >= 30
    assert shorter > solved // 2


def fewest_ticks(env: CoopInsertionJointEnv, most: int) -> int | None:
    """Breadth-first over configurations, from ``configuration_status`` and ``state`` alone."""
    start, steps = env.state["start"], np.array(env.task.steps)
    target = int(env.state["target"])
    axes = np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int), np.zeros((1, 3), int)])
    ticks = [np.concatenate(pair) for pair in itertools.product(axes, axes)]
    probe = CoopInsertionJointEnv(task=env.task)
    status: dict[Offset, int] = {}
    here: Offset = tuple(env.state["offset"].tolist())
    seen, front = {here}, [here]
    for depth in range(1, most + 1):
        reached = []
        for at, tick in itertools.product(front, ticks):
            to: Offset = tuple((np.array(at) + tick).tolist())
            if to == at or (to in seen and depth > 2):
                continue
            c = start + np.array(to) * steps
            if to not in status:
                status[to] = env.configuration_status(c)
            if status[to] != VALID:
                assert status[to] >= INVALID
                continue
            if to not in seen:
                seen.add(to)
                reached.append(to)
            probe.reset(options={"configuration": c, "target": target})
            if probe.state["inside"][target]:
                return depth
        front = reached
    return None


COARSE = {"linear_step": 0.05, "angular_step": 0.2, "heave_step": 0.04, "tolerance": 0.025}


@pytest.mark.slow
def test_no_fewer_ticks_insert_on_a_coarse_lattice() -> None:
    task = {**COARSE, "angle_tolerance": 0.15}
    env, oracle = CoopInsertionJointEnv(task=task), LatticeOracle(at_once=True)
    lengths = []
    for seed in range(12):
        env.reset(seed=seed)
        plan = oracle.plan(env)
        if plan.moves is not None and len(plan.moves) <= 4:
            lengths.append(len(plan.moves))
            assert fewest_ticks(env, 4) == lengths[-1]
            assert executes(env, plan.moves)
    assert len(set(lengths)) > 1


def test_no_fewer_ticks_insert_near_the_goal() -> None:
    env, oracle = CoopInsertionJointEnv(), LatticeOracle(at_once=True)
    for seed in range(3):
        env.reset(seed=seed)
        plan = oracle.plan(env)
        assert plan.moves is not None
        for action in plan.moves[:-2]:
            env.step(action)
        rest = oracle.plan(env)
        assert rest.moves is not None
        assert len(rest.moves) == fewest_ticks(env, 2) == 2


def test_a_peg_beside_the_dome_is_led_around_it() -> None:
    """Where the straight way collides, the joint plan goes around, and inserts."""
    env, oracle = CoopInsertionJointEnv(), LatticeOracle(at_once=True)
    env.reset(options={"configuration": (0.0, 0.15, -0.53, 0.0, 0.0, 0.22), "target": 4})
    plan = oracle.plan(env)
    assert plan.moves is not None
    assert executes(env, plan.moves)


def test_a_peg_already_in_the_hole_needs_a_tick() -> None:
    env, oracle = CoopInsertionJointEnv(), LatticeOracle(at_once=True)
    env.reset(seed=0)
    plan = oracle.plan(env)
    assert plan.moves is not None
    target = int(env.state["target"])
    for action in plan.moves:
        env.step(action)
    env.reset(options={"configuration": env.configuration, "target": target})
    again = oracle.plan(env)
    assert again.moves is not None
    assert len(again.moves) <= 2
    assert executes(env, again.moves)


def test_an_episode_is_planned_hole_after_hole() -> None:
    env = CoopInsertionJointEnv()
    env.reset(seed=2)
    plans = LatticeOracle(at_once=True).plan_episode(env)
    filled = 0
    for plan in plans:
        if plan.moves is not None:
            assert executes(env, plan.moves)
            filled += 1
    assert filled == env.state["insertions"] > 0
