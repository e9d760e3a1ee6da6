"""Stored runs of the classic tasks as numbers over seeds. No torch here."""

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from benchmarks.protocol.plan import Cell, expand, settings
from benchmarks.protocol.presets import SuitePreset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.results import Result
from benchmarks.reporting.stats import Array, Value, measured, over_seeds
from benchmarks.reporting.verify import check_meta, check_seeds
from benchmarks.runs.store import Store


class Run(Result):
    """One complete run of a learner or a control."""

    need: ClassVar = {
        "episodes": ("episode", "seed", "return"),
        "curve": ("timesteps", "return_mean"),
    }

    @property
    def score(self) -> float:
        """Mean return of the final test."""
        return float(self.episodes["return"].mean())

    def steps_to(self, goal: float) -> float:
        """Environment steps at the first evaluation with a mean return of ``goal``, or NaN."""
        reached = self.curve[self.curve["return_mean"] >= goal]
        return float(reached["timesteps"].iloc[0]) if len(reached) else math.nan


class SuiteResults:
    """The complete runs of a preset."""

    def __init__(self, preset: SuitePreset, store: Store) -> None:
        self.preset, self.root = preset, store.folder.parent.parent  # of all results
        self.all: dict[Cell, Run] = {}
        self.missing = 0
        for cell in expand(preset):
            folder = store.run(cell.id)
            folder.check_config(settings(preset, cell))
            if folder.is_complete():
                self.all[cell] = Run.read(folder)
            else:
                self.missing += 1

    def problems(self) -> list[str]:
        """A sentence for each run in the wrong folder, or without its seed's test episodes."""
        result = []
        for cell, run in self.all.items():
            problems = check_meta(run.folder)
            seeds = episode_seeds(cell.seed, self.preset.final_episodes)
            problems += check_seeds(run.episodes, "seed", seeds)
            if (named := run.folder.meta()["cell"]) != cell.id:
                problems.append(f"meta.json is of the run '{named}'")
            if cell.learns:
                _ = run.curve  # an error if it is missing
            result += [f"{run.folder.path}: {problem}" for problem in problems]
        return result

    def runs(self, task: str, method: str) -> list[Run]:
        """The runs of a method or a control on a task, by seed."""
        mine = [cell for cell in self.all if (cell.track, cell.method) == (task, method)]
        return [self.all[cell] for cell in sorted(mine)]

    def score(self, task: str, method: str) -> Value:
        """Final test: mean over seeds of the mean return, with :func:`student`'s interval."""
        return student([run.score for run in self.runs(task, method)])

    def scores(self, method: str, tasks: Sequence[str]) -> Array:
        """Final tests (seeds, tasks) of a method, as many seeds as it has on all of the tasks.

        Scaled so that on each task the worst run of any method is 0 and the best is 1: tasks count
        alike, and no published constant decides how much.
        """
        columns = []
        for task in tasks:
            everyone = [run.score for name in self.preset.methods for run in self.runs(task, name)]
            low, high = min(everyone, default=0.0), max(everyone, default=0.0)
            scale = high - low if high > low else 1.0
            columns.append([(run.score - low) / scale for run in self.runs(task, method)])
        complete = min(map(len, columns), default=0)
        return np.array([column[:complete] for column in columns], dtype=np.float64).T


def student(scores: Sequence[float]) -> Value:
    """Mean of one number per seed, with Student's 95 % interval from three seeds on.

    For so few numbers the bootstrap's percentiles are too narrow.
    """
    return measured(scores) if len(scores) > 2 else over_seeds(scores)


def with_interval(value: Value, digits: int | None = None) -> str:
    """A mean with its interval, if it has one, as tables show it."""
    if math.isnan(value.mean):
        return "-"
    if digits is None:
        digits = 0 if abs(value.mean) >= 100 else 1
    interval = "" if math.isnan(value.low) else f" {value.interval_text(digits)}"
    return f"{value.mean:.{digits}f}{interval}"
