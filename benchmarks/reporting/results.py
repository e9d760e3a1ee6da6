"""Stored runs grouped by configuration, and their metrics as values over seeds. No torch here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import pandas as pd

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import GREEDY, SUCCESS, Metric
from benchmarks.protocol.plan import DESIGN, METHODS, expand, own_error
from benchmarks.protocol.presets import as_dict, load_preset, preset_names
from benchmarks.reporting.stats import Value, mean_interval, measured, over_seeds, wilson
from benchmarks.runs.store import RunFolder, Store

TRACK_ORDER: Final = tuple(labels.TRACKS)
Key = tuple[str, str, str, str]  # method, ablation, geometry, track
LevelKey = tuple[float, float, str]  # noise, error, acting


@dataclass(frozen=True)
class Level:
    """Under what test episodes were played: noise, the error of the base in mm, way of acting.

    An ``error`` of None stands for the bound of the run's own track.
    """

    noise: float = 0.0
    error: float | None = None
    acting: str = GREEDY


MAIN: Final = Level()


@dataclass(frozen=True, eq=False)
class Result:
    """One complete run."""

    seed: int
    config: dict[str, Any]
    meta: dict[str, Any]
    folder: RunFolder
    episodes: pd.DataFrame

    @classmethod
    def read(cls, folder: RunFolder, meta: dict[str, Any] | None = None) -> Result:
        """A run from its folder; without a meta.json of its own, it has the one that is given."""
        config = folder.config()
        stored = folder.meta() if meta is None else meta
        rows = folder.rows("episodes")
        if "masks" in rows:  # older runs were also played under other masks than their own
            rows = rows[rows["masks"].fillna("own") == "own"].drop(columns="masks")
        return cls(config["cell"]["seed"], config, stored, folder, rows)

    @property
    def error(self) -> float:
        """The bound of the base's displacement on the run's track, mm."""
        machine = self.config.get("track", {}).get("sim_to_real")
        return own_error(machine) if machine else 0.0

    def test(self, level: Level = MAIN) -> pd.DataFrame:
        """Test episodes at one level, by episode; not to be written to."""
        error = self.error if level.error is None else level.error
        key = (level.noise, error, level.acting)
        return self.levels.get(key, self.episodes.iloc[:0])

    @cached_property
    def levels(self) -> dict[LevelKey, pd.DataFrame]:
        """Episodes by (noise, error, acting); a column that is missing has its default."""
        columns: dict[str, Any] = {"error": self.error, "acting": GREEDY}
        rows = self.episodes.assign(
            **{
                name: self.episodes[name].fillna(own) if name in self.episodes else own
                for name, own in columns.items()
            }
        )
        result = {}
        for (noise, error, acting), part in rows.groupby(["noise", *columns]):
            level = (float(str(noise)), float(str(error)), str(acting))
            result[level] = part.sort_values("episode").reset_index(drop=True)
        return result


@dataclass(frozen=True, eq=False)
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
    def known(self) -> bool:
        """Whether there are runs, or are to be some."""
        return bool(self.n or self.planned)

    @property
    def absent(self) -> str:
        """What a cell says where no run is complete."""
        return "missing" if self.planned else "-"

    def value(self, metric: Metric, level: Level = MAIN) -> Value:
        """A metric of each seed's test episodes, over seeds, with a 95 % interval.

        Several seeds: Student's interval over seeds. One: over its episodes, Wilson's interval of
        a proportion and else the bootstrap of a mean.
        """
        tests = [rows for rows in (run.test(level) for run in self.runs) if len(rows)]

        def alone() -> tuple[float, float]:
            (episodes,) = (x for x in (metric.values(rows) for rows in tests) if len(x))
            proportion = (int(episodes.sum()), len(episodes))
            low, high = wilson(*proportion) if metric.proportion else mean_interval(episodes)
            return metric.scale * low, metric.scale * high

        return measured([metric.reduce(rows) for rows in tests], alone)

    def success(self, level: Level = MAIN) -> Value:
        """Success rate in %, with a 95 % interval."""
        return self.value(SUCCESS, level)

    def change(self, noise: float) -> Value:
        """Change of the success rate, in points, from no noise to ``noise``, with an interval.

        One seed: over its episodes, which are the same at either level.
        """
        noisy = Level(noise)
        pairs = [(run.test()["success"], run.test(noisy)["success"]) for run in self.runs]
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

    def pooled(self, level: Level = MAIN) -> pd.DataFrame:
        """All test episodes of all seeds, indexed by initial state for pairing."""
        frames = [run.test(level).assign(seed=run.seed) for run in self.runs]
        if not frames:
            return pd.DataFrame()
        return pd.concat(frames).set_index(["seed", "episode"])


class Results:
    """All complete runs of a store."""

    def __init__(self, store: Store) -> None:
        self.design: RunFolder | None = None
        result: dict[Key, list[Result]] = {}
        for folder in store.completed():
            if folder.id == DESIGN:
                self.design = folder
                continue
            run = Result.read(folder)
            cell = run.config["cell"]
            key = (cell["method"], cell["ablation"], cell["geometry"], cell["track"])
            result.setdefault(key, []).append(run)
        self.planned, self._settings = _planned(store)
        self._groups = {
            key: Group(
                tuple(sorted(result.get(key, []), key=lambda r: r.seed)), self.planned.get(key, 0)
            )
            for key in {**result, **self.planned}
        }
        for run in self.all():  # what was run counts, not what the preset says today
            if "track" in run.config:
                self._settings[run.config["cell"]["track"]] = run.config["track"]

    def group(
        self, method: str, geometry: str = "optimized", track: str = "", ablation: str = "full"
    ) -> Group:
        """The runs of one configuration."""
        return self._groups.get((method, ablation, geometry, track), Group())

    def tracks(self) -> list[str]:
        """Tracks that are planned or were run, the usual ones in their order first; no team's."""
        return [track for track in self._tracks() if not self._team(track)]

    def teams(self) -> list[str]:
        """The tracks of robots that move at once."""
        return [track for track in self._tracks() if self._team(track)]

    def _tracks(self) -> list[str]:
        return in_order({key[3] for key in self._groups if key[3]})

    def _team(self, track: str) -> bool:
        return bool((self.settings(track) or {}).get("team"))

    def settings(self, track: str) -> dict[str, Any] | None:
        """What a track's runs were given, or their preset; None where there is neither."""
        return self._settings.get(track)

    def uncertain(self, track: str) -> bool:
        """Whether a track's machine stands where the model does not know."""
        return bool((self.settings(track) or {}).get("sim_to_real"))

    def methods(
        self, track: str, among: Sequence[str] = METHODS, geometry: str = "optimized"
    ) -> list[tuple[str, Group]]:
        """(method, runs) of a track, or of none, that are planned or were run."""
        result = [(method, self.group(method, geometry, track)) for method in among]
        return [(method, group) for method, group in result if group.n or group.planned]

    def levels(self) -> list[LevelKey]:
        """(noise, error, acting) at which any run was tested, in order."""
        return sorted({level for run in self.all() for level in run.levels})

    def all(self) -> list[Result]:
        """Every run but the geometric optimization."""
        return [run for group in self._groups.values() for run in group.runs]


def in_order(tracks: Iterable[str]) -> list[str]:
    """Tracks in the usual order, others after them."""
    names = set(tracks)
    known = [track for track in TRACK_ORDER if track in names]
    return known + sorted(names - set(TRACK_ORDER))


def _planned(store: Store) -> tuple[dict[Key, int], dict[str, dict[str, Any]]]:
    """How many runs of each configuration the store's preset holds, and its tracks.

    Both are empty if the preset is not at hand.
    """
    if store.folder.name not in preset_names():
        return {}, {}
    preset = load_preset(store.folder.name)
    planned: dict[Key, int] = {}
    for cell in expand(preset):
        if cell.method != DESIGN:
            key = (cell.method, cell.ablation, cell.geometry, cell.track)
            planned[key] = planned.get(key, 0) + 1
    return planned, {name: as_dict(track) for name, track in preset.tracks.items()}


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


def excess_over_optimum(ours: Group, optimum: Group, level: Level = MAIN) -> Value:
    """Moves to the first insertion above the optimum's, in %, on starts that both solved."""
    values = []
    best = {run.seed: run.test() for run in optimum.runs}
    for run in ours.runs:
        if run.seed not in best:
            continue
        both = run.test(level).merge(best[run.seed], on="episode", suffixes=("", "_optimum"))
        both = both[(both["success"] == 1) & (both["success_optimum"] == 1)]
        if len(both):
            values.append(
                100.0 * (both["moves_first"].sum() / both["moves_first_optimum"].sum() - 1.0)
            )
    return over_seeds(values)
