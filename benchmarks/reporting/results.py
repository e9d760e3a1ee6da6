"""Stored runs grouped by configuration, and their metrics as values over seeds. No torch here."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, Self, cast

import numpy as np
import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.protocol import labels
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.metrics import EXPLORING, GREEDY, HOLES, SUCCESS, Metric
from benchmarks.protocol.plan import CONTROLS, DESIGN, METHODS, OPTIMUM_AT_ONCE, expand, own_error
from benchmarks.protocol.presets import Preset, load, preset_names
from benchmarks.reporting.stats import Value, bootstrap, measured, over_seeds, wilson
from benchmarks.reporting.tables.table import MISSING, Number, TableCell
from benchmarks.runs.store import RunFolder, Store

SCORED: Final = ("repaired", "safe")  # tracks of the headline; the first that a store has
DRAWN: Final = ("episode_reward", "holes", "success", "duration", "loss", "mean_max_q")
TEXTS: Final = ("start", "failure", "acting", "insertion_moves", "masks")  # columns of episodes
SEEDS: Final = 3  # of a finding; fewer are a lead
Key = tuple[str, str, str, str]  # method, ablation, geometry, track


class Level(NamedTuple):
    """Noise, error of the base in mm (None: the bound of the run's own track), way of acting."""

    noise: float = 0.0
    error: float | None = None
    acting: str = GREEDY


MAIN: Final = Level()
AS_TRAINED: Final = Level(acting=EXPLORING)


@dataclass(frozen=True, eq=False)
class Result:
    """One tested run. ``need``: the columns that its files must have."""

    need: ClassVar[dict[str, tuple[str, ...]]] = {
        "episodes": ("episode", "reset_seed", "start", "noise", "success"),
        "curve": ("timesteps", "episodes", *DRAWN),
    }
    config: dict[str, Any]
    folder: RunFolder
    episodes: pd.DataFrame

    @classmethod
    def read(cls, folder: RunFolder) -> Self:
        """A run from its folder; BenchmarkError where it is damaged or of another schema.

        It is shared by all who read the same files, and not to be written to.
        """
        return cast(Self, _read(cls, folder.path, folder.versions()))  # type: ignore[arg-type]

    @property
    def seed(self) -> int:
        return int(self.config["cell"]["seed"])

    @cached_property
    def training(self) -> dict[str, Any]:
        """What meta.json says of the training; empty for a method that does not learn."""
        return dict(self.folder.meta()["training"])

    @cached_property
    def curve(self) -> pd.DataFrame:
        """The training curve; BenchmarkError where none is stored."""
        return self.folder.curve(*self.need["curve"])

    @property
    def error(self) -> float:
        """The bound of the base's displacement on the run's track, mm."""
        machine = self.config.get("track", {}).get("sim_to_real")
        return own_error(machine) if machine else 0.0

    def test(self, level: Level = MAIN) -> pd.DataFrame:
        """Test episodes at one level, by episode; not to be written to."""
        at = level._replace(error=self.error) if level.error is None else level
        return self.levels.get(at, self.episodes.iloc[:0])

    @cached_property
    def levels(self) -> dict[Level, pd.DataFrame]:
        """Episodes by level, whose error is a number; a column that is missing has its default."""
        rows = self.episodes.sort_values("episode")
        for name, own in (("error", self.error), ("acting", GREEDY)):
            rows[name] = rows[name].fillna(own) if name in rows else own
        result = {}
        for (noise, error, acting), part in rows.groupby(["noise", "error", "acting"]):
            level = Level(float(str(noise)), float(str(error)), str(acting))
            result[level] = part.reset_index(drop=True)
        return result


@lru_cache(maxsize=10_000)  # problems, tables, figures and pages ask for the same runs
def _read(kind: type[Result], path: Path, versions: tuple[object, ...]) -> Result:
    folder = RunFolder(path)
    folder.meta()
    rows = folder.rows("episodes", *kind.need["episodes"])
    numbers = rows[[name for name in rows if name not in TEXTS]]
    odd = [*numbers.select_dtypes(exclude="number")]
    if "success" in rows and not rows["success"].isin((0, 1)).all():
        odd.append("success")
    if odd:
        raise BenchmarkError(
            f"{path / 'episodes.csv'} has values in column '{odd[0]}' that are no results; delete "
            f"{path} and run the preset again"
        )
    if "masks" in rows:  # older runs were also played under other masks than their own
        rows = rows[rows["masks"].fillna("own") == "own"].drop(columns="masks")
    return kind(folder.config(), folder, rows)


@dataclass(frozen=True)
class Group:
    """The runs of one configuration, one per seed, and the level of tests that is meant.

    ``settings`` are the track's, None without one; ``planned`` is how many runs the preset holds.
    """

    method: str
    ablation: str = "full"
    geometry: str = "optimized"
    track: str = ""
    settings: dict[str, Any] | None = None
    runs: tuple[Result, ...] = ()
    planned: int = 0
    level: Level = MAIN

    @property
    def n(self) -> int:
        return len(self.runs)

    @property
    def lead(self) -> str:
        """A remark behind a value that rests on too few seeds: it is a lead, no finding."""
        return f" ({self.n} seed{'s' * (self.n > 1)})" if 0 < self.n < SEEDS else ""

    @property
    def known(self) -> bool:
        """Whether it has runs, or the preset plans some."""
        return bool(self.n or self.planned)

    @property
    def knows(self) -> labels.Knowledge:
        """Its masks and memory."""
        return labels.knowledge(self.method, self.settings)

    @property
    def title(self) -> str:
        """The method in words; all six components off is a method of its own."""
        name = labels.METHODS.get(self.method, self.method)
        return labels.MASKED_DQN if self.ablation == "none" else name

    @property
    def name(self) -> str:
        """The method and its track in words, the main track unsaid."""
        return labels.on_track(self.title, self.track)

    @property
    def acting(self) -> str:
        """The way of acting, in words."""
        if self.level != AS_TRAINED:
            return "greedily"
        return "as trained" if self.method in LEARNERS else "5 % random moves"

    @property
    def acting_name(self) -> str:
        """The name; for a script with random moves the way of acting too."""
        explores = self.level == AS_TRAINED and self.method in CONTROLS
        return f"{self.name}, {self.acting}" if explores else self.name

    def at(self, level: Level) -> Group:
        """The same runs at another level."""
        return replace(self, level=level)

    def as_trained(self) -> Group:
        """The same runs, acting as they explore, if they were tested so; else unchanged."""
        other = self.at(AS_TRAINED)
        return other if other.success().n else self

    def both(self) -> list[Group]:
        """The runs acting greedily, and as trained if they were tested so."""
        trained = self.as_trained()
        return [self, trained] if trained != self else [self]

    def tests(self) -> list[pd.DataFrame]:
        """Test episodes of each run that has some."""
        return [rows for rows in (run.test(self.level) for run in self.runs) if len(rows)]

    def value(self, metric: Metric) -> Value:
        """A metric of each seed's test episodes, over seeds, with a 95 % interval.

        Several seeds: Student's interval over seeds. One: over its episodes, Wilson's interval of
        a proportion and else the bootstrap of a mean.
        """
        tests = self.tests()
        value = measured([metric.reduce(rows) for rows in tests])
        if value.n != 1:
            return value
        (episodes,) = (x for x in map(metric.values, tests) if len(x))
        proportion = (int(episodes.sum()), len(episodes))
        low, high = wilson(*proportion) if metric.proportion else bootstrap([episodes], np.mean)
        return replace(value, low=metric.scale * low, high=metric.scale * high)

    def success(self) -> Value:
        """Success rate in %, with a 95 % interval."""
        return self.value(SUCCESS)

    def singular_per_1000(self) -> Value:
        """Singularity terminations per 1000 training episodes, with an interval as for success."""
        training = [run.training for run in self.runs if run.training.get("episodes")]
        value = measured([1000.0 * t["singular"] / t["episodes"] for t in training])
        if value.n != 1:
            return value
        low, high = wilson(training[0]["singular"], training[0]["episodes"])
        return replace(value, low=1000.0 * low, high=1000.0 * high)

    def steps_to_75(self) -> Value:
        """Training steps to 75 % success, in 1e5, over the seeds that reached it."""
        steps = [run.training.get("steps_to_75") for run in self.runs]
        return measured([math.nan if x is None else 1e-5 * float(x) for x in steps])

    def curves(self) -> list[pd.DataFrame]:
        """The stored training curves, one per seed."""
        return [run.curve for run in self.runs if run.folder.has_rows("curve")]

    def beside(self, other: Group) -> Iterator[tuple[Result, Result, pd.DataFrame]]:
        """For each seed of both: the runs, and the episodes of both, theirs ``column_other``."""
        theirs = {run.seed: run for run in other.runs}
        for run in self.runs:
            if (its := theirs.get(run.seed)) is not None:
                rows, beside = run.test(self.level), its.test(other.level)
                yield run, its, rows.merge(beside, on="episode", suffixes=("", "_other"))

    def excess(self, optimum: Group) -> Value:
        """Moves to the first insertion above the optimum's, in %, on starts that both solved."""
        values = []
        for _, _, both in self.beside(optimum):
            both = both[(both["success"] == 1) & (both["success_other"] == 1)]
            if len(both):
                ratio = both["moves_first"].sum() / both["moves_first_other"].sum()
                values.append(100.0 * (ratio - 1.0))
        return over_seeds(values)

    def cell(self, value: Value, digits: int = 1, paper: str = "", suffix: str = "") -> TableCell:
        """A value of the runs, or the word for its absence."""
        absent = MISSING if self.planned else "-"
        return Number(value, digits, suffix, paper) if self.n else absent

    def measure(self, metric: Metric, paper: str = "") -> TableCell:
        """A metric, or a dash if the runs' test episodes do not have it."""
        value = self.value(metric)
        return self.cell(value, metric.digits, paper) if value.n or not self.n else "-"

    def tested(self, level: Level) -> TableCell:
        """The success rate at another level, or a dash if it was not tested there."""
        return self.at(level).measure(SUCCESS)


class Results:
    """All complete runs of a store; ``settings`` are their tracks', as run or as planned."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.design: RunFolder | None = None
        planned, self.settings = _planned(store)
        self.design_planned = bool(planned.pop((DESIGN, "full", "optimized", ""), 0))
        self.planned = sum(planned.values())  # runs, beside the design
        runs: dict[Key, list[Result]] = {}
        for folder in store.completed():
            if folder.id == DESIGN:
                self.design = folder
                continue
            run = Result.read(folder)
            cell = run.config["cell"]
            key = (cell["method"], cell["ablation"], cell["geometry"], cell["track"])
            mine = runs.setdefault(key, [])
            mine.append(run)
            mine[0].folder.check_alike(folder.id, run.config)
            if "track" in run.config:  # the run's own settings count, not the preset's of today
                self.settings[cell["track"]] = run.config["track"]
        runs |= {key: [] for key in planned if key not in runs}
        self.groups = {
            key: Group(
                *key,
                settings=mine[0].config.get("track") if mine else self.settings.get(key[3]),
                runs=tuple(sorted(mine, key=attrgetter("seed"))),
                planned=planned[key],
            )
            for key, mine in runs.items()
        }

    def group(
        self, method: str, track: str = "", geometry: str = "optimized", ablation: str = "full"
    ) -> Group:
        """The runs of one configuration, whether it was run or not."""
        key = (method, ablation, geometry, track)
        return self.groups.get(key) or Group(*key, settings=self.settings.get(track))

    def tracks(self, teams: bool = False) -> list[str]:
        """Tracks of robots that move in turn, or with ``teams`` at once; the usual ones first."""
        tracks = in_order({key[3] for key in self.groups if key[3]})
        return [t for t in tracks if bool(self.settings.get(t, {}).get("team")) == teams]

    def uncertain(self, track: str) -> bool:
        """Whether a track's machine stands where the model does not know."""
        return bool(self.settings.get(track, {}).get("sim_to_real"))

    def all(self) -> list[Result]:
        """Every run but the geometric optimization."""
        return [run for group in self.groups.values() for run in group.runs]

    def rows(
        self, among: Collection[str] = METHODS, uncertain: bool = False, geometry: str = "optimized"
    ) -> list[Group]:
        """Methods of robots that move in turn, track by track, then the planners of none."""
        result = []
        for track in [t for t in self.tracks() if self.uncertain(t) == uncertain]:
            for method in among:
                result.append(self.group(method, track, geometry))
                if method == "rainbow":
                    result.append(self.group(method, track, geometry, "none"))
        if not uncertain:
            in_turn = [method for method in among if method != OPTIMUM_AT_ONCE]
            result += [self.group(method, "", geometry) for method in in_turn]
        result = [row for row in result if row.known]
        if uncertain:  # by method over all tracks of the machine, the ceiling last
            result.sort(key=lambda row: (row.method == "optimum", METHODS.index(row.method)))
        return result

    @property
    def scored(self) -> str:
        """The track of the headline: the first that Rainbow, or else any learner, learned on."""
        for methods in (("rainbow",), LEARNERS):
            for track in SCORED:
                if any(self.group(method, track).known for method in methods):
                    return track
        return SCORED[0]

    def control_of(self, row: Group, geometry: str = "optimized") -> Group | None:
        """The best control with a learner's masks, memory, task and way of acting, or None."""
        result = _alike(row, self.rows(CONTROLS, self.uncertain(row.track), geometry))
        alike = [each for each in result if each.knows == row.knows]
        return best(each.as_trained() if row.level == AS_TRAINED else each for each in alike)

    def best_script(self, row: Group) -> Group | None:
        """The best control or planner that does not know the row's uncertain machine, or None."""
        scripts = [m for m in METHODS if m not in LEARNERS and m != "optimum"]
        return best(_alike(row, self.rows(scripts, uncertain=True)))

    def references(self, track: str) -> list[Group]:
        """Bounds of a track's learners: the best control that knows as much, and the optimum."""
        row = self.group("rainbow", track)
        control = self.control_of(row.as_trained())
        optima = [self.group("optimum")]
        if self.uncertain(track):
            known = complete(_alike(row, self.rows(("optimum",), uncertain=True)))[:1]
            optima = [replace(optimum, track=track) for optimum in known]
        return complete([*([control] if control else []), *optima])


def in_order(tracks: Iterable[str]) -> list[str]:
    """Tracks in the usual order, others after them."""
    usual, names = list(labels.TRACKS), sorted(tracks)
    return sorted(names, key=lambda track: usual.index(track) if track in usual else len(usual))


def complete(result: Iterable[Group]) -> list[Group]:
    """The groups that have runs."""
    return [row for row in result if row.n]


def best(result: Iterable[Group]) -> Group | None:
    """The group with runs whose success rate is highest; of equals the one with most holes."""
    return max(
        complete(result), key=lambda row: (row.success().mean, row.value(HOLES).mean), default=None
    )


def _world(row: Group) -> list[Any]:
    """What decides a track's task besides masks: the end of episodes, the machine, the dome."""
    defaults = {"collision": "refuse", "sim_to_real": None, "task": None, "shield": None}
    return [(row.settings or {}).get(name, default) for name, default in defaults.items()]


def _alike(row: Group, among: Iterable[Group]) -> list[Group]:
    """The groups with the same task as a row."""
    return [each for each in among if _world(each) == _world(row)]


def _planned(store: Store) -> tuple[Counter[Key], dict[str, dict[str, Any]]]:
    """How many runs of each configuration the store's preset holds, and its tracks, if known."""
    name = store.folder.name
    preset = load(name) if name in preset_names() else None
    if not isinstance(preset, Preset):  # a file of the user's may have a public preset's name
        return Counter(), {}
    planned = Counter((c.method, c.ablation, c.geometry, c.track) for c in expand(preset))
    return planned, {name: asdict(track) for name, track in preset.tracks.items()}


def tail_mean(curve: pd.DataFrame, column: str) -> float:
    """Mean over the episodes that ended in the last tenth of a training run's steps.

    A row of the curve holds the mean of the episodes since the row before, as many as the count has
    grown by. NaN if no episode ended there.
    """
    ended = curve["episodes"].diff().fillna(curve["episodes"])
    late = (curve["timesteps"] > 0.9 * curve["timesteps"].max()) & (ended > 0)
    weights = ended[late]
    if not len(weights):
        return math.nan
    return float((curve.loc[late, column] * weights).sum() / weights.sum())
