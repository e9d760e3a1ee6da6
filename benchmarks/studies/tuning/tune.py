"""The search for hyperparameters: ``python -m benchmarks tune``.

The paper's coarse grid, or TPE beside it, each configuration trained on several seeds and scored on
validation episodes, never on test episodes: the streams of :mod:`benchmarks.protocol.seeding` are
apart, and the seeds are those of no preset either. Exit codes are the harness's.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from optuna.trial import FrozenTrial
from rich.console import Console

from benchmarks.errors import BenchmarkError, at_least, known
from benchmarks.protocol import labels, plan
from benchmarks.protocol.metrics import HOLES, SUCCESS
from benchmarks.protocol.presets import Evaluation, Preset, Track, as_dict, load_preset
from benchmarks.protocol.strict import build
from benchmarks.reporting.stats import mean_interval, over_seeds
from benchmarks.reporting.tables.table import Cell, Number, Table
from benchmarks.runs.backends import LocalBackend
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.harness import Harness
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.tuning.study import SAMPLERS, Configuration, Search

FIRST_SEED: Final = 1_000  # of the search; those of presets are small numbers
STREAM: Final = "validate"


@dataclass(frozen=True)
class Training:
    """A configuration and a seed."""

    configuration: Configuration
    seed: int

    @property
    def id(self) -> str:
        return f"{self.configuration.id}-s{self.seed}"


class Tuning(Experiment[Training]):
    """Trainings that a study asks for, in the folder whose config.yaml says around what.

    Args:
        folder: of the study.
        search: gives configurations and takes their scores; a single training needs none.
        title: of the table.
    """

    def __init__(self, folder: Path | str, search: Search | None = None, title: str = "") -> None:
        self.folder, self.title = Path(folder), title
        super().__init__(self.folder.name, folder=str(self.folder.resolve()))
        about = RunFolder(self.folder).config()["search"]
        self.seeds, self.episodes = int(about["seeds"]), int(about["episodes"])
        self.track = build(Track, about["track"], str(self.folder / "config.yaml"))
        self.store = Store(self.folder.parent, self.folder.name)
        self._search = search
        self._open: list[FrozenTrial] = []

    @property
    def search(self) -> Search:
        """The study."""
        assert self._search is not None
        return self._search

    def cells(self) -> Sequence[Training]:
        # what an earlier call left under way
        return [cell for frozen in self.search.begun() for cell in self._take_up(frozen)]

    def more(self) -> Sequence[Training]:
        asked = self.search.ask()
        return () if asked is None else self._take_up(asked)

    def to_come(self) -> int:
        return self.search.left * self.seeds

    def find(self, cell_id: str) -> Training:
        name, _, seed = cell_id.rpartition("-s")
        return Training(Configuration.parse(name), int(seed))

    def _take_up(self, frozen: FrozenTrial) -> list[Training]:
        self._open.append(frozen)
        self._settle()  # all may be complete from an earlier call
        return self._trainings(frozen)

    def _trainings(self, frozen: FrozenTrial) -> list[Training]:
        configuration = Configuration.of(frozen)
        return [Training(configuration, FIRST_SEED + i) for i in range(self.seeds)]

    def _settle(self) -> list[str]:
        """Tell the study of configurations whose trainings are all complete."""
        told = []
        for frozen in list(self._open):
            folders = [self.store.run(cell.id) for cell in self._trainings(frozen)]
            if all(folder.is_complete() for folder in folders):
                self._open.remove(frozen)
                score = over_seeds(
                    [SUCCESS.reduce(folder.rows("validation")) for folder in folders]
                )
                self.search.tell(frozen, score.mean)
                name = Configuration.of(frozen).id
                told.append(f"{name}: success {score.text(1)} % in validation")
        return told

    def ended(self, cell: Training) -> str:
        return "\n".join(self._settle())

    def settings(self, cell: Training) -> dict[str, Any]:
        return {
            "cell": asdict(self._plan_cell(cell)),
            "track": as_dict(cell.configuration.apply(self.track)),
            "validation": {"episodes": self.episodes},
        }

    def _plan_cell(self, cell: Training) -> plan.Cell:
        return plan.Cell("rainbow", "full", "optimized", "search", cell.seed)

    def units(self, config: dict[str, Any]) -> int:
        return plan.units_of(config)

    def checkpoint_bytes(self, cell: Training) -> int:
        return plan.checkpoint_bytes(self.track)

    def run(
        self, cell: Training, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        from benchmarks.evaluation.evaluate import begin_episodes, model_policy, run_policy
        from benchmarks.methods.episodes import env_arguments
        from benchmarks.runs.training import train

        track, mine = cell.configuration.apply(self.track), self._plan_cell(cell)
        preset = Preset("search", "", [cell.seed], Evaluation(1), [], tracks={"search": track})
        trained = train(preset, mine, folder, stop_requested, device)
        if trained is None:
            return None
        model, summary = trained
        folder.write_progress(1.0, "validating")
        began = time.perf_counter()
        arguments = env_arguments(preset, mine, track)
        episodes = begin_episodes(arguments, cell.seed, self.episodes, STREAM)
        folder.write_rows("validation", run_policy(model_policy(model), episodes, 0.0, 0))
        return {"training": {**summary, "test_seconds": time.perf_counter() - began}}

    def write_tables(self, store: Store, console: Console) -> None:
        table = results_table(self.search, self.folder, self.seeds, self.title)
        table.write(self.folder)
        console.print(table.markdown(), markup=False, highlight=False)
        console.print(f"Table (CSV, Markdown, LaTeX): {self.folder / 'search.md'}")


def results_table(search: Search, folder: Path, seeds: int, title: str) -> Table:
    """Every scored configuration, the best first."""
    rows: list[tuple[float, list[Cell]]] = []
    for frozen in search.complete():
        configuration = Configuration.of(frozen)
        ids = [f"{configuration.id}-s{FIRST_SEED + i}" for i in range(seeds)]
        folders = [RunFolder(folder / "runs" / name) for name in ids]
        frames = [each.rows("validation") for each in folders]
        rates = [SUCCESS.reduce(frame) for frame in frames]
        low, high = mean_interval(rates)
        success = replace(over_seeds(rates), low=low, high=high)
        reached = [each.meta()["training"]["steps_to_75"] for each in folders]
        steps = over_seeds([x * 1e-5 for x in reached if x is not None])
        rows.append((success.mean, [
            f"{configuration.learning_rate:g}",
            str(configuration.n_steps),
            str(configuration.batch_size),
            Number(success, 1),
            success.interval_text(1),
            Number(over_seeds([HOLES.reduce(frame) for frame in frames]), HOLES.digits),
            Number(steps, 2, f" ({steps.n} of {seeds})"),
            "the paper's choice" if configuration.is_papers else "",
        ]))  # fmt: skip
    rows.sort(key=lambda row: -row[0])
    header = [
        *("Learning rate", "n-step", "Batch", "Success (%)", "95 % interval", "Holes (of 6)"),
        *("Steps to 75 % (1e5)", ""),
    ]
    notes = [
        f"Mean ± std over {seeds} trainings, each scored on its own validation episodes; intervals "
        "by bootstrap over trainings. The best of many is better than it will test: see the tables "
        "of a preset for that.",
    ]
    return Table("search", title, header, [row for _, row in rows], notes, left=(0, 7))


def main(argv: Sequence[str] | None = None) -> int:
    """Run a search; returns the exit code."""
    arguments = _parser().parse_args(argv)
    console = Console(soft_wrap=True)
    track_name, track = _track(arguments)
    name = arguments.name or f"{track_name}-{arguments.sampler}"
    study = RunFolder(arguments.results / "tune" / name)
    study.begin({
        "search": {
            "sampler": arguments.sampler,
            "seeds": arguments.seeds,
            "episodes": arguments.episodes,
            "track": as_dict(track),
        }
    })  # fmt: skip
    with study.lock():
        search = Search(study.path, arguments.sampler, arguments.trials)
        title = f"Search by {arguments.sampler} around {labels.track(track_name)}"
        tuning = Tuning(study.path, search, title)
        console.print(
            f"{search.trials} configurations x {arguments.seeds} seeds x {track.timesteps} steps, "
            f"{arguments.episodes} validation episodes each; {len(search.complete())} are done",
            markup=False,
        )
        outcome = Harness(tuning, tuning.store, LocalBackend(arguments.jobs), console).run()
        tuning.report(tuning.store, console)
        return outcome.close(tuning.store, console, lambda: None)


def _track(arguments: argparse.Namespace) -> tuple[str, Track]:
    preset = load_preset(arguments.preset)
    names = list(preset.tracks)
    name = arguments.track or ("safe" if "safe" in names else names[0] if names else "")
    if name not in preset.tracks:
        raise BenchmarkError(
            f"preset '{preset.name}' has no track '{name}'; known: {known(names) or 'none'}"
        )
    track = preset.tracks[name]
    if arguments.steps is not None:
        track = replace(track, timesteps=arguments.steps)
    return name, track


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks tune", description=__doc__)
    add = parser.add_argument
    add("--sampler", choices=SAMPLERS, default="grid", help="the paper's grid, or TPE")
    add("--preset", default="cut", help="whose tracks there are (default: cut)")
    add("--track", default=None, help="what to search around (default: safe, or the first)")
    add("--trials", type=at_least(1), default=None, help="configurations (default: 27 or 30)")
    add("--steps", type=at_least(1), default=None, help="of each training (default: the track's)")
    add("--seeds", type=at_least(1), default=5, help="trainings of a configuration (default: 5)")
    add("--episodes", type=at_least(1), default=100, help="validation episodes (default: 100)")
    add("--jobs", type=at_least(1), default=None, help="processes (default: cores)")
    add("--name", default=None, help="of the study (default: track and sampler)")
    add("--results", type=Path, default=Path("results"), help="results folder")
    return parser
