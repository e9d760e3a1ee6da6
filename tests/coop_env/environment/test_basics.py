"""The environment: checkers, determinism, masks, batch against single, snapshots."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionEnv, CoopInsertionVecEnv
from coop_env.simulation.state import STATE


def rollout(env: CoopInsertionEnv, n: int, seed: int) -> list[tuple[Any, ...]]:
    rng = np.random.default_rng(seed)
    obs, info = env.reset(seed=seed)
    log: list[tuple[Any, ...]] = [(obs.tobytes(), repr(info))]
    for _ in range(n):
        action = rng.choice(np.flatnonzero(env.action_masks()))
        obs, reward, terminated, truncated, info = env.step(action)
        log.append((obs.tobytes(), reward, terminated, truncated, repr(info)))
        if terminated or truncated:
            obs, info = env.reset()
            log.append((obs.tobytes(), repr(info)))
    return log


def test_a_seed_repeats_the_whole_course() -> None:
    assert rollout(CoopInsertionEnv(), 700, 3) == rollout(CoopInsertionEnv(), 700, 3)
    assert rollout(CoopInsertionEnv(), 5, 3) != rollout(CoopInsertionEnv(), 5, 4)


@pytest.mark.parametrize("geometry", ["initial", "optimized"])
def test_masks_equal_a_check_of_each_neighbour(geometry: str) -> None:
    env = CoopInsertionEnv(geometry=geometry)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(400):
        expected = []
        for action in range(12):
            c = env.configuration
            c[action // 2] += env.task.steps[action // 2] * (1 if action % 2 == 0 else -1)
            expected.append(env.configuration_status(c) != 1)
        masks = env.action_masks()
        assert masks.tolist() == (expected if any(expected) else [True] * 12)
        _, _, terminated, truncated, _ = env.step(rng.choice(np.flatnonzero(masks)))
        if terminated or truncated:
            env.reset()


def test_a_move_and_its_reverse_cancel_to_the_last_bit() -> None:
    env = CoopInsertionEnv()
    for seed in range(20):
        env.reset(seed=seed)
        start = env.state
        for action in range(12):
            if not env.action_masks()[action]:
                continue
            _, _, terminated, _, info = env.step(action)
            assert not terminated
            if not info["collision"]:
                env.step(action ^ 1)
        assert env.configuration.tobytes() == start["configuration"].tobytes()
        assert env.state["q"].tobytes() == start["q"].tobytes()


def test_rows_have_no_padding_so_that_bytes_compare() -> None:
    sizes = [STATE[name].itemsize for name in STATE.names or ()]
    assert sum(sizes) == STATE.itemsize


def test_the_stage_changes_at_the_next_reset() -> None:
    batch = CoopInsertionVecEnv(3, seed=0, stage=0)
    batch.reset()
    assert all(state["active"].sum() == 4 for state in batch.get_attr("state"))
    batch.env_method("set_stage", 1)
    assert all(state["active"].sum() == 4 for state in batch.get_attr("state"))
    batch.reset()
    assert all(state["active"].sum() == 6 for state in batch.get_attr("state"))
