"""The exact optimum, in turn and at once: its plans succeed, none shorter does."""

import itertools
from collections import deque
from typing import Any

import gymnasium
import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv, CoopInsertionJointEnv
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import INVALID, VALID

Offset = tuple[int, ...]


def executes(env: gymnasium.Env[Any, Any], moves: np.ndarray) -> bool:
    """Whether the moves insert at the last of them and violate nothing."""
    for i, move in enumerate(moves):
        _, _, _, _, info = env.step(move)
        if info["violation"]:
            return False
        if info["inserted"]:
            return i == len(moves) - 1
    return False


def made(at_once: bool) -> tuple[Any, LatticeOracle]:
    """An environment whose robots move in turn or at once, and its optimum."""
    env = CoopInsertionJointEnv() if at_once else CoopInsertionEnv()
    return env, LatticeOracle(at_once=at_once)


both = pytest.mark.parametrize("at_once", [False, True], ids=["in turn", "at once"])


@pytest.mark.parametrize("arguments", [{"geometry": "initial"}, {}, {"pose_model": "paper"}])
def test_plans_insert_leave_all_as_it_was_and_at_once_are_never_longer(
    arguments: dict[str, Any],
) -> None:
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


def test_no_shorter_sequence_inserts() -> None:
    env, oracle = CoopInsertionEnv(), LatticeOracle()
    for seed in range(6):
        env.reset(seed=seed)
        plan = oracle.plan(env)
        if plan.moves is None:
            continue
        for move in plan.moves[:-4]:
            env.step(move)
        near = env.get_state()
        rest: Any = oracle.plan(env)
        assert len(rest.moves) == 4
        for shorter in itertools.product(range(12), repeat=3):
            env.set_state(near)
            inserted = False
            for move in shorter:
                if env.state["over"]:
                    break
                inserted |= env.step(move)[4]["inserted"]
            assert not inserted


def poses_within_reach(env: CoopInsertionEnv) -> list[np.ndarray]:
    """Flood fill of the 3-RRS's lattice in plain Python, with the Delta held high."""
    start = env.configuration
    start[:3] = (0.0, 0.0, -0.27)
    seen: set[tuple[int, ...]] = {(0, 0, 0)}
    queue: deque[tuple[int, ...]] = deque(seen)
    poses = []
    while queue:
        node = queue.popleft()
        poses.append(start[3:] + np.array(node) * PAPER_TASK.steps[3:])
        for axis, sign in itertools.product(range(3), (1, -1)):
            other = tuple(n + sign * (k == axis) for k, n in enumerate(node))
            c = start.copy()
            c[3:] += np.array(other) * PAPER_TASK.steps[3:]
            if other not in seen and env.configuration_status(c) == 0:
                seen.add(other)
                queue.append(other)
    return poses


def has_goal(env: CoopInsertionEnv) -> bool:
    """Whether any reachable tilt, with any Delta lattice point, meets the criterion."""
    start, target = env.configuration, int(env.state["target"])
    for roll, pitch, heave in poses_within_reach(env):
        nx, ny = np.sin(pitch), -np.sin(roll) * np.cos(pitch)
        nz = np.cos(roll) * np.cos(pitch)
        k = 1.0 / (1.0 + nz)
        rotation = np.array([
            [1 - k * nx * nx, -k * nx * ny, nx],
            [-k * nx * ny, 1 - k * ny * ny, ny],
            [-nx, -ny, nz],
        ])  # fmt: skip
        normal = rotation @ PAPER_TASK.hole_normals[target]
        if np.arccos(normal[2]) >= np.radians(5.0):
            continue
        rp = env.params.rrs.platform_radius
        centre = np.array([rp * k * (ny * ny - nx * nx) / 2, rp * k * nx * ny, heave])
        effector = centre + PAPER_TASK.dome_radius * normal + [0.0, 0.0, 0.08 - 0.85]
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
