"""Designs chosen by the exact optimum: Optuna's NSGA-II for success and ticks, and the front."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import NSGAIISampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import TrialState

from benchmarks.studies.base import Tick
from benchmarks.studies.codesign.spaces import (
    BOUNDS,
    MOST,
    POPULATION,
    STUDIES,
    UNBUILT,
    Reach,
    Unbuilt,
    area,
    build,
    parameters,
    rounded,
)
from coop_env.geometry import RRSGeometry

Score = Callable[[RRSGeometry], Reach]
Row = dict[str, Any]


class Search:
    """One study on disk; a call that was killed goes on as if it had not been.

    A design that cannot be assembled, or has no start state, is skipped and counted, and has no
    score. The sampler holds a design below ``floor`` for worse than any above it: one that only
    reaches the nearest targets looks quick.

    Args:
        folder: where the journal lies.
        study: of :data:`STUDIES`.
        floor: least success that counts, %.
    """

    def __init__(self, folder: Path, study: str, floor: float) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        path = str(folder / "journal.log")
        storage = JournalStorage(JournalFileBackend(path, lock_obj=JournalFileOpenLock(path)))
        self.study = optuna.create_study(
            storage=storage, study_name=study, directions=["maximize", "minimize"],
            load_if_exists=True,
        )  # fmt: skip
        self.name, self.floor = study, floor
        self._space: dict[str, BaseDistribution] = {
            name: FloatDistribution(*BOUNDS[name]) for name in STUDIES[study]
        }
        for left in self.study.get_trials(states=(TrialState.RUNNING,)):
            self.study.tell(left.number, state=TrialState.FAIL)
            self.study.enqueue_trial(left.params)  # takes the place of the one that was cut off

    def skipped(self) -> dict[str, int]:
        """How many designs were skipped, by the reason."""
        reasons = Counter(self.study.user_attrs.values())
        return {reason: reasons[reason] for reason in UNBUILT}

    def run(self, designs: int, score: Score, tick: Tick) -> list[Row]:
        """Ask until so many designs have a score; a row for each."""
        while (done := len(self._complete())) < designs:
            tick(done / designs)
            self._ask(done + sum(self.skipped().values()), score)
        return [trial.user_attrs["row"] for trial in self._complete()]

    def _complete(self) -> list[Any]:
        return self.study.get_trials(states=(TrialState.COMPLETE,))

    def _ask(self, number: int, score: Score) -> None:
        # of its own for each: what is proposed depends on the designs before it alone
        self.study.sampler = NSGAIISampler(population_size=POPULATION, seed=number)
        trial = self.study.ask(self._space)
        try:
            geometry = build(rounded(trial.params))
            result = score(geometry)
        except Unbuilt as error:
            self.study.set_user_attr(str(trial.number), str(error))
            self.study.tell(trial, state=TrialState.FAIL)
            return
        row = {"design": f"{self.name}-{number}", **row_of(self.name, geometry, result)}
        trial.set_user_attr("row", row)
        trial.set_constraint("floor", self.floor - result.success)
        ticks = result.ticks if result.success > 0.0 else float(MOST)
        self.study.tell(trial, (result.success, ticks))


def row_of(study: str, geometry: RRSGeometry, result: Reach) -> Row:
    """What designs.csv says of a design, but its name."""
    return {"study": study, **rounded(parameters(geometry)), "a_w": area(geometry), **vars(result)}
