"""The search for hyperparameters: ``python -m benchmarks tune``.

The paper's coarse grid, or TPE beside it, each configuration trained on several seeds and scored on
validation episodes; never on test episodes. Exit codes as the harness's: 0 done, 1 a run failed, 2
bad input, 130 interrupted, and the same command resumes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import pandas as pd
from optuna.trial import FrozenTrial
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, SUCCESS
from benchmarks.protocol.presets import Track, as_dict, load_preset
from benchmarks.reporting.stats import mean_interval, over_seeds
from benchmarks.reporting.tables.table import Cell, Number, Table
from benchmarks.runs.backends import GRACE_SECONDS, Backend, Job, LocalBackend
from benchmarks.runs.cell import StopFlag
from benchmarks.runs.store import RunFolder
from benchmarks.studies.tuning import run as tune_run
from benchmarks.studies.tuning.study import SAMPLERS, Configuration, Search

POLL_SECONDS: Final = 0.2


@dataclass
class _Trial:
    """A configuration under way."""

    frozen: FrozenTrial
    folders: list[RunFolder]


@dataclass
class _Running:
    job: Job
    folder: RunFolder
    task: TaskID


class Tuner:
    """Trains what a search asks for.

    Args:
        search: the study.
        track: what is searched around; its ``timesteps`` are each training's.
        folder: of the study.
        seeds: trainings of each configuration.
        episodes: validation episodes of each training.
        backend: where trainings run.
        console: for progress.
    """

    def __init__(
        self,
        search: Search,
        track: Track,
        folder: Path,
        seeds: int,
        episodes: int,
        backend: Backend,
        console: Console,
    ) -> None:
        self.search, self.track, self.folder = search, track, folder
        self.seeds, self.episodes = seeds, episodes
        self.backend, self.console = backend, console
        self.failed: list[str] = []
        self._scored = len(search.complete())
        self._trials: list[_Trial] = []
        self._queue: list[RunFolder] = []
        self._running: list[_Running] = []

    def run(self) -> bool:
        """Train until every configuration has its score; False if interrupted."""
        for frozen in self.search.begun():
            self._take_up(frozen)
        total = self.search.trials * self.seeds
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            Remaining(elapsed_when_finished=True),
            TextColumn("{task.fields[note]}"),
        )
        with Progress(*columns, console=self.console, refresh_per_second=2) as progress:
            done = self._scored * self.seeds
            overall = progress.add_task(
                f"all {self.search.trials} configurations", total=total, completed=done, note=""
            )
            try:
                while self._step(progress, overall):
                    time.sleep(POLL_SECONDS)
            except KeyboardInterrupt:
                self.console.print("Stopping: the trainings save their checkpoints")
                self._stop()
                return False
        return True

    def _take_up(self, frozen: FrozenTrial) -> None:
        """Queue the trainings of a configuration that are not complete."""
        configuration = Configuration.of(frozen)
        track = configuration.apply(self.track)
        folders = []
        for seed in range(tune_run.FIRST_SEED, tune_run.FIRST_SEED + self.seeds):
            folder = RunFolder(self.folder / "runs" / f"{configuration.id}-s{seed}")
            folder.begin(tune_run.settings(track, seed, self.episodes))
            folders.append(folder)
        self._trials.append(_Trial(frozen, folders))
        self._queue += [folder for folder in folders if not folder.is_complete()]
        self._settle()

    def _step(self, progress: Progress, overall: TaskID) -> bool:
        """Start what there is room for and see to what has ended; False when all is done."""
        while len(self._running) < self.backend.slots:
            if not self._queue:
                asked = self.search.ask()
                if asked is None:
                    break
                self._take_up(asked)
                continue
            self._running.append(self._start(self._queue.pop(0), progress))
        share = 0.0
        for running in list(self._running):
            done, note = running.folder.progress()
            progress.update(running.task, completed=done, note=note)
            code = running.job.poll()
            if code is None:
                share += 0.0 if running.folder.is_complete() else done
                continue
            self._running.remove(running)
            progress.remove_task(running.task)
            if code != 0 or not running.folder.is_complete():
                self.failed.append(running.folder.id)
                log = running.job.log
                self.console.print(f"{running.folder.id}: failed with exit code {code}, see {log}",
                                   style="red", markup=False)  # fmt: skip
            self._settle()
        waiting = sum(f.is_complete() for trial in self._trials for f in trial.folders)
        progress.update(overall, completed=self._scored * self.seeds + waiting + share)
        return bool(self._running or self._queue or self.search.left)

    def _start(self, folder: RunFolder, progress: Progress) -> _Running:
        job = self.backend.start(["tune", "--one", str(folder.path.resolve())], folder)
        return _Running(
            job, folder, progress.add_task(f"  {folder.id}", total=1.0, note="starting")
        )

    def _settle(self) -> None:
        """Tell the study of configurations whose trainings are all complete."""
        for trial in list(self._trials):
            if not all(folder.is_complete() for folder in trial.folders):
                continue
            self._trials.remove(trial)
            score = over_seeds([SUCCESS.reduce(validation(f)) for f in trial.folders])
            self.search.tell(trial.frozen, score.mean)
            self._scored += 1
            name = Configuration.of(trial.frozen).id
            self.console.print(f"{name}: success {score.text(1)} % in validation", markup=False)

    def _stop(self) -> None:
        for running in self._running:
            running.job.stop()
        end = time.monotonic() + GRACE_SECONDS
        for running in self._running:
            running.job.wait(end - time.monotonic())


def validation(folder: RunFolder) -> pd.DataFrame:
    """A training's validation episodes."""
    return folder.rows("validation")


def results_table(search: Search, folder: Path, seeds: int, title: str) -> Table:
    """Every scored configuration, the best first."""
    rows: list[tuple[float, list[Cell]]] = []
    for frozen in search.complete():
        configuration = Configuration.of(frozen)
        ids = [f"{configuration.id}-s{tune_run.FIRST_SEED + i}" for i in range(seeds)]
        folders = [RunFolder(folder / "runs" / name) for name in ids]
        frames = [validation(each) for each in folders]
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
    """Run a search, or with ``--one`` a single training of it; returns the exit code."""
    arguments = _parser().parse_args(argv)
    if arguments.one is not None:
        return _one(arguments)
    console = Console(soft_wrap=True)
    track_name, track = _track(arguments)
    name = arguments.name or f"{track_name}-{arguments.sampler}"
    folder = arguments.results / "tune" / name
    study = RunFolder(folder)
    study.begin({
        "search": {
            "sampler": arguments.sampler,
            "seeds": arguments.seeds,
            "episodes": arguments.episodes,
            "track": as_dict(track),
        }
    })  # fmt: skip
    with study.lock():
        search = Search(folder, arguments.sampler, arguments.trials)
        console.print(
            f"{search.trials} configurations x {arguments.seeds} seeds x {track.timesteps} steps, "
            f"{arguments.episodes} validation episodes each; {len(search.complete())} are done",
            markup=False,
        )
        backend = LocalBackend(arguments.jobs)
        seeds, episodes = arguments.seeds, arguments.episodes
        tuner = Tuner(search, track, folder, seeds, episodes, backend, console)
        finished = tuner.run()
        title = f"Search by {arguments.sampler} around {labels.track(track_name)}"
        table = results_table(search, folder, seeds, title)
        table.write(folder)
        console.print(table.markdown(), markup=False, highlight=False)
    console.print(f"Table (CSV, Markdown, LaTeX): {folder / 'search.md'}")
    console.print(f"Study: {folder}")
    if not finished:
        console.print("Interrupted; the same command resumes")
        return 130
    if tuner.failed:
        console.print(f"Failed: {', '.join(tuner.failed)}; the same command tries again")
        return 1
    return 0


def _track(arguments: argparse.Namespace) -> tuple[str, Track]:
    preset = load_preset(arguments.preset)
    names = list(preset.tracks)
    name = arguments.track or ("repaired" if "repaired" in names else names[0] if names else "")
    if name not in preset.tracks:
        raise BenchmarkError(
            f"preset '{preset.name}' has no track '{name}'; known: {known(names) or 'none'}"
        )
    track = preset.tracks[name]
    if arguments.steps is not None:
        track = replace(track, timesteps=arguments.steps)
    return name, track


def _one(arguments: argparse.Namespace) -> int:
    flag = StopFlag(arguments.parent)
    flag.listen()
    return 0 if tune_run.run(RunFolder(arguments.one), flag) else 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks tune", description=__doc__)
    add = parser.add_argument
    add("--sampler", choices=SAMPLERS, default="grid", help="the paper's grid, or TPE")
    add("--preset", default="paper", help="whose tracks there are (default: paper)")
    add("--track", default=None, help="what to search around (default: repaired, or the first)")
    add("--trials", type=_positive, default=None, help="configurations (default: 27 or 30)")
    add("--steps", type=_positive, default=None, help="of each training (default: the track's)")
    add("--seeds", type=_positive, default=5, help="trainings of a configuration (default: 5)")
    add("--episodes", type=_positive, default=100, help="validation episodes (default: 100)")
    add("--jobs", type=_positive, default=None, help="processes (default: cores)")
    add("--name", default=None, help="of the study (default: track and sampler)")
    add("--results", type=Path, default=Path("results"), help="results folder")
    add("--one", type=Path, default=None, help=argparse.SUPPRESS)
    add("--parent", type=int, default=None, help=argparse.SUPPRESS)
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is below 1")
    return number
