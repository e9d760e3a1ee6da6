"""The environment: checkers, determinism, masks, batch against single, snapshots."""

from __future__ import annotations

import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import coop_env
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


def test_checkers_accept_the_registered_environment() -> None:
    env = gym.make("CoopInsertion-v0").unwrapped
    gymnasium_check(env, skip_render_check=True)
    sb3_check(env)


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


def test_batch_is_bit_identical_to_single_environments() -> None:
    n, seed = 5, 11
    batch = CoopInsertionVecEnv(n, seed=seed, reward="progress", max_moves=40)
    singles = [CoopInsertionEnv(reward="progress", max_moves=40) for _ in range(n)]
    observations = batch.reset()
    for i, env in enumerate(singles):
        assert observations[i].tobytes() == env.reset(seed=seed + i)[0].tobytes()
    rng = np.random.default_rng(0)
    for _ in range(300):
        actions = rng.integers(12, size=n)
        observations, rewards, dones, infos = batch.step(actions)
        masks = batch.env_method("action_masks")
        for i, env in enumerate(singles):
            obs, reward, terminated, truncated, info = env.step(actions[i])
            assert rewards[i] == np.float32(reward)
            assert dones[i] == (terminated or truncated)
            assert {k: infos[i][k] for k in info} == info
            if dones[i]:
                assert infos[i]["TimeLimit.truncated"] == truncated
                assert infos[i]["terminal_observation"].tobytes() == obs.tobytes()
                assert infos[i]["terminal_action_mask"].tolist() == env.action_masks().tolist()
                obs, _ = env.reset()
            assert observations[i].tobytes() == obs.tobytes()
            assert masks[i].tolist() == env.action_masks().tolist()


def test_a_snapshot_resumes_exactly() -> None:
    batch = CoopInsertionVecEnv(4, seed=0)
    batch.reset()
    rng = np.random.default_rng(0)
    moves = rng.integers(12, size=(200, 4))
    for actions in moves[:50]:
        batch.step(actions)
    snapshot = pickle.loads(pickle.dumps(batch.get_state()))
    expected = [batch.step(actions)[:3] for actions in moves[50:]]
    other = CoopInsertionVecEnv(4, seed=99)
    other.reset()
    other.set_state(snapshot)
    for actions, (obs, rewards, dones) in zip(moves[50:], expected, strict=True):
        got = other.step(actions)
        assert got[0].tobytes() == obs.tobytes()
        assert got[1].tobytes() == rewards.tobytes()
        assert got[2].tolist() == dones.tolist()


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


def test_the_package_names_what_it_offers() -> None:
    for name in coop_env.__all__:
        assert getattr(coop_env, name) is not None
