"""What ends an episode, what counts as an insertion, and what a move does to the state."""

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv


@pytest.mark.parametrize(
    "task", [{}, {"tolerance": 0.008}, {"angle_tolerance": math.radians(3.0)}], ids=str
)
def test_the_criterion_holds_exactly_when_an_insertion_is_reported(task: dict[str, Any]) -> None:
    """Distance and angle; the target is then the nearest open hole."""
    env = CoopInsertionEnv(task=task)
    rng = np.random.default_rng(0)
    near = insertions = 0
    for seed in range(40):
        _, info = env.reset(seed=seed)
        assert not any(info[key] for key in ("success", "is_success", "all_filled"))
        plan = LatticeOracle().plan(env).moves
        if plan is None:
            continue
        for move in plan[:-1]:
            env.step(move)
        n_before = 0
        for _ in range(40):
            target = int(env.state["target"])
            was_filled = env.state["filled"][target]
            action = int(plan[-1]) if rng.random() < 0.3 else int(rng.integers(12))
            _, _, terminated, _, info = env.step(action)
            state = env.state
            distances = np.linalg.norm(state["mouths"] - state["tip"], axis=1)
            angle = np.arccos(state["normals"][target][2])
            assert info["distance"] == pytest.approx(distances[target])
            assert info["alignment_error"] == pytest.approx(angle)
            meets = distances[target] < env.task.tolerance and angle < env.task.angle_tolerance
            assert info["inserted"] == (meets and not info["violation"] and not was_filled)
            assert info["inserted_hole"] == (target if info["inserted"] else -1)
            n_before += info["inserted"]
            assert (info["n_filled"], info["success"]) == (n_before, n_before > 0)
            assert info["is_success"] == info["success"]
            if not info["singular"]:
                assert info["all_filled"] == terminated == (n_before == 6)
            if info["inserted"] and not terminated:
                distances[state["filled"] == 1] = np.inf
                assert info["target"] == state["target"] == np.argmin(distances)
                assert env.scene().status == "running"
            near += int(meets)
            if terminated:
                break
        insertions += n_before
    assert near > 5
    assert insertions > 3


@pytest.mark.parametrize("reward", ["paper", "progress"])
def test_a_collision_is_refused_or_ends_the_episode_in_failure(reward: str) -> None:
    """Both environments go the same way until the first collision, where one of them ends."""
    refusing, fatal = (
        CoopInsertionEnv(reward=reward, collision=how) for how in ("refuse", "terminate")
    )
    rng = np.random.default_rng(0)
    ends = 0
    for seed in range(20):
        for env in (refusing, fatal):
            env.reset(seed=seed)
        for _ in range(300):
            # downwards more often than not: what is below is the dome
            action = 5 if rng.random() < 0.5 else int(rng.integers(12))
            before = refusing.state
            observed, paid, over, cut, info = refusing.step(action)
            there, charged, ended, _, other = fatal.step(action)
            assert observed.tolist() == there.tolist()
            assert other["collision"] == info["collision"]
            if info["collision"]:
                assert ended
                assert not over
                assert not fatal.running
                assert fatal.scene().status == "collision"
                last = CoopInsertionEnv(collision="terminate", max_moves=1)
                last.reset(options={"configuration": before["configuration"]})
                assert last.step(action)[2:4] == (True, False)
                assert last.scene().status == "collision"
                assert refusing.configuration.tolist() == before["configuration"].tolist()
                left = 300 - int(before["moves"])
                assert charged == pytest.approx(paid if reward == "paper" else -3.0 - 0.5 * left)
                ends += 1
                break
            assert (ended, charged) == (over, paid)
            if over or cut:
                break
    assert ends > 10
