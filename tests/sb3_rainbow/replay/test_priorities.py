"""Prioritized sampling: the sum tree, frequencies, weights, updates, use under SB3's own DQN."""

import pickle
import re
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from stable_baselines3.common.utils import set_random_seed

from sb3_rainbow import PrioritizedReplayBuffer, SumTree


def filled_buffer(n_rows: int = 10, n_envs: int = 3, **kwargs: Any) -> PrioritizedReplayBuffer:
    space, given = spaces.Box(-1000, 1000, (1,)), {"device": "cpu", "n_envs": n_envs, **kwargs}
    buffer = PrioritizedReplayBuffer(n_rows * n_envs, space, spaces.Discrete(2), **given)
    for row in range(n_rows):
        add_row(buffer, row)
    return buffer


def add_row(buffer: PrioritizedReplayBuffer, row: int) -> None:
    obs, zeros = np.full((buffer.n_envs, 1), row, np.float32), np.zeros(buffer.n_envs)
    buffer.add(obs, obs + 1, zeros, zeros, zeros, [{}] * buffer.n_envs)


@pytest.mark.parametrize("alpha", [0.7, 0.0])
def test_frequencies_follow_losses_to_the_power_alpha(alpha: float) -> None:
    """At 0 uniform over all pairs of step and env."""
    set_random_seed(3)
    buffer = filled_buffer(alpha=alpha, epsilon=0.01)
    losses = np.linspace(0.0, 4.0, 30)
    buffer.update_priorities(np.arange(30), losses)
    drawn = np.concatenate([buffer.sample(1).indices for _ in range(20_000)])
    masses = (losses + 0.01) ** alpha
    counts = np.bincount(drawn, minlength=30)
    assert chisquare(counts, masses / masses.sum() * counts.sum()).pvalue > 1e-3
    assert alpha or set(buffer.sample(64).weights.tolist()) == {1.0}


def test_weights_undo_the_bias_and_have_maximum_one() -> None:
    buffer = filled_buffer(alpha=0.6, beta=0.4)
    losses = np.random.default_rng(1).uniform(0.1, 4.0, 30)
    buffer.update_priorities(np.arange(30), losses)
    samples = buffer.sample(16)
    mass = (losses + 1e-6) ** 0.6
    probability = (mass / mass.sum())[samples.indices]
    expected = (30 * probability) ** -0.4
    np.testing.assert_allclose(samples.weights.numpy(), expected / expected.max(), rtol=1e-5)
    buffer.beta = 0.0
    assert set(buffer.sample(16).weights.tolist()) == {1.0}


def test_new_transitions_enter_at_the_running_maximum() -> None:
    buffer = filled_buffer(n_rows=4, n_envs=1, alpha=0.5, epsilon=1e-12)
    np.testing.assert_allclose(buffer.tree.leaves, 1.0)
    buffer.update_priorities(np.array([1, 2]), np.array([9.0, 0.25]))
    buffer.update_priorities(np.array([1]), np.array([4.0]))
    add_row(buffer, 4)
    np.testing.assert_allclose(buffer.tree.leaves, [3.0, 2.0, 0.5, 1.0])


def test_a_transition_overwritten_since_it_was_drawn_stays_dead() -> None:
    buffer = filled_buffer(n_rows=4, n_envs=1, n_steps=2)
    add_row(buffer, 4)
    assert buffer.tree.leaves[0] == 0.0
    buffer.update_priorities(np.array([0]), np.array([5.0]))
    assert buffer.tree.leaves[0] == 0.0


@pytest.mark.parametrize("loss", [np.nan, np.inf, -1.0])
def test_a_loss_that_is_no_priority_is_refused(loss: float) -> None:
    buffer = filled_buffer()
    before = buffer.tree.leaves.copy()
    with pytest.raises(ValueError, match="finite loss >= 0"):
        buffer.update_priorities(np.array([0, 1]), np.array([1.0, loss]))
    np.testing.assert_array_equal(buffer.tree.leaves, before)


@pytest.mark.parametrize("reward", [np.nan, np.inf, -np.inf, 1e39])
@pytest.mark.filterwarnings("ignore:overflow")
def test_a_reward_that_is_not_finite_is_refused(reward: float) -> None:
    buffer = filled_buffer(n_envs=3)
    before = pickle.dumps(buffer)
    obs, zeros = np.zeros((3, 1), np.float32), np.zeros(3)
    with pytest.raises(ValueError, match=rf"reward of env 1 is {re.escape(str(reward))}"):
        buffer.add(obs, obs, zeros, np.array([0.0, reward, 0.0]), zeros, [{}] * 3)
    assert pickle.dumps(buffer) == before


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"alpha": -0.1}, "alpha must lie in .0, 1., got -0.1"),
        ({"beta": 2.0}, "beta must lie in .0, 1., got 2.0"),
        ({"gamma": 1.5}, "gamma"),
        ({"epsilon": 0.0}, "epsilon must be above 0 and finite, got 0.0"),
        ({"epsilon": np.nan}, "epsilon"),
        ({"epsilon": np.inf}, "epsilon"),
        ({"n_steps": 0}, "n_steps must be an integer, at least 1, got 0"),
        ({"n_rows": 3, "n_steps": 3}, "buffer_size=9 is too small: 3 envs with n_steps=3 need"),
    ],
)
def test_parameters_out_of_range(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        filled_buffer(**kwargs)


def test_a_reset_forgets_everything_and_sampling_before_a_window_is_complete_says_so() -> None:
    buffer = filled_buffer(n_rows=20, n_steps=3)
    assert buffer.size() > 0
    assert buffer.tree.total > 0.0
    buffer.reset()
    assert (buffer.size(), buffer.tree.total, buffer.can_sample) == (0, 0.0, False)
    with pytest.raises(ValueError, match="no complete n-step window"):
        buffer.sample(4)


@settings(max_examples=60)
@given(capacity=st.integers(1, 700), n_updates=st.integers(1, 5), seed=st.integers(0, 10_000))
def test_sums_and_search_agree_with_cumulative_sums(
    capacity: int, n_updates: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    tree, masses = SumTree(capacity), np.zeros(capacity)
    for _ in range(n_updates):
        indices = rng.integers(capacity, size=rng.integers(1, capacity + 1))
        # Multiples of 1/8 sum without rounding: the comparison below is exact.
        values = rng.integers(0, 5, size=indices.size) / 8.0
        tree.set(indices, values)
        masses[indices] = values  # of a repeated index the last value counts
    assert tree.total == masses.sum()
    np.testing.assert_array_equal(tree.leaves, masses)
    if masses.sum() > 0:
        prefix = rng.uniform(0.0, masses.sum(), size=50)
        expected = np.searchsorted(np.cumsum(masses), prefix, side="right")
        np.testing.assert_array_equal(tree.find(prefix), expected)


def test_rounding_never_draws_an_empty_leaf() -> None:
    tree = SumTree(100)
    filled = np.array([0, 7, 8, 50, 63])
    tree.set(filled, np.full(5, 0.1))
    beyond = np.array([tree.total, np.nextafter(tree.total, np.inf), tree.total * 1.01])
    assert set(tree.find(beyond)) <= set(filled)


def test_a_million_updates_leave_no_drift() -> None:
    rng = np.random.default_rng(0)
    tree = SumTree(1000)
    for _ in range(1000):
        tree.set(rng.integers(0, 1000, 1000), 10.0 ** rng.uniform(-8, 8, 1000))
    assert tree.total == pytest.approx(tree.leaves.sum(), rel=1e-12)
    tree.set(np.arange(1000), np.zeros(1000))
    assert tree.total == 0.0


def test_every_stratum_gives_one_draw() -> None:
    set_random_seed(0)
    tree = SumTree(64)
    tree.set(np.arange(64), np.ones(64))
    np.testing.assert_array_equal(tree.sample(64), np.arange(64))


def test_pickling_keeps_masses_and_sums() -> None:
    tree = SumTree(1000)
    tree.set(np.arange(10), np.arange(10.0))
    copy = pickle.loads(pickle.dumps(tree))
    assert copy.total == tree.total
    np.testing.assert_array_equal(copy.leaves, tree.leaves)
    # Only what is filled goes into the file.
    assert len(pickle.dumps(tree)) < 1000


def test_errors_name_the_value() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        SumTree(0)
    with pytest.raises(ValueError, match="all zero"):
        SumTree(5).sample(2)
