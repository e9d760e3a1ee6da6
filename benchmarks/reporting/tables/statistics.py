"""Tables of statistics beyond the paper's: paired tests and aggregates."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.protocol.metrics import HOLES, SUCCESS, Metric
from benchmarks.reporting.compared import comparisons
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import KNOWS, complete, rows
from benchmarks.reporting.stats import (
    holm,
    interquartile_means,
    means,
    optimality_gaps,
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


def significance(results: Results) -> Table:
    """Every comparison that a sentence rests on, paired over the same starts."""
    header = [
        *("Method", *KNOWS, "Against", *(f"Its {name.lower()}" for name in KNOWS), "Metric"),
        *("Difference", "t", "p (Holm)", "Effect d_z", "Pairs", "p over seeds (Holm)", "Seeds"),
    ]
    found = comparisons(results)
    by_seed = holm([each.seeds.p for each in found])
    made: list[list[Cell]] = []
    for each, q in zip(found, by_seed, strict=True):
        test, digits = each.test, each.metric.digits
        made.append([
            each.name, *each.ours.head[1:], *each.theirs.head, each.metric.label,
            signed(test.difference, digits), signed(test.t, 2), _p(each.p), signed(test.effect, 2),
            str(test.n), _p(q), str(each.seeds.n),
        ])  # fmt: skip
    notes = [
        "Two-sided paired t-tests over test episodes with the same initial state; the time to the "
        "first insertion pairs only episodes in which both inserted. Holm over all rows.",
        "p over seeds: the same test on one mean difference per seed. Episodes of a seed share one "
        "trained network, so only this one speaks of training again; it needs two seeds.",
    ]
    title = "Learners against the best control with the same masks and memory, and other pairs"
    return Table("significance", title, header, made, notes, left=(0, 1, 2, 3, 4, 5, 6))


def _p(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2g}"


def aggregates(results: Results) -> Table:
    """Mean, IQM and optimality gap over seeds, as rliable defines them."""
    header = ["Method", *KNOWS, "Score", *AGGREGATES, "Seeds"]
    made: list[list[Cell]] = []
    for row in complete([*rows(results), *rows(results, uncertain=True)]):
        for name, (metric, full) in SCORES.items():
            tests = [run.test(row.level) for run in row.group.runs]
            scores = np.array([[metric.reduce(test) / full] for test in tests])
            cells: list[Cell] = []
            for statistic in AGGREGATES.values():
                value = float(statistic(scores[None])[0])
                low, high = stratified_bootstrap(scores, statistic)
                interval = "" if math.isnan(low) else f" [{low:.3f}, {high:.3f}]"
                cells.append(f"{value:.3f}{interval}")
            made.append([*row.head, name, *cells, str(row.group.n)])
    notes = [
        "Agarwal et al. 2021. One score in [0, 1] per seed; [95 % interval] by stratified "
        "bootstrap over seeds, which needs two of them. Optimality gap: what is lacking to 1."
    ]
    title = "Aggregates over seeds"
    return Table("aggregates", title, header, made, notes, left=(0, 1, 2, 3))
