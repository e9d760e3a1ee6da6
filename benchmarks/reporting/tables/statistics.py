"""Tables of statistics beyond the paper's: paired tests, aggregates, probability of improvement."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, PAPER_METRICS, SUCCESS, Metric
from benchmarks.reporting.results import Group, Results
from benchmarks.reporting.stats import (
    holm,
    improvement_interval,
    interquartile_means,
    means,
    optimality_gaps,
    paired_t_test,
    probability_of_improvement,
    stratified_bootstrap,
)
from benchmarks.reporting.tables.table import Cell, Table

N_HOLES: Final = 6
# score of a run in [0, 1] -> (metric, its full score)
SCORES: Final[dict[str, tuple[Metric, float]]] = {
    "Success rate": (SUCCESS, 100.0),
    "Share of holes filled": (HOLES, float(N_HOLES)),
}
AGGREGATES: Final[dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]]] = {
    "Mean": means,
    "IQM": interquartile_means,
    "Optimality gap": optimality_gaps,
}


def signed(number: float, digits: int) -> str:
    """The number with its sign, or a dash."""
    return "-" if math.isnan(number) else f"{number:+.{digits}f}"


def rivals(results: Results, track: str) -> list[tuple[str, Group]]:
    """What Rainbow of a track is compared with: the baselines and the optimum."""
    found = [
        *((method, group) for method, group in results.learners(track) if method != "rainbow"),
        ("rrt_connect", results.group("rrt_connect")),
        ("rrt_lattice", results.group("rrt_lattice")),
        ("optimum", results.group("optimum")),
    ]
    return [(labels.METHODS[method], group) for method, group in found if group.n]


def pair(ours: Group, theirs: Group) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Test episodes of both on the initial states they share, in one order.

    Raises:
        BenchmarkError: episodes of one seed and number began in different states.
    """
    a, b = ours.pooled(), theirs.pooled()
    if not len(a) or not len(b):
        return pd.DataFrame(), pd.DataFrame()
    common = a.index.intersection(b.index)
    a, b = a.loc[common], b.loc[common]
    unequal = a.index[(a["start"].astype(str) != b["start"].astype(str)).to_numpy()]
    if len(unequal):
        seed, episode = unequal[0]
        raise BenchmarkError(
            f"episode {episode} of seed {seed} began in one state in {ours.runs[0].folder.path}, "
            f"in another in {theirs.runs[0].folder.path}: delete the older run and run it again"
        )
    return a, b


def significance(results: Results) -> Table:
    """Paired t-tests of Rainbow against each other method on the common initial states."""
    header = [
        *("Comparison", "Metric", "Difference", "t", "p (Holm)", "Effect d_z", "Pairs"),
        *("p over seeds (Holm)", "Seeds"),
    ]
    rows: list[list[Cell]] = []
    for track in results.tracks():
        for name, theirs in rivals(results, track):
            ours, other = pair(results.group("rainbow", track=track), theirs)
            if len(ours):
                title = f"Rainbow ({labels.track(track)}) - {name}"
                rows += [[title, *row] for row in _tests(ours, other)]
    notes = [
        "Two-sided paired t-tests over test episodes with the same initial state; metrics that "
        "need an insertion pair only episodes in which both inserted. Holm over the six metrics.",
        "p over seeds: the same test on one mean difference per seed. Episodes of a seed share one "
        "trained network, so only this one speaks of training again; it needs two seeds.",
    ]
    return Table("significance", "Rainbow against each method", header, rows, notes)


def _tests(ours: pd.DataFrame, theirs: pd.DataFrame) -> list[list[Cell]]:
    columns = [
        (metric.scale * ours[metric.column], metric.scale * theirs[metric.column])
        for metric in PAPER_METRICS
    ]
    tests = [paired_t_test(a, b) for a, b in columns]
    seeds = []
    for a, b in columns:
        differences = (a - b).groupby(level="seed").mean().dropna()
        seeds.append(paired_t_test(differences, np.zeros(len(differences))))
    corrected = holm([test.p for test in tests])
    over_seeds = holm([test.p for test in seeds])
    rows: list[list[Cell]] = []
    for metric, test, p, by_seed, q in zip(
        PAPER_METRICS, tests, corrected, seeds, over_seeds, strict=True
    ):
        rows.append([
            metric.label,
            signed(test.difference, metric.digits),
            signed(test.t, 2),
            _p(p),
            signed(test.effect, 2),
            str(test.n),
            _p(q),
            str(by_seed.n),
        ])  # fmt: skip
    return rows


def _p(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2g}"


def configurations(results: Results) -> list[tuple[str, Group]]:
    """Every complete method on the optimized geometry: (name, runs), learners by track."""
    found = [
        (f"{labels.METHODS[method]}, {labels.track(track)}", group)
        for track in results.tracks()
        for method, group in results.learners(track)
    ]
    found += [
        (labels.METHODS[method], results.group(method))
        for method in ("rrt_connect", "rrt_lattice", "optimum")
    ]
    return [(name, group) for name, group in found if group.n]


def run_scores(group: Group, score: str) -> NDArray[np.float64]:
    """(runs, 1): a score of each seed's test episodes, in [0, 1]."""
    metric, full = SCORES[score]
    return np.array([[metric.reduce(run.test()) / full] for run in group.runs])


def aggregates(results: Results) -> Table:
    """Mean, median, IQM and optimality gap over seeds, as rliable defines them."""
    header = ["Method", "Score", *AGGREGATES, "Seeds"]
    rows: list[list[Cell]] = []
    for name, group in configurations(results):
        for score in SCORES:
            scores = run_scores(group, score)
            cells: list[Cell] = []
            for statistic in AGGREGATES.values():
                value = float(statistic(scores[None])[0])
                cells.append(_with_interval(value, stratified_bootstrap(scores, statistic)))
            rows.append([name, score, *cells, str(group.n)])
    notes = [
        "Agarwal et al. 2021. One score in [0, 1] per seed; [95 % interval] by stratified "
        "bootstrap over seeds, which needs two of them. Optimality gap: what is lacking to 1."
    ]
    return Table("aggregates", "Aggregates over seeds", header, rows, notes)


def _with_interval(value: float, interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{value:.3f}" + ("" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]")


def improvement(results: Results) -> Table:
    """Probability that a training of Rainbow beats one of another method."""
    header = ["Comparison", *SCORES, "Seeds"]
    rows: list[list[Cell]] = []
    for track in results.tracks():
        ours = results.group("rainbow", track=track)
        for name, theirs in rivals(results, track):
            if not ours.n:
                continue
            cells: list[Any] = []
            for score in SCORES:
                a, b = run_scores(ours, score), run_scores(theirs, score)
                value = probability_of_improvement(a, b)
                cells.append(_with_interval(value, improvement_interval(a, b)))
            seeds = f"{ours.n}; {theirs.n}"
            rows.append([f"Rainbow ({labels.track(track)}) over {name}", *cells, seeds])
    notes = [
        "P(Rainbow's score > the other's) over all pairs of seeds, ties counted half; [95 % "
        "interval] by stratified bootstrap. With one seed it is 0, 0.5 or 1 and says little."
    ]
    return Table("improvement", "Probability of improvement", header, rows, notes)
