"""Statistics against scipy, rliable's definition and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from rliable import metrics as rliable_metrics

from benchmarks import stats

SAMPLES = st.lists(st.floats(-100, 100), min_size=3, max_size=30)


@given(st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilsons_interval_is_scipys(counts: tuple[int, int]) -> None:
    successes, trials = counts
    theirs = scipy.stats.binomtest(successes, trials).proportion_ci(0.95, "wilson")
    assert stats.wilson(successes, trials) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_wilson_of_no_trials_is_nothing() -> None:
    assert all(math.isnan(end) for end in stats.wilson(0, 0))


def test_the_paired_test_is_scipys_and_leaves_out_missing_pairs() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=40), rng.normal(0.5, 1.0, size=40)
    theirs = scipy.stats.ttest_rel(a, b)
    ours = stats.paired_t_test(np.append(a, np.nan), np.append(b, 1.0))
    assert (ours.t, ours.p) == pytest.approx((theirs.statistic, theirs.pvalue))
    assert ours.n == 40
    assert ours.effect == pytest.approx((a - b).mean() / (a - b).std(ddof=1))


def test_the_paired_test_of_equal_and_of_shifted_samples() -> None:
    same = stats.paired_t_test([1.0, 2.0], [1.0, 2.0])
    assert (same.difference, same.p) == (0.0, 1.0)
    shifted = stats.paired_t_test([2.0, 3.0], [1.0, 2.0])
    assert shifted.difference == 1.0
    assert math.isnan(shifted.p)
    with pytest.raises(ValueError, match="one shape"):
        stats.paired_t_test([1.0], [1.0, 2.0])


def test_holm_by_hand() -> None:
    # 0.01 x 3, then max(0.03, 0.02 x 2), then max(0.04, 0.5 x 1); a missing one does not count
    assert stats.holm([0.02, 0.5, math.nan, 0.01]) == pytest.approx(
        [0.04, 0.5, math.nan, 0.03], nan_ok=True
    )
    assert stats.holm([0.9, 0.8]) == [1.0, 1.0]


@given(SAMPLES)
def test_the_interquartile_mean_is_rliables(scores: list[float]) -> None:
    array = np.array(scores)[:, None]
    assert stats.interquartile_mean(array) == pytest.approx(
        float(rliable_metrics.aggregate_iqm(array))
    )


def test_the_bootstrap_of_two_runs_is_its_exact_distribution() -> None:
    # means of two draws from {0, 1}: 0, 1/2, 1 with 1/4, 1/2, 1/4
    low, high = stats.stratified_bootstrap([[0.0], [1.0]], stats.means)
    assert (low, high) == (0.0, 1.0)
    low, high = stats.stratified_bootstrap([[0.0], [1.0]], stats.means, confidence=0.4)
    assert (low, high) == (0.5, 0.5)


def test_the_bootstrap_keeps_each_task_to_its_own_runs() -> None:
    # task 0 is always 0, task 1 always 10: no resample may mix them
    scores = np.array([[0.0, 10.0], [0.0, 10.0], [0.0, 10.0]])
    seen: list[stats.Array] = []

    def keep(samples: stats.Array) -> stats.Array:
        seen.append(samples)
        return stats.means(samples)

    stats.stratified_bootstrap(scores, keep, repetitions=50)
    (samples,) = seen
    assert samples.shape == (50, 3, 2)
    assert (samples[..., 0] == 0.0).all()
    assert (samples[..., 1] == 10.0).all()


def test_the_bootstrap_covers_a_known_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        low, high = stats.stratified_bootstrap(
            rng.normal(size=(40, 1)), stats.means, repetitions=200
        )
        hits += low <= 0.0 <= high
    assert 0.88 <= hits / 200 <= 0.99


def test_the_bootstrap_repeats_and_needs_two_runs() -> None:
    scores = np.random.default_rng(2).normal(size=(5, 1))
    assert stats.stratified_bootstrap(scores) == stats.stratified_bootstrap(scores)
    assert all(math.isnan(end) for end in stats.stratified_bootstrap([[1.0]]))
    with pytest.raises(ValueError, match="shape"):
        stats.stratified_bootstrap([1.0, 2.0])


@given(SAMPLES)
def test_over_seeds_is_numpys(values: list[float]) -> None:
    value = stats.over_seeds([*values, math.nan])
    assert value.mean == pytest.approx(np.mean(values), abs=1e-9)
    assert value.std == pytest.approx(np.std(values, ddof=1), abs=1e-9)
    assert value.n == len(values)


def test_one_seed_has_no_spread_and_nothing_is_a_dash() -> None:
    assert stats.over_seeds([3.0]).text(1) == "3.0"
    assert stats.over_seeds([1.0, 3.0]).text(1) == "2.0 ± 1.4"
    assert stats.over_seeds([math.nan]).text(1) == "-"


@given(SAMPLES, st.integers(1, 12))
def test_the_moving_average_is_the_mean_of_the_last(values: list[float], window: int) -> None:
    ours = stats.moving_average(values, window)
    theirs = [np.mean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))]
    assert ours == pytest.approx(theirs, abs=1e-6)


def test_probability_of_improvement_is_mann_whitneys() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 5, 12).astype(float), rng.integers(1, 6, 9).astype(float)
    theirs = scipy.stats.mannwhitneyu(a, b).statistic / (12 * 9)
    assert stats.probability_of_improvement(a, b) == pytest.approx(theirs)
