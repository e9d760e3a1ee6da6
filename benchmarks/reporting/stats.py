"""Statistics of stored episodes: means over seeds, intervals, paired tests. Pure functions."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # scipy.stats takes half a second: loaded at its first use
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Value:
    """A measured number: mean over ``n`` seeds, sample standard deviation, and an interval.

    NaN stands for what does not exist: the mean of nothing, the deviation of one seed.
    """

    mean: float
    std: float = math.nan
    n: int = 1
    low: float = math.nan
    high: float = math.nan

    def text(self, digits: int) -> str:
        """``95.2 ± 1.3``; the value alone for one seed, a dash for nothing."""
        if math.isnan(self.mean):
            return "-"
        if math.isnan(self.std):
            return f"{self.mean:.{digits}f}"
        return f"{self.mean:.{digits}f} ± {self.std:.{digits}f}"

    def interval_text(self, digits: int) -> str:
        """``[90.1, 97.5]``, or a dash."""
        if math.isnan(self.low):
            return "-"
        return f"[{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def signed(self, unit: str = "") -> str:
        """``+3.1 points [1.0, 5.2]``: a difference with its unit and interval, or a dash."""
        if math.isnan(self.mean):
            return "-"
        interval = "" if math.isnan(self.low) else f" {self.interval_text(1)}"
        return f"{self.mean:+.1f}{unit}{interval}"


def over_seeds(values: ArrayLike) -> Value:
    """Mean and sample standard deviation (n - 1) of one number per seed; NaNs are left out."""
    data = np.asarray(values, dtype=np.float64)
    data = data[~np.isnan(data)]
    if data.size == 0:
        return Value(math.nan, n=0)
    std = float(data.std(ddof=1)) if data.size > 1 else math.nan
    return Value(float(data.mean()), std, int(data.size))


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion (Wilson 1927), both ends in [0, 1]."""
    if trials <= 0:
        return math.nan, math.nan
    ends = scipy.stats.binomtest(successes, trials).proportion_ci(0.95, "wilson")
    return float(ends.low), float(ends.high)


def interquartile_mean(*tasks: Array, axis: int = -1) -> Any:
    """Mean of the middle half of all scores, as rliable defines it, from an array for each task."""
    return scipy.stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)


def improvement(*tasks: Array, axis: int = -1) -> Any:
    """Probability that a run of ours is better than one of theirs, on a task drawn at random.

    Mean over tasks of P(X > Y) + P(X = Y) / 2 (Agarwal et al. 2021, section 4.3). ``tasks`` are
    scores of ours, an array for each task, then those of theirs; runs lie along the last axis.
    """
    pairs = zip(tasks[: len(tasks) // 2], tasks[len(tasks) // 2 :], strict=True)
    signs = [np.sign(x[..., None] - y[..., None, :]).mean(axis=(-2, -1)) for x, y in pairs]
    return 0.5 + 0.5 * np.mean(signs, axis=0)


def bootstrap(
    samples: Sequence[Array], statistic: Callable[..., Any], paired: bool = False
) -> tuple[float, float]:
    """95 % percentile interval of a statistic of samples, drawn each by itself or as ``paired``.

    With a sample for each task it is the stratified bootstrap of Agarwal et al. 2021. rliable's own
    function is not called because the library it draws with does not import beside current pandas.
    The ends are NaN where a sample has fewer than two values.
    """
    if min(map(len, samples), default=0) < 2:
        return math.nan, math.nan
    drawn: dict[str, Any] = {"n_resamples": 2_000, "rng": np.random.default_rng(0)}
    drawn |= {"paired": paired, "method": "percentile"}
    ends = scipy.stats.bootstrap(samples, statistic, **drawn)
    low, high = ends.confidence_interval
    return float(low), float(high)


def measured(values: Sequence[float]) -> Value:
    """One number per seed as their mean with Student's 95 % interval, NaN of one seed."""
    value = over_seeds(values)
    low, high = t_interval(value.mean, value.std, value.n)
    return replace(value, low=low, high=high)


def t_interval(mean: Any, std: Any, n: int) -> tuple[Any, Any]:
    """Student's 95 % interval of a mean, or of an array of them, from deviation and size."""
    half = scipy.stats.t.ppf(0.975, n - 1) * (std / math.sqrt(n)) if n > 1 else math.nan * mean
    return mean - half, mean + half


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share (T,) of all scores above each threshold: Agarwal et al. 2021, equation (3)."""
    above = np.ravel(scores) > np.asarray(thresholds, dtype=np.float64)[:, None]
    return np.asarray(above.mean(axis=1), dtype=np.float64)


def mean_band(curves: ArrayLike) -> tuple[Array, Array, Array]:
    """Mean of curves (seeds, T), and the ends of Student's 95 % interval over seeds, each (T,).

    Over seeds, as the episodes of one share a trained network. The ends of one curve are NaN.
    """
    data = np.asarray(curves, dtype=np.float64)
    n, mean = len(data), data.mean(axis=0)
    return mean, *t_interval(mean, data.std(axis=0, ddof=min(1, n - 1)), n)


def paired_p(differences: ArrayLike) -> float:
    """p of the two-sided paired t-test, from the differences of the pairs.

    NaN with fewer than two pairs, or with all differences equal, unless the samples are (p = 1).
    """
    data = np.asarray(differences, dtype=np.float64)
    if len(data) < 2:
        return math.nan
    if data.std(ddof=1) <= 1e-9 * abs(data.mean()):  # equal but for rounding
        return 1.0 if data.mean() == 0.0 else math.nan
    return float(scipy.stats.ttest_1samp(data, 0.0).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction, in the given order; NaN stays NaN and does not count."""
    p = np.asarray(p_values, dtype=np.float64)
    order, adjusted = p.argsort(), np.empty_like(p)  # NaN comes last
    left = np.count_nonzero(~np.isnan(p)) - np.arange(len(p))
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, left * p[order]))
    return [*map(float, adjusted)]


def moving_average(values: ArrayLike, window: int, counts: ArrayLike) -> Array:
    """At each point the mean of the last ``window`` observations; fewer at the start.

    Each of the values (n,) is the mean of ``counts`` (n,) observations: as many of them count as
    hold at least the window.
    """
    data = np.asarray(values, dtype=np.float64)
    weights = np.asarray(counts, dtype=np.float64)
    end = np.cumsum(weights)
    before = end - weights
    start = np.maximum(0, np.searchsorted(before, end - window, side="right") - 1)
    total = np.cumsum(np.concatenate([[0.0], data * weights]))
    return np.asarray((total[1:] - total[start]) / (end - before[start]), dtype=np.float64)
