"""Stored runs grouped by configuration, and their metrics as values over seeds. No torch here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import pandas as pd

from benchmarks.protocol.metrics import SUCCESS, Metric
from benchmarks.protocol.plan import DESIGN, LEARNERS, expand
from benchmarks.protocol.presets import load_preset, preset_names
from benchmarks.reporting.stats import Value, mean_interval, measured, over_seeds, wilson
from benchmarks.runs.store import RunFolder, Store

TRACK_ORDER: Final = ("printed", "repaired", "tuned")
Key = tuple[str, str, str, str]  # method, ablation, geometry, track


@dataclass(frozen=True)
class Result:
    """One complete run."""

    seed: int
    config: dict[str, Any]
    meta: dict[str, Any]
    folder: RunFolder
    episodes: pd.DataFrame

    def test(self, noise: float = 0.0) -> pd.DataFrame:
        """Test episodes at one level of observation noise, by episode; not to be written to."""
        return self._by_noise.get(noise, self.episodes.iloc[:0])

    @cached_property
    def _by_noise(self) -> dict[float, pd.DataFrame]:
        return {
            float(str(noise)): rows.sort_values("episode").reset_index(drop=True)
            for noise, rows in self.episodes.groupby("noise")
        }


@dataclass(frozen=True)
class Group:
    """The runs of one configuration, one per seed; empty if there are none.

    ``planned`` is how many the preset holds, 0 where that is not known.
    """

    runs: tuple[Result, ...] = ()
    planned: int = 0

    @property
    def n(self) -> int:
        return len(self.runs)

    @property
    def absent(self) -> str:
        """What a cell says where no run is complete."""
        return "missing" if self.planned else "-"

    def value(self, metric: Metric, noise: float = 0.0) -> Value:
        """A metric of each seed's test episodes, over seeds, with a 95 % interval.

        One seed: over its episodes, Wilson's interval of a proportion and else the bootstrap of a
        mean. Several: the stratified bootstrap over seeds.
        """
        tests = [rows for rows in (run.test(noise) for run in self.runs) if len(rows)]

        def alone() -> tuple[float, float]:
            (episodes,) = (x for x in (metric.values(rows) for rows in tests) if len(x))
            proportion = (int(episodes.sum()), len(episodes))
            low, high = wilson(*proportion) if metric.proportion else mean_interval(episodes)
            return metric.scale * low, metric.scale * high

        return measured([metric.reduce(rows) for rows in tests], alone)

    def success(self, noise: float = 0.0) -> Value:
        """Success rate in %, with a 95 % interval."""
        return self.value(SUCCESS, noise)

    def change(self, noise: float) -> Value:
        """Change of the success rate, in points, from no noise to ``noise``, with an interval.

        One seed: over its episodes, which are the same at either level.
        """
        pairs = [(run.test()["success"], run.test(noise)["success"]) for run in self.runs]
        changes = [100.0 * (b - a).to_numpy(dtype=float) for a, b in pairs if len(a) == len(b)]
        return measured([each.mean() for each in changes], lambda: mean_interval(changes[0]))

    def singular_per_1000(self) -> Value:
        """Singularity terminations per 1000 training episodes, with an interval as for success."""
        counts = [(t["singular"], t["episodes"]) for t in self._training() if t["episodes"]]

        def alone() -> tuple[float, float]:
            low, high = wilson(*counts[0])
            return 1000.0 * low, 1000.0 * high

        return measured([1000.0 * singular / episodes for singular, episodes in counts], alone)

    def _training(self) -> list[dict[str, Any]]:
        return [run.meta["training"] for run in self.runs if run.meta["training"]]

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
        found: dict[Key, list[Result]] = {}
        for folder in store.completed():
            config = folder.config()
            cell = config["cell"]
            if cell["method"] == DESIGN:
                self.design = folder
                continue
            key = (cell["method"], cell["ablation"], cell["geometry"], cell["track"])
            result = Result(cell["seed"], config, folder.meta(), folder, folder.rows("episodes"))
            found.setdefault(key, []).append(result)
        self.planned = _planned(store)
        self._groups = {
            key: Group(
                tuple(sorted(found.get(key, []), key=lambda r: r.seed)), self.planned.get(key, 0)
            )
            for key in {**found, **self.planned}
        }

    def group(
        self, method: str, geometry: str = "optimized", track: str = "", ablation: str = "full"
    ) -> Group:
        """The runs of one configuration."""
        return self._groups.get((method, ablation, geometry, track), Group())

    def tracks(self) -> list[str]:
        """Tracks that are planned or were run, in the order printed, repaired, tuned, others."""
        names = {key[3] for key in self._groups if key[3]}
        known = [track for track in TRACK_ORDER if track in names]
        return known + sorted(names - set(TRACK_ORDER))

    def learners(self, track: str) -> list[tuple[str, Group]]:
        """(method, runs) of the learners of a track that are planned or were run; DQN first."""
        order = ("dqn", "rainbow", *(m for m in LEARNERS if m not in ("dqn", "rainbow")))
        found = [(method, self.group(method, track=track)) for method in order]
        return [(method, group) for method, group in found if group.n or group.planned]

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


def _planned(store: Store) -> dict[Key, int]:
    """How many runs of each configuration the store's preset holds; empty if it is not at hand."""
    if store.folder.name not in preset_names():
        return {}
    planned: dict[Key, int] = {}
    for cell in expand(load_preset(store.folder.name)):
        if cell.method != DESIGN:
            key = (cell.method, cell.ablation, cell.geometry, cell.track)
            planned[key] = planned.get(key, 0) + 1
    return planned


def tail_mean(curve: pd.DataFrame, column: str, share: float = 0.1) -> float:
    """Mean over the episodes that ended in the last ``share`` of a training run's steps.

    A row of the curve holds the mean of the episodes since the row before, as many as the count has
    grown by.

    Args:
        curve: rows of ``curve.csv``.
        column: episode_reward, holes, success or duration.
        share: of the steps.

    Returns:
        The mean; NaN if no episode ended there.
    """
    ended = curve["episodes"].diff().fillna(curve["episodes"])
    late = (curve["timesteps"] > (1.0 - share) * curve["timesteps"].max()) & (ended > 0)
    weights = ended[late]
    if not len(weights):
        return math.nan
    return float((curve.loc[late, column] * weights).sum() / weights.sum())


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
