"""Comparisons that a sentence rests on: paired over seeds, and corrected within a question."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.metrics import SUCCESS
from benchmarks.protocol.plan import LEARNERS
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import (
    Row,
    best_script,
    complete,
    control_of,
    row_of,
    rows,
    scored,
)
from benchmarks.reporting.stats import Value, holm, measured, paired_t_test

CONTROL: Final = "Learner against the best script that knows the same"
MASKED: Final = "Rainbow against masked DQN and other learners"
ABLATION: Final = "One component removed against all six"
GEOMETRY: Final = "Initial geometry against optimized"
SCRIPT: Final = "Learner against the best script on the uncertain machine"


@dataclass(frozen=True)
class Comparison:
    """Success rates of two rows: one difference per seed, so that it speaks of other trainings.

    ``difference`` is in points, with Student's interval; ``p`` is two-sided, and ``p_holm``
    corrected over the comparisons of the same question.
    """

    question: str
    ours: Row
    theirs: Row
    difference: Value
    p: float
    p_holm: float

    @property
    def name(self) -> str:
        """What is compared, in words: without which component, or on which geometry."""
        cell = self.ours.group.runs[0].config["cell"]
        name = self.ours.name
        if cell["ablation"] not in ("full", "none"):
            name = f"{labels.ABLATIONS[cell['ablation']]}, {labels.track(self.ours.track)}"
        return name if cell["geometry"] == "optimized" else f"{name}, {cell['geometry']} geometry"


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
    """All comparisons of a store, each p corrected by Holm over those of its question."""
    result: list[Comparison] = []
    for question, pairs in _questions(results).items():
        differences = [_differences(question, *each) for each in pairs]
        tests = [paired_t_test(each, np.zeros_like(each)) for each in differences]
        corrected = holm([test.p for test in tests])
        for (ours, theirs), each, test, p in zip(pairs, differences, tests, corrected, strict=True):
            value = measured([float(x) for x in each], lambda: (np.nan, np.nan))
            result.append(Comparison(question, ours, theirs, value, test.p, p))
    return result


def find(compared: list[Comparison], question: str, ours: Row) -> Comparison | None:
    """The comparison of a row, if its runs are there."""
    return next((c for c in compared if (c.question, c.ours) == (question, ours)), None)


def _differences(question: str, ours: Row, theirs: Row) -> np.ndarray:
    """Ours minus theirs in points, (seeds,) of those that both have."""
    if question != GEOMETRY:  # whose starts are those of either geometry
        a, b = pair(ours, theirs)
        column = SUCCESS.column
        by_seed = 100.0 * (a[column] - b[column]).groupby(level="seed").mean()
        return np.asarray(by_seed, dtype=np.float64)
    means = [
        {run.seed: 100.0 * float(run.test(row.level)[SUCCESS.column].mean())
         for run in row.group.runs}
        for row in (ours, theirs)
    ]  # fmt: skip
    return np.array([means[0][seed] - means[1][seed] for seed in means[0] if seed in means[1]])


def _questions(results: Results) -> dict[str, list[tuple[Row, Row]]]:
    asked: dict[str, list[tuple[Row, Row]]] = {}
    for question, ours, theirs in _pairs(results):
        if theirs is None or not ours.group.n or not theirs.group.n:
            continue
        seeds = {run.seed for run in ours.group.runs} & {run.seed for run in theirs.group.runs}
        if seeds:
            asked.setdefault(question, []).append((ours, theirs))
    return asked


def _both(row: Row) -> list[Row]:
    """The row greedily, and as trained if it was tested so."""
    return [row, row.as_trained()] if row.as_trained() != row else [row]


def _pairs(results: Results) -> Iterator[tuple[str, Row, Row | None]]:
    for row in complete(rows(results, LEARNERS)):
        for each in _both(row):
            yield CONTROL, each, control_of(results, each)
    track = scored(results)
    full = row_of(results, "rainbow", track)
    others = [row_of(results, "rainbow", track, ablation="none")]
    others += [row_of(results, method, track) for method in LEARNERS if method != "rainbow"]
    for other in others:
        for ours, theirs in zip(_both(full), _both(other), strict=False):
            yield MASKED, ours, theirs
    for ablation in labels.ABLATIONS:
        if ablation not in ("full", "none"):
            without = row_of(results, "rainbow", track, ablation=ablation)
            yield ABLATION, without.as_trained(), full.as_trained()
    initial = row_of(results, "rainbow", track, "initial")
    yield GEOMETRY, initial.as_trained(), full.as_trained()
    script = best_script(results)
    for row in complete(rows(results, LEARNERS, uncertain=True)):
        yield SCRIPT, row, script
