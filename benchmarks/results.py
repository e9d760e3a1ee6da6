"""Stored runs grouped by configuration, and their metrics as values over seeds. No torch here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import pandas as pd

from benchmarks.stats import Value, means, over_seeds, stratified_bootstrap, wilson
from benchmarks.store import RunFolder, Store

TRACK_ORDER: Final = ("printed", "repaired", "tuned")


@dataclass(frozen=True)
class Result:
    """One complete run."""

    seed: int
    config: dict[str, Any]
    meta: dict[str, Any]
    folder: RunFolder
    episodes: pd.DataFrame

    def test(self, noise: float = 0.0) -> pd.DataFrame:
        """Test episodes at one level of observation noise, by episode."""
        rows = self.episodes[self.episodes["noise"] == noise]
        return rows.sort_values("episode").reset_index(drop=True)


@dataclass(frozen=True)
class Group:
    """The runs of one configuration, one per seed; empty if there are none."""

    runs: tuple[Result, ...] = ()

    @property
    def n(self) -> int:
        return len(self.runs)

    def value(self, reduce: Callable[[pd.DataFrame], float], noise: float = 0.0) -> Value:
        """``reduce`` of each seed's test episodes, over seeds."""
        return over_seeds([reduce(run.test(noise)) for run in self.runs])

    def success(self, noise: float = 0.0) -> Value:
        """Success rate in %, with a 95 % interval.

        One seed: Wilson's interval over its episodes. Several: the stratified bootstrap over seeds.
        """
        tests = [run.test(noise) for run in self.runs]
        tests = [rows for rows in tests if len(rows)]
        rates = [100.0 * float(rows["success"].mean()) for rows in tests]
        value = over_seeds(rates)
        if value.n == 1:
            low, high = wilson(int(tests[0]["success"].sum()), len(tests[0]))
            return Value(value.mean, value.std, 1, 100 * low, 100 * high)
        if value.n > 1:
            low, high = stratified_bootstrap([[rate] for rate in rates], means)
            return Value(value.mean, value.std, value.n, low, high)
        return value

    def meta(self, key: str, scale: float = 1.0) -> Value:
        """A number of meta.json over seeds; null counts as not observed."""
        numbers = [run.meta["training"].get(key) for run in self.runs]
        return over_seeds([math.nan if x is None else scale * float(x) for x in numbers])

    def pooled(self, noise: float = 0.0) -> pd.DataFrame:
        """All test episodes of all seeds, indexed by initial state for pairing."""
        frames = [run.test(noise).assign(seed=run.seed) for run in self.runs]
        if not frames:
            return pd.DataFrame()
        return pd.concat(frames).set_index(["seed", "episode"])


class Results:
    """All complete runs of a store."""

    def __init__(self, store: Store) -> None:
        self.design: RunFolder | None = None
        found: dict[tuple[str, str, str, str], list[Result]] = {}
        for folder in store.completed():
            config = folder.config()
            cell = config["cell"]
            if cell["method"] == "design":
                self.design = folder
                continue
            key = (cell["method"], cell["ablation"], cell["geometry"], cell["track"])
            result = Result(cell["seed"], config, folder.meta(), folder, folder.rows("episodes"))
            found.setdefault(key, []).append(result)
        self._groups = {
            key: Group(tuple(sorted(runs, key=lambda r: r.seed))) for key, runs in found.items()
        }

    def group(
        self, method: str, geometry: str = "optimized", track: str = "", ablation: str = "full"
    ) -> Group:
        """The runs of one configuration."""
        return self._groups.get((method, ablation, geometry, track), Group())

    def tracks(self) -> list[str]:
        """Tracks that any learner ran in, in the order printed, repaired, tuned, others."""
        names = {key[3] for key in self._groups if key[3]}
        known = [track for track in TRACK_ORDER if track in names]
        return known + sorted(names - set(TRACK_ORDER))

    def noise_levels(self) -> list[float]:
        """Levels of observation noise that any run was tested at."""
        levels: set[float] = set()
        for group in self._groups.values():
            for run in group.runs:
                levels.update(float(x) for x in run.episodes["noise"].unique())
        return sorted(levels)

    def all(self) -> list[Result]:
        """Every run but the geometric optimization."""
        return [run for group in self._groups.values() for run in group.runs]


def excess_over_optimum(ours: Group, optimum: Group) -> Value:
    """Moves to the first insertion above the optimum's, in %, on starts that both solved."""
    values = []
    best = {run.seed: run.test() for run in optimum.runs}
    for run in ours.runs:
        if run.seed not in best:
            continue
        both = run.test().merge(best[run.seed], on="episode", suffixes=("", "_optimum"))
        both = both[(both["success"] == 1) & (both["success_optimum"] == 1)]
        if len(both):
            values.append(
                100.0 * (both["moves_first"].sum() / both["moves_first_optimum"].sum() - 1.0)
            )
    return over_seeds(values)
