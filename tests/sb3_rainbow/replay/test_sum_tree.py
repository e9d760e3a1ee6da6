"""The sum tree against plain numpy."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.utils import set_random_seed

from sb3_rainbow import SumTree


@settings(max_examples=60, deadline=None)
@given(
    capacity=st.integers(1, 700),
    n_updates=st.integers(1, 5),
    seed=st.integers(0, 10_000),
)
def test_sums_and_search_agree_with_cumulative_sums(
    capacity: int, n_updates: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    tree, masses = SumTree(capacity), np.zeros(capacity)
    for _ in range(n_updates):
        indices = rng.choice(capacity, size=rng.integers(1, capacity + 1), replace=False)
        # Multiples of 1/8 sum without rounding: the comparison below is exact.
        values = rng.integers(0, 5, size=indices.size) / 8.0
        tree.set(indices, values)
        masses[indices] = values
    assert tree.total == masses.sum()
    np.testing.assert_array_equal(tree.leaves, masses)
    if masses.sum() > 0:
        prefix = rng.uniform(0.0, masses.sum(), size=50)
        expected = np.searchsorted(np.cumsum(masses), prefix, side="right")
        np.testing.assert_array_equal(tree.find(prefix), expected)


def test_of_a_repeated_index_the_last_value_counts() -> None:
    tree = SumTree(20)
    tree.set(np.array([3, 17, 3]), np.array([1.0, 2.0, 5.0]))
    assert tree.total == 7.0
    assert tree.leaves[3] == 5.0


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
