"""The batch under the shield's masks: those of the wrapper, row by row."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionEnv
from coop_env.errors import ArgumentError
from coop_env.shield import ShieldedInsertionEnv, ShieldedInsertionVecEnv, ShieldWrapper

ARGUMENTS: dict[str, Any] = {"reward": "progress", "mask_singularities": True}


def test_masks_are_the_wrappers_on_the_way() -> None:
    rng = np.random.default_rng(0)
    batch = ShieldedInsertionVecEnv(3, seed=10, **ARGUMENTS)
    alone = [ShieldWrapper(CoopInsertionEnv(**ARGUMENTS)) for _ in range(3)]
    batch.reset()
    for number, env in enumerate(alone):
        env.reset(seed=10 + number)
    tightened = 0
    for _ in range(60):
        masks = np.array(batch.env_method("action_masks"))
        np.testing.assert_array_equal(masks, [env.action_masks() for env in alone])
        own = np.array([env.env.unwrapped.action_masks() for env in alone])  # type: ignore[attr-defined]
        tightened += int((own & ~masks).any())
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        _, _, dones, infos = batch.step(actions)
        assert not any(info["collision"] or info["singular"] for info in infos)
        if dones.any():
            break
        for env, action in zip(alone, actions, strict=True):
            _, _, _, _, info = env.step(action)
            assert not info["shielded"]
    assert tightened > 0


def test_the_batch_pickles_with_its_shield() -> None:
    batch = ShieldedInsertionVecEnv(2, seed=1, shield={"clearance": 0.004}, **ARGUMENTS)
    batch.reset()
    other = pickle.loads(pickle.dumps(batch))
    np.testing.assert_array_equal(
        batch.env_method("action_masks"), other.env_method("action_masks")
    )
    assert other.envs[0].shield.margin.clearance == 0.004


def test_margins_that_leave_nothing_are_refused() -> None:
    with pytest.raises(ArgumentError, match="closes the holes"):
        ShieldedInsertionEnv(shield={"clearance": 0.05})
