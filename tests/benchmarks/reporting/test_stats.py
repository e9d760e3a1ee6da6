"""Statistics against scipy, rliable's definition and closed forms."""

import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rliable import metrics as rliable_metrics

from benchmarks.protocol.metrics import METRICS
from benchmarks.reporting import stats

SAMPLES = st.lists(st.floats(-100, 100), min_size=3, max_size=30)


def test_wilsons_interval_by_hand() -> None:
    # 8 of 10: centre and half-width of Wilson 1927 with z = 1.959964
    z2 = 1.959964**2
    centre, half = (8 + z2 / 2) / (10 + z2), math.sqrt(z2 * (8 * 2 / 10 + z2 / 4)) / (10 + z2)
    assert stats.wilson(8, 10) == pytest.approx((centre - half, centre + half), abs=1e-6)
    assert stats.wilson(0, 10)[0] == 0.0
    assert stats.wilson(10, 10)[1] == 1.0
    assert all(math.isnan(end) for end in stats.wilson(0, 0))


def test_a_performance_profile_by_hand() -> None:
    profile = stats.performance_profile([[0.0, 0.5], [0.5, 1.0]], [0.0, 0.4, 0.5, 1.0])
    assert profile.tolist() == [0.75, 0.75, 0.25, 0.0]


def test_the_paired_test_of_equal_and_of_shifted_samples_and_holm_by_hand() -> None:
    assert stats.paired_p([0.0, 0.0]) == 1.0
    assert math.isnan(stats.paired_p([1.0, 1.0 + 1e-15]))
    assert math.isnan(stats.paired_p([1.0]))
    # 0.01 x 3, then max(0.03, 0.02 x 2), then max(0.04, 0.5 x 1); a missing one does not count
    assert stats.holm([0.02, 0.5, math.nan, 0.01]) == pytest.approx(
        [0.04, 0.5, math.nan, 0.03], nan_ok=True
    )
    assert stats.holm([0.9, 0.8]) == [1.0, 1.0]


@given(SAMPLES)
def test_the_interquartile_mean_is_rliables(scores: list[float]) -> None:
    array = np.array(scores)[:, None]
    assert stats.interquartile_mean(array[:, 0]) == pytest.approx(
        float(rliable_metrics.aggregate_iqm(array))
    )


def test_the_bootstrap_is_the_exact_distribution_and_keeps_each_task_to_its_own_runs() -> None:
    # means of two draws from {0, 1}: 0, 1/2, 1 with 1/4, 1/2, 1/4
    assert stats.bootstrap([np.array([0.0, 1.0])], np.mean) == (0.0, 1.0)
    assert all(math.isnan(end) for end in stats.bootstrap([np.array([1.0])], np.mean))
    # task 0 is always 0, task 1 always 10: no resample may mix them
    tasks = [np.zeros(3), np.full(3, 10.0)]
    assert stats.bootstrap(tasks, stats.interquartile_mean) == (5.0, 5.0)
    assert stats.bootstrap(tasks, lambda x, y, axis: (y - x).min(axis)) == (10.0, 10.0)


@given(SAMPLES)
def test_over_seeds_is_numpys_one_has_no_spread_and_nothing_is_a_dash(values: list[float]) -> None:
    value = stats.over_seeds([*values, math.nan])
    assert value.mean == pytest.approx(np.mean(values), abs=1e-9)
    assert value.std == pytest.approx(np.std(values, ddof=1), abs=1e-9)
    assert value.n == len(values)
    assert stats.over_seeds([3.0]).text(1) == "3.0"
    assert stats.over_seeds([1.0, 3.0]).text(1) == "2.0 ± 1.4"
    assert stats.over_seeds([math.nan]).text(1) == "-"


def test_the_probability_of_improvement_is_rliables() -> None:
    rng = np.random.default_rng(3)
    for n, m in ((3, 5), (4, 4)):  # with ties
        ours, theirs = rng.integers(0, 6, (n, 3)) / 1.0, rng.integers(0, 6, (m, 3)) / 1.0
        tasks = [*ours.T, *theirs.T]
        expected = float(rliable_metrics.probability_of_improvement(ours, theirs))
        assert stats.improvement(*tasks) == pytest.approx(expected)
        low, high = stats.bootstrap(tasks, stats.improvement)
        assert 0.0 <= low <= expected <= high <= 1.0
    better = [np.array([2.0, 3.0]), np.array([0.0, 1.0])]
    assert stats.bootstrap(better, stats.improvement) == (1.0, 1.0)


def test_the_bootstrap_interval_of_a_mean_leaves_out_what_is_missing() -> None:
    data = np.random.default_rng(8).normal(size=200)
    rows = pd.DataFrame({"time_first": np.append(data, math.nan)})
    low, high = stats.bootstrap([METRICS["time_first"].values(rows)], np.mean)
    half = 1.96 * data.std(ddof=1) / math.sqrt(200)
    assert (low, high) == pytest.approx((data.mean() - half, data.mean() + half), abs=0.03)
    assert stats.bootstrap([np.full(3, 2.0)], np.mean) == (2.0, 2.0)


@given(SAMPLES, st.integers(1, 12), st.integers(0, 99), st.sampled_from([1, 4]))
def test_a_moving_average_of_averages_holds_enough_observations(
    values: list[float], window: int, seed: int, most: int
) -> None:
    counts = np.random.default_rng(seed).integers(1, most + 1, len(values))
    for i, smooth in enumerate(stats.moving_average(values, window, counts)):
        start = i
        while counts[start : i + 1].sum() < window and start > 0:
            start -= 1
        theirs = np.average(values[start : i + 1], weights=counts[start : i + 1])
        assert smooth == pytest.approx(theirs, abs=1e-6)


def test_a_band_over_whole_curves() -> None:
    curves = np.array([[0.0, 10.0], [1.0, 10.0]])
    mean, low, high = stats.mean_band(curves)
    assert mean == pytest.approx([0.5, 10.0])
    half = 12.706 * 0.5  # Student's quantile for one degree of freedom, of an error of 1/2
    assert low == pytest.approx([0.5 - half, 10.0], abs=1e-3)
    assert high == pytest.approx([0.5 + half, 10.0], abs=1e-3)
    assert np.isnan(stats.mean_band(curves[:1])[1]).all()
