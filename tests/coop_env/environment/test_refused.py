"""``mask_refused``: what the real machine refused is not tried again from the same place."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionEnv, SimToReal

MACHINE = SimToReal(base_position_error=0.01, base_tilt_error=math.radians(3.0))
DISPLACED: dict[str, Any] = {"sim_to_real": MACHINE, "mask_singularities": True}


def descend(env: CoopInsertionEnv, rng: np.random.Generator) -> int:
    """An allowed move at random, down more often than not, where collisions are."""
    weights = env.action_masks() * np.where(np.arange(12) == 5, 8.0, 1.0)
    return int(rng.choice(12, p=weights / weights.sum()))


def refusals(env: CoopInsertionEnv, episodes: int) -> tuple[int, int]:
    """Refused moves of a random masked policy, and how many repeat one from the same place."""
    rng = np.random.default_rng(0)
    refused = repeated = 0
    for episode in range(episodes):
        env.reset(seed=episode)
        tried: set[int] = set()
        over = False
        while not over:
            here, allowed = env.configuration, env.action_masks().sum()
            action = descend(env, rng)
            *_, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            if info["violation"] and not info["singular"]:
                assert np.array_equal(env.configuration, here)
                refused += 1
                repeated += action in tried
                # when all that is valid was refused, all of it is allowed again
                tried = {action} | tried if allowed > 1 else set()
            else:
                tried = set()
    return refused, repeated


def test_a_refused_move_is_not_tried_again_from_the_same_configuration() -> None:
    refused, repeated = refusals(CoopInsertionEnv(**DISPLACED), 10)
    assert refused > 50
    assert repeated > 20
    refused, repeated = refusals(CoopInsertionEnv(mask_refused=True, **DISPLACED), 10)
    assert refused > 50
    assert repeated == 0


@pytest.mark.parametrize("visited", [0, 64])
def test_the_mask_is_the_models_less_what_was_refused_here(visited: int) -> None:
    """Against an environment without the option that makes the same moves."""
    env = CoopInsertionEnv(mask_refused=True, mask_visited=visited, **DISPLACED)
    free = CoopInsertionEnv(**DISPLACED)
    rng = np.random.default_rng(1)
    for episode in range(8):
        env.reset(seed=episode)
        free.reset(seed=episode)
        refused = np.zeros(12, bool)
        over = False
        while not over:
            left = free.action_masks() & ~refused
            if not left.any():
                left, refused = free.action_masks(), np.zeros(12, bool)
            mask = env.action_masks()
            assert np.array_equal(mask, left) if visited == 0 else np.all(mask <= left)
            assert mask.any()
            action = descend(env, rng)
            *_, terminated, truncated, info = env.step(action)
            free.step(action)
            over = terminated or truncated
            if info["violation"]:
                refused[action] = True
            else:
                refused[:] = False


def test_when_everything_valid_was_refused_it_is_allowed_again() -> None:
    env = CoopInsertionEnv(mask_refused=True, **DISPLACED)
    env.reset(seed=0)
    snapshot, valid = env.get_state(), env.action_masks()
    rng = np.random.default_rng(0)
    while not env.step(descend(env, rng))[-1]["collision"]:
        snapshot, valid = env.get_state(), env.action_masks()
    action = int(np.flatnonzero(valid & ~env.action_masks())[0])
    # as if all others had been refused before
    snapshot["states"]["refused"] = valid
    snapshot["states"]["refused"][0, action] = 0
    env.set_state(snapshot)
    assert env.step(action)[-1]["collision"]
    assert np.array_equal(env.action_masks(), valid)


def test_a_reset_forgets_and_a_snapshot_remembers() -> None:
    env = CoopInsertionEnv(mask_refused=True, **DISPLACED)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    while not env.step(descend(env, rng))[-1]["collision"]:
        pass
    remembered = env.action_masks()
    snapshot = env.get_state()
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    assert env.state["refused"].sum() > 0
    env.reset(seed=1)
    assert env.state["refused"].sum() == 0
    env.set_state(snapshot)
    for twin in (env, *copies):
        assert np.array_equal(twin.action_masks(), remembered)


def test_on_a_machine_as_modelled_it_changes_nothing_but_what_is_refused() -> None:
    """With masks that know collisions nothing is refused, and the episodes are the same."""
    kwargs: dict[str, Any] = {"mask_singularities": True, "mask_visited": 8}
    env, plain = CoopInsertionEnv(mask_refused=True, **kwargs), CoopInsertionEnv(**kwargs)
    rng = np.random.default_rng(3)
    for seed in range(3):
        assert env.reset(seed=seed)[0].tobytes() == plain.reset(seed=seed)[0].tobytes()
        for _ in range(300):
            assert np.array_equal(env.action_masks(), plain.action_masks())
            action = descend(env, rng)
            ours, theirs = env.step(action), plain.step(action)
            assert ours[0].tobytes() == theirs[0].tobytes()
            assert ours[1:4] == theirs[1:4]
            if ours[2] or ours[3]:
                break
