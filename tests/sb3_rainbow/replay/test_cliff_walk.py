"""Prioritized replay on the blind cliff walk: what is known of it, and the updates it saves."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from tests.sb3_rainbow.replay.cliff_walk import BlindCliffWalkEnv, Variant, measure, transitions

RAINBOW: dict[str, Any] = {
    **dict.fromkeys(("double_q", "dueling", "noisy", "distributional"), False),
    **{"n_steps": 1, "tau": 1.0, "batch_size": 32, "learning_rate": 1e-2},
    **{"beta_start": 0.4, "beta_end": 0.4, "policy_kwargs": {"net_arch": []}},
}


@pytest.mark.parametrize("states", [1, 2, 5, 8])
def test_one_of_all_sequences_is_rewarded(states: int) -> None:
    returns = []
    for actions in itertools.product((0, 1), repeat=states):
        env = BlindCliffWalkEnv(states)
        env.reset()
        total = 0.0
        for action in actions:
            _, reward, ended, _, _ = env.step(np.int64(action))
            total += reward
            if ended:
                break
        returns.append(total)
    assert sorted(returns) == [0.0] * (2**states - 1) + [1.0]


@pytest.mark.parametrize("states", [2, 5, 9])
def test_values_are_those_of_value_iteration_over_the_memory(states: int) -> None:
    env = BlindCliffWalkEnv(states)
    memory = list(transitions(states, np.random.default_rng(0)))
    # the paper's count of the relevant experience
    assert len(memory) == 2 ** (states + 1) - 2
    assert sum(reward for _, _, _, reward, _ in memory) == 1.0
    values = np.zeros((states, 2))
    for _ in range(states + 1):
        for state, action, following, reward, ended in memory:
            rest = 0.0 if ended else env.gamma * values[following].max()
            values[state, action] = reward + rest
    np.testing.assert_allclose(env.optimal_values(), values, atol=1e-12)


def test_prioritized_replay_learns_the_walk_in_fewer_updates() -> None:
    variant = Variant(RAINBOW, 4000)
    updates = {
        replay: [measure(variant, replay, 10, seed) or variant.limit for seed in range(3)]
        for replay in ("prioritized", "uniform")
    }
    assert max(updates["prioritized"]) < variant.limit
    assert np.median(updates["uniform"]) > 1.3 * np.median(updates["prioritized"])


def test_full_weights_undo_what_priorities_do() -> None:
    """beta = 1 under plain gradient descent: each update is uniform replay's, only smaller."""
    learners = {}
    for beta in (0.0, 1.0):
        rainbow = {**RAINBOW, "learning_rate": 0.25, "beta_start": beta, "beta_end": beta}
        learners[beta] = measure(Variant(rainbow, 3000, "sgd"), "prioritized", 8, 0)
    assert learners[0.0] is not None
    assert learners[1.0] is None or learners[1.0] > 3 * learners[0.0]
