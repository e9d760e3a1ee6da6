"""What ends a physics task, and that no failure is cheaper than idling until the time is up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")

from coop_env.physics.env import CoopInsertionContactEnv, CoopInsertionPhysicsEnv
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from coop_env.physics.task import ContactTask, start_configurations

PUSH = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
REST = np.zeros(6)
ASIDE: dict[str, Any] = {"hole": 4, "error": [0.0025, 0.0, 0.0, 0.0], "friction": 0.2}


def returns(env: Any, options: dict[str, Any], actions: Any) -> tuple[list[float], dict[str, Any]]:
    """Rewards of an episode under actions, the last of them repeated, and its last info."""
    env.reset(seed=0, options=options)
    rewards, over, k = [], False, 0
    while not over:
        *_, reward, terminated, truncated, info = env.step(actions[min(k, len(actions) - 1)])
        rewards.append(float(reward))
        over, k = terminated or truncated, k + 1
    return rewards, info


def of_contact() -> tuple[Any, dict[str, Any], list[Any], list[Any]]:
    return CoopInsertionContactEnv(), ASIDE, [PUSH], [REST]


def of_contact_in_a_long_episode() -> tuple[Any, dict[str, Any], list[Any], list[Any]]:
    return CoopInsertionContactEnv({"max_steps": 600}), ASIDE, [PUSH], [REST]


def of_the_whole_task() -> tuple[Any, dict[str, Any], list[Any], list[Any]]:
    env = CoopInsertionPhysicsEnv({"position_error": 0.0, "tilt_error": 0.0}, max_steps=600)
    start = start_configurations(env.batch.machine, env.task.start_height)[4]
    start += [0.0, 0.02, 0.0, 0.0, 0.0, 0.0]
    return env, {"configuration": start, "target": 4}, [PUSH], [REST]


def of_the_moves() -> tuple[Any, dict[str, Any], list[Any], list[Any]]:
    level = {"position_error": 0.0, "tilt_error": 0.0, "force_limit": 15.0}
    env = CoopInsertionPhysicsDiscreteEnv(level=level, touch=1e3, reward="progress", max_moves=40)
    start = start_configurations(env.physics.machine, 0.03)[4]
    start += [0.0, 0.02, 0.0, 0.0, 0.0, 0.0]
    return env, {"configuration": start, "target": 4}, [5], [4, 5] * 20


@pytest.mark.parametrize(
    "make", [of_contact, of_contact_in_a_long_episode, of_the_whole_task, of_the_moves]
)
def test_a_failure_costs_at_least_what_idling_to_the_end_costs(make: Any) -> None:
    env, options, breaking, idling = make()
    failed, end = returns(env, options, breaking)
    assert end["failure"] in ("force", "snap")
    idle, rest = returns(env, options, idling)
    assert rest["failure"] == "time"
    n = len(failed)
    assert failed[-1] <= sum(idle[n - 1 :]) + 1e-9  # before, both may do the same


def test_the_force_limit_is_of_the_peak_and_not_of_a_mean() -> None:
    free = CoopInsertionContactEnv({"force_limit": 1e4, "snap_angle": 1.0})
    free.reset(seed=0, options=ASIDE)
    peaks, means, over = [0.0], [0.0], False
    while not over and len(peaks) < 20:
        *_, terminated, truncated, info = free.step(PUSH)
        peaks.append(info["peak_force"])
        means.append(float(np.linalg.norm(info["force"])))
        over = terminated or truncated
    first = next(k for k in range(len(peaks)) if peaks[k] > 1.0)  # where it meets the rim
    assert peaks[first] > 1.2 * means[first]
    limit = 0.5 * (peaks[first] + means[first])
    strict = CoopInsertionContactEnv({"force_limit": limit})
    rewards, end = returns(strict, ASIDE, [PUSH])
    assert end["failure"] == "force"
    assert len(rewards) == first
    assert end["reward_terms"]["force"] == pytest.approx(
        -0.02 * max(0.0, peaks[first] - ContactTask().free_force)
    )


def test_depth_beyond_the_required_one_pays_nothing() -> None:
    """One step from just above the required depth to far below it pays no more than to it."""
    fast = CoopInsertionContactEnv({"depth_step": 0.01})
    fast.reset(seed=0, options={"hole": 4, "error": [0.0] * 4})
    paid, over = 0.0, False
    while not over:
        *_, terminated, truncated, info = fast.step(PUSH)
        paid += info["reward_terms"]["depth"]
        over = terminated or truncated
    assert info["success"]
    assert info["depth"] > 0.0105
    assert paid == pytest.approx(1000.0 * 0.02, abs=1e-6)
