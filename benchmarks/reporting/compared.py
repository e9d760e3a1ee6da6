"""Every comparison that a sentence rests on: paired over the same starts, corrected together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, METRICS, SUCCESS, Metric
from benchmarks.protocol.plan import LEARNERS, METHODS
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import Row, best, complete, control_of, row_of, rows
from benchmarks.reporting.stats import PairedTest, holm, paired_t_test

SCORED: Final = "safe"  # the track whose learner is the headline
TIME: Final = METRICS["time_first"]
CONTROL, ABLATION, GEOMETRY, SCRIPT, PAPER = "control", "ablation", "geometry", "script", "paper"


@dataclass(frozen=True)
class Comparison:
    """Two rows on the starts they share; ``p`` is corrected over all comparisons of the store.

    ``seeds`` is the same test on one mean difference per seed, and ``p_seeds`` its p, corrected:
    what it says holds for other trainings, what ``p`` says for the networks that were trained.
    """

    kind: str
    ours: Row
    theirs: Row
    metric: Metric
    test: PairedTest
    seeds: PairedTest
    p: float = math.nan
    p_seeds: float = math.nan

    @property
    def name(self) -> str:
        """What is compared, in words: without which component, or on which geometry."""
        cell = self.ours.group.runs[0].config["cell"]
        name = self.ours.name
        if cell["ablation"] != "full":
            name = f"{labels.ABLATIONS[cell['ablation']]}, {labels.track(self.ours.track)}"
        return name if cell["geometry"] == "optimized" else f"{name}, {cell['geometry']} geometry"

    @property
    def gain(self) -> float:
        """By how much ours is better: the difference, or for times its opposite."""
        return self.test.difference if self.metric in (SUCCESS, HOLES) else -self.test.difference


def pair(ours: Row, theirs: Row) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Test episodes of both on the initial states they share, in one order.

    Raises:
        BenchmarkError: episodes of one seed and number began in different states.
    """
    a, b = ours.group.pooled(ours.level), theirs.group.pooled(theirs.level)
    if not len(a) or not len(b):
        return pd.DataFrame(), pd.DataFrame()
    common = a.index.intersection(b.index)
    a, b = a.loc[common], b.loc[common]
    unequal = a.index[(a["start"].astype(str) != b["start"].astype(str)).to_numpy()]
    if len(unequal):
        seed, episode = unequal[0]
        raise BenchmarkError(
            f"episode {episode} of seed {seed} began in one state in "
            f"{ours.group.runs[0].folder.path}, in another in "
            f"{theirs.group.runs[0].folder.path}: delete the older run and run it again"
        )
    return a, b


def comparisons(results: Results) -> list[Comparison]:
    """All comparisons of a store, each p corrected by Holm over all of them."""
    found = [
        made
        for kind, ours, theirs, metrics in _pairs(results)
        for made in _compare(kind, ours, theirs, metrics)
    ]
    over_episodes = holm([_p(each.test) for each in found])
    over_seeds = holm([each.seeds.p for each in found])
    return [
        replace(each, p=p, p_seeds=q)
        for each, p, q in zip(found, over_episodes, over_seeds, strict=True)
    ]


def _p(test: PairedTest) -> float:
    """The test's p; where every pair differs by the same, t has no bound and p is 0."""
    return 0.0 if math.isnan(test.p) and test.n > 1 and test.difference else test.p


def _pairs(results: Results) -> Iterator[tuple[str, Row, Row | None, tuple[Metric, ...]]]:
    for row in complete(rows(results, LEARNERS)):
        yield CONTROL, row, control_of(results, row), (SUCCESS, HOLES, TIME)
    full = row_of(results, "rainbow", SCORED)
    for method in ("rrt_connect", "dqn"):  # the paper's own comparisons, on the scored track
        rival = row_of(results, method, SCORED if method in LEARNERS else "")
        yield PAPER, full, rival, (SUCCESS,)
    for ablation in labels.ABLATIONS:
        if ablation != "full":
            without = row_of(results, "rainbow", SCORED, ablation=ablation)
            yield ABLATION, without, full, (SUCCESS,)
    initial = row_of(results, "rainbow", SCORED, "initial")
    yield GEOMETRY, initial, control_of(results, initial, "initial"), (SUCCESS,)
    script = best_script(results)
    for row in complete(rows(results, LEARNERS, uncertain=True)):
        yield SCRIPT, row, script, (SUCCESS,)


def best_script(results: Results) -> Row | None:
    """Of the uncertain machine: the best method that neither learns nor knows the machine."""
    scripts = [m for m in METHODS if m not in LEARNERS and m != "optimum"]
    return best(rows(results, scripts, uncertain=True))


def _compare(
    kind: str, ours: Row, theirs: Row | None, metrics: tuple[Metric, ...]
) -> Iterator[Comparison]:
    if theirs is None:
        return
    a, b = pair(ours, theirs)
    if not len(a):
        return
    for metric in metrics:
        x, y = metric.scale * a[metric.column], metric.scale * b[metric.column]
        by_seed = (x - y).groupby(level="seed").mean().dropna()
        seeds = paired_t_test(by_seed, np.zeros(len(by_seed)))
        yield Comparison(kind, ours, theirs, metric, paired_t_test(x, y), seeds)
