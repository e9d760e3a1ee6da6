"""Both rewards against plain formulas, along real episodes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv
from coop_env.simulation.rewards import PROGRESS_DEFAULTS, TERMS

SMALL: dict[str, Any] = {
    "step_cost": 0.05,
    "distance_scale": 50.0,
    "angle_scale": 15.0,
    "insertion_bonus": 20.0,
    "violation_penalty": 1.0,
}


def error(state: np.void, target: int) -> tuple[float, float]:
    """Distance and angle to a hole, from the state's points alone."""
    distance = float(np.linalg.norm(state["mouths"][target] - state["tip"]))
    return distance, float(np.arccos(min(1.0, state["normals"][target][2])))


def transitions(env: CoopInsertionEnv, episodes: int) -> Iterator[tuple[Any, ...]]:
    """(state, next state, reward, terminated, info) of noisy optimal episodes."""
    rng, oracle = np.random.default_rng(0), LatticeOracle()
    for seed in range(episodes):
        env.reset(seed=seed)
        while not env.state["over"]:
            plan = oracle.plan(env).moves
            moves = [int(plan[0])] if plan is not None else []
            if plan is not None and rng.random() < 0.8:
                moves = plan.tolist()
            for move in [*moves, int(rng.integers(12))]:
                before = env.state
                _, reward, terminated, truncated, info = env.step(move)
                yield before, env.state, reward, terminated, info
                if terminated or truncated:
                    break


def test_paper_is_the_printed_equation() -> None:
    seen = np.zeros(3, int)
    for before, after, reward, _, info in transitions(CoopInsertionEnv(max_moves=200), 6):
        v, z, u = (int(info[name]) for name in ("violation", "inserted", "duplicate"))
        seen += (v, z, u)
        t, n = info["time"], info["n_filled"]
        target = int(before["target"])
        d0, d1 = error(before, target)[0], error(after, target)[0]
        expected = -3 * v + (150 + 25 * n + 80 * (1 - t / 60)) * z - 1 * u
        expected += (1 - v - z - u) * (-0.01 - d1 + 50 * max(d0 - d1, 0) + 200 * max(0.03 - d1, 0))
        assert reward == pytest.approx(expected, abs=1e-9)
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-12)
        assert tuple(info["reward_terms"]) == TERMS
    assert seen.min() > 0


@pytest.mark.parametrize("kwargs", [{}, SMALL, {"gamma": 0.9, "insertion_bonus": 7}])
def test_progress_is_two_sided_and_towards_one_hole(kwargs: dict[str, Any]) -> None:
    env = CoopInsertionEnv(reward="progress", reward_kwargs=kwargs, max_moves=200)
    scale: dict[str, Any] = {**PROGRESS_DEFAULTS, **kwargs}
    violations = 0
    for before, after, reward, terminated, info in transitions(env, 4):
        v, z, u = (int(info[name]) for name in ("violation", "inserted", "duplicate"))
        if v and not info["singular"]:
            np.testing.assert_array_equal(after["configuration"], before["configuration"])
            violations += 1
        target = int(before["target"])
        d0, a0 = error(before, target)
        d1, a1 = error(after, target)
        gamma = 1.0
        if scale["gamma"] is not None:  # the potential of the next state, its own target included
            gamma = scale["gamma"]
            d1, a1 = (0.0, 0.0) if terminated else error(after, int(after["target"]))
        bonus = scale["insertion_bonus"]
        if bonus is None:
            bonus = 150 + 25 * info["n_filled"] + 80 * (1 - info["time"] / 60)
        expected = bonus * z - scale["violation_penalty"] * v - scale["duplicate_penalty"] * u
        expected -= scale["step_cost"] * (1 - v)
        expected += scale["distance_scale"] * (d0 - gamma * d1)
        expected += scale["angle_scale"] * (a0 - gamma * a1)
        assert reward == pytest.approx(expected, abs=1e-6)
    assert violations > 0


def test_the_paper_pays_for_an_oscillation_and_progress_does_not() -> None:
    returns = {}
    for reward in ("paper", "progress"):
        env = CoopInsertionEnv(reward=reward)
        env.reset(seed=0)
        returns[reward] = sum(env.step(5 - k % 2)[1] for k in range(100))  # down and up
    assert returns["paper"] > 0.0 > returns["progress"]


@pytest.mark.parametrize("kwargs", [None, {}, SMALL, {"violation_penalty": 0.0}, {"gamma": 1.0}])
@pytest.mark.parametrize("geometry", ["initial", "optimized"])
def test_a_singularity_ends_the_episode_and_pays_for_every_move_left(
    kwargs: dict[str, Any] | None, geometry: str
) -> None:
    """So it costs no less than going up and down to the end would; under the paper's reward, 3."""
    name = "paper" if kwargs is None else "progress"
    env = CoopInsertionEnv(geometry, name, kwargs, max_moves=80)
    scale: dict[str, Any] = {"violation_penalty": 3.0, "step_cost": 0.0}  # of the paper's
    if kwargs is not None:
        scale = {**PROGRESS_DEFAULTS, **kwargs}
    broken = 0
    for seed in range(40):
        rng, info = np.random.default_rng(seed), {"violation": False}
        env.reset(seed=seed, options={"configuration": (0, 0, -0.27, 0, 0, 0.22)})
        way = rng.choice([6, 7]), rng.choice([8, 9])  # the platform tilts further and further
        while env.running and not info["violation"]:
            _, reward, terminated, _, info = env.step(rng.choice(way))
            assert terminated == info["singular"] == (info["sigma_min"] < 0.05)
        if terminated:
            broken += 1
            assert info["violation"]
            assert not info["inserted"]
            assert env.scene().status == "singular"
            left = 80 - int(env.state["moves"]) + 1
            cost = scale["violation_penalty"] + scale["step_cost"] * left
            assert reward == pytest.approx(-cost)
    assert broken >= 3
