"""The search's study: what is searched, how a configuration is named, and Optuna's storage.

The journal is appended to and never rewritten, so that a study survives being killed; a trial that
was under way is taken up again, from the checkpoints of its trainings.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.samplers import BaseSampler, GridSampler, TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.paper_values import HYPERPARAMETERS
from benchmarks.protocol.presets import Track

SAMPLERS: Final = ("grid", "tpe")
# the paper's coarse grid
GRID: Final[dict[str, list[Any]]] = {
    "learning_rate": [5e-5, 1e-4, 3e-4],
    "n_steps": [1, 3, 5],
    "batch_size": [32, 64, 128],
}
# TPE searches around it, not between its points alone
SPACE: Final[dict[str, BaseDistribution]] = {
    "learning_rate": FloatDistribution(1e-5, 3e-3, log=True),
    "n_steps": IntDistribution(1, 7),
    "batch_size": CategoricalDistribution([32, 64, 128, 256]),
}
TPE_TRIALS: Final = 30
PAPER: Final = {
    "learning_rate": float(HYPERPARAMETERS["Learning rate"]),
    "n_steps": int(HYPERPARAMETERS["n-step return"]),
    "batch_size": int(HYPERPARAMETERS["Batch size"]),
}


@dataclass(frozen=True)
class Configuration:
    """One point of the search."""

    learning_rate: float
    n_steps: int
    batch_size: int

    @classmethod
    def of(cls, trial: FrozenTrial) -> Configuration:
        """A trial's point; the learning rate to three digits, which is what is trained with."""
        rate = float(f"{trial.params['learning_rate']:.3g}")
        return cls(rate, int(trial.params["n_steps"]), int(trial.params["batch_size"]))

    @property
    def id(self) -> str:
        """A folder's name."""
        return f"lr{self.learning_rate:g}-n{self.n_steps}-b{self.batch_size}"

    @classmethod
    def parse(cls, name: str) -> Configuration:
        """The point that an id names, which says all of it.

        Raises:
            BenchmarkError: the text is no such id.
        """
        found = re.fullmatch(r"lr(.+)-n(\d+)-b(\d+)", name)
        if found is None:
            raise BenchmarkError(f"'{name}' names no configuration; such names are lr0.0001-n3-b64")
        return cls(float(found[1]), int(found[2]), int(found[3]))

    @property
    def is_papers(self) -> bool:
        return dataclasses.asdict(self) == PAPER

    def apply(self, track: Track) -> Track:
        """The track with these settings; the learning rate falls by the same factor as before."""
        h = track.hyperparameters
        end = self.learning_rate * h.learning_rate_end / h.learning_rate
        changed = dataclasses.replace(
            h,
            learning_rate=self.learning_rate,
            learning_rate_end=end,
            n_steps=self.n_steps,
            batch_size=self.batch_size,
        )
        return dataclasses.replace(track, hyperparameters=changed)


class _Grid(GridSampler):
    """Optuna's, without the call of ``Study.stop`` that raises outside ``Study.optimize``."""

    def after_trial(
        self,
        study: Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        pass


def _sampler(name: str, number: int) -> BaseSampler:
    if name == "grid":
        return _Grid(GRID, seed=0)
    # of its own for each trial: what it proposes depends on the trials before and on nothing that
    # a restart forgets
    return TPESampler(seed=number, n_startup_trials=8, constant_liar=True)


class Search:
    """A study on disk.

    Args:
        folder: where the journal lies.
        sampler: ``"grid"`` or ``"tpe"``.
        trials: how many configurations in all; of the grid at most its 27.
    """

    def __init__(self, folder: Path, sampler: str, trials: int | None) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.sampler = sampler
        size = 1
        for values in GRID.values():
            size *= len(values)
        whole = size if sampler == "grid" else TPE_TRIALS
        self.trials = whole if trials is None else trials
        if sampler == "grid":
            self.trials = min(self.trials, size)
        path = str(folder / "journal.log")
        storage = JournalStorage(JournalFileBackend(path, lock_obj=JournalFileOpenLock(path)))
        self.study = optuna.create_study(
            storage=storage, study_name="search", direction="maximize", load_if_exists=True
        )

    def begun(self) -> list[FrozenTrial]:
        """Trials that an earlier call left under way."""
        return self.study.get_trials(states=(TrialState.RUNNING,))

    def complete(self) -> list[FrozenTrial]:
        """Trials with a result."""
        return self.study.get_trials(states=(TrialState.COMPLETE,))

    @property
    def left(self) -> int:
        """Configurations that have not been asked for."""
        return max(0, self.trials - len(self.study.get_trials(deepcopy=False)))

    def ask(self) -> FrozenTrial | None:
        """The next configuration, or None when all have been asked for."""
        if not self.left:
            return None
        number = len(self.study.get_trials(deepcopy=False))
        self.study.sampler = _sampler(self.sampler, number)
        space = SPACE
        if self.sampler == "grid":
            space = {name: CategoricalDistribution(values) for name, values in GRID.items()}
        asked = self.study.ask(space)
        return self.study.get_trials()[asked.number]

    def tell(self, trial: FrozenTrial, score: float) -> None:
        """Put a trial's score on record."""
        self.study.sampler = _sampler(self.sampler, trial.number)
        self.study.tell(trial.number, score)
