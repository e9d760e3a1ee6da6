"""The exact optimum, in turn and at once: its plans succeed, none shorter does."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv, CoopInsertionJointEnv
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import VALID

COARSE: dict[str, Any] = {
    "task": {"linear_step": 0.05, "angular_step": 0.2, "heave_step": 0.04, "tolerance": 0.025,
             "angle_tolerance": 0.15},
}  # fmt: skip


def executes(env: gymnasium.Env[Any, Any], moves: np.ndarray) -> bool:
    """Whether the moves insert at the last of them and violate nothing."""
    for i, move in enumerate(moves):
        _, _, _, _, info = env.step(move)
        if info["violation"]:
            return False
        if info["inserted"]:
            return i == len(moves) - 1
    return False


def made(at_once: bool, **arguments: Any) -> tuple[Any, LatticeOracle]:
    """An environment whose robots move in turn or at once, and its optimum."""
    env = (CoopInsertionJointEnv if at_once else CoopInsertionEnv)(**arguments)
    return env, LatticeOracle(at_once=at_once)


both = pytest.mark.parametrize("at_once", [False, True], ids=["in turn", "at once"])


@pytest.mark.parametrize("arguments", [{"geometry": "initial"}, {}, {"pose_model": "paper"}])
def test_plans_insert_touch_nothing_and_at_once_are_never_longer(arguments: dict[str, Any]) -> None:
    env, joint_env = CoopInsertionEnv(**arguments), CoopInsertionJointEnv(**arguments)
    oracle, joint = LatticeOracle(), LatticeOracle(at_once=True)
    solved = shorter = 0
    for seed in range(40):
        env.reset(seed=seed)
        joint_env.reset(seed=seed)
        before = env.state.tobytes(), joint_env.state.tobytes()
        plan, ticks, alone = oracle.plan(env), joint.plan(joint_env), oracle.plan(joint_env)
        assert (env.state.tobytes(), joint_env.state.tobytes()) == before
        assert plan.status in ("solved", "infeasible")
        assert plan.status == ticks.status == alone.status
        if plan.moves is None or ticks.moves is None or alone.moves is None:
            continue
        solved += 1
        n = len(plan.moves)
        assert n == len(alone.moves)
        assert (n + 1) // 2 <= len(ticks.moves) <= n
        shorter += len(ticks.moves) < n
        assert executes(env, plan.moves)
        assert executes(joint_env, ticks.moves)
    assert solved >= 30
    assert shorter > solved // 2


def poses_within_reach(env: CoopInsertionEnv) -> list[np.ndarray]:
    """Flood fill of the 3-RRS's lattice in plain Python, with the Delta held high."""
    home = np.array([0.0, 0.0, -0.27, *env.configuration[3:]])
    units = np.vstack([np.eye(6, dtype=int)[3:], -np.eye(6, dtype=int)[3:]])
    seen, queue, poses = {6 * (0,)}, [6 * (0,)], []
    while queue:
        node = queue.pop()
        poses.append(home + np.array(node) * PAPER_TASK.steps)
        for other in (node + units).tolist():
            to = tuple(other)
            there = home + np.array(to) * PAPER_TASK.steps
            if to not in seen and env.configuration_status(there) == VALID:
                seen.add(to)
                queue.append(to)
    return poses


def has_goal(env: CoopInsertionEnv) -> bool:
    """Whether any reachable tilt, with any Delta lattice point, meets the criterion."""
    start, target = env.configuration, int(env.state["target"])
    from_tip = start[:3] - env.state["tip"]
    for pose in poses_within_reach(env):
        _, info = env.reset(options={"configuration": pose, "target": target})
        if info["alignment_error"] < np.radians(5.0):
            effector = env.state["mouths"][target] + from_tip
            nearest = start[:3] + 0.02 * np.round((effector - start[:3]) / 0.02)
            if np.linalg.norm(nearest - effector) < 0.010:
                return True
    return False


def test_infeasible_means_that_no_lattice_point_meets_the_criterion() -> None:
    env, oracle = CoopInsertionEnv(geometry="initial"), LatticeOracle()
    seen = {"solved": 0, "infeasible": 0}
    for seed in range(12):
        env.reset(seed=seed, options={"target": 1})
        status = oracle.plan(env).status
        seen[status] += 1
        assert has_goal(env) == (status == "solved")
    assert min(seen.values()) > 0


@both
def test_a_peg_beside_the_dome_is_led_around_it(at_once: bool) -> None:
    env, oracle = made(at_once)
    start = {"configuration": (0.0, 0.15, -0.53, 0.0, 0.0, 0.22), "target": 4}
    env.reset(options=start)
    plan: Any = oracle.plan(env)
    assert executes(env, plan.moves)
    if not at_once:
        env.reset(options=start)
        sideways_first = sorted(plan.moves, key=lambda move: move // 2 != 1)
        assert not executes(env, np.array(sideways_first))  # that way is through the dome


@both
def test_a_peg_already_in_the_hole_needs_a_move(at_once: bool) -> None:
    env, oracle = made(at_once)
    env.reset(seed=0)
    plan: Any = oracle.plan(env)
    target = int(env.state["target"])
    for move in plan.moves:
        env.step(move)
    env.reset(options={"configuration": env.configuration, "target": target})
    again: Any = oracle.plan(env)
    assert len(again.moves) <= 2
    assert executes(env, again.moves)


@pytest.mark.parametrize(("at_once", "seed", "least"), [(False, 1, 3), (True, 2, 1)])
def test_an_episode_is_planned_hole_after_hole(at_once: bool, seed: int, least: int) -> None:
    env, oracle = made(at_once)
    env.reset(seed=seed)
    made_moves = [plan.moves for plan in oracle.plan_episode(env) if plan.moves is not None]
    assert all(executes(env, moves) for moves in made_moves)
    assert int(env.state["filled"].sum()) == env.state["insertions"] == len(made_moves) >= least


def test_with_sim_to_real_knobs_the_plan_is_the_models() -> None:
    real = CoopInsertionEnv(sim_to_real="randomized")
    twin = CoopInsertionEnv()
    for seed in range(5):
        real.reset(seed=seed)
        plan = LatticeOracle().plan(real)
        start = {"configuration": real.configuration, "target": int(real.state["target"])}
        twin.reset(options=start)
        expected = LatticeOracle().plan(twin)
        assert plan.status == expected.status
        if expected.moves is not None:
            np.testing.assert_array_equal(plan.moves, expected.moves)


def test_the_node_limit_is_told() -> None:
    env = CoopInsertionEnv()
    env.reset(seed=0)
    assert LatticeOracle(node_limit=1).plan(env).status == "node_limit"


def fewest(env: CoopInsertionEnv, moves: np.ndarray, most: int) -> int | None:
    """Breadth-first over configurations, from ``configuration_status`` and ``state`` alone."""
    start, target, probe = env.configuration, int(env.state["target"]), CoopInsertionEnv(**COARSE)
    seen = front = {6 * (0,)}
    for depth in range(1, most + 1):
        reached = {tuple(to) for at in front for to in (at + moves).tolist()} - seen
        seen, front = seen | reached, set()
        for to in reached:
            there = start + np.array(to) * env.task.steps
            if env.configuration_status(there) == VALID:
                front.add(to)
                probe.reset(options={"configuration": there, "target": target})
                if probe.state["inside"][target]:
                    return depth
    return None


@pytest.mark.parametrize(("at_once", "most"), [(False, 7), (True, 4)], ids=["in turn", "at once"])
def test_none_shorter_inserts_on_a_coarse_lattice(at_once: bool, most: int) -> None:
    env, oracle = made(at_once, **COARSE)
    every = np.array([*itertools.product((-1, 0, 1), repeat=6)])
    of_each = np.abs(every.reshape(-1, 2, 3)).sum(2)  # how many joints a robot moves
    moves = every[of_each.max(1) == 1] if at_once else every[of_each.sum(1) == 1]
    lengths = set()
    for seed in range(12):
        env.reset(seed=seed)
        plan = oracle.plan(env)
        if plan.moves is not None and len(plan.moves) <= most:
            lengths.add(len(plan.moves))
            assert fewest(env, moves, most) == len(plan.moves)
            assert executes(env, plan.moves)
    assert len(lengths) > 1
