"""Stored policies, controls and planners play again: the test episodes, or other starts.

Test episodes are compared with the stored ones. A whole number names other starts, none of which
was trained on; of these a few are played per seed, without noise, on the track's own machine. The
store does not change; the episodes go to ``results/again/``.
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pandas as pd
from rich.console import Console

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import evaluate_cell
from benchmarks.evaluation.model_files import load_stored
from benchmarks.protocol.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.protocol.plan import DESIGN, Cell, own_error
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.reporting.results import AS_TRAINED, MAIN, Result
from benchmarks.reporting.tables.table import plain
from benchmarks.runs.backends import Backend, default_jobs
from benchmarks.runs.cell import ProgressReporter
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.harness import Harness
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.insertion import Insertion

AGAIN: Final = "again"
FRESH_EPISODES: Final = 20  # per seed of other starts: five seeds tell +-0.1 of a rate, in minutes


class Replay(Insertion):
    """The complete runs of a preset, played by their policies, controls and planners.

    ``episodes`` are per seed, None for the preset's (for other starts at most ``FRESH_EPISODES``);
    ``starts`` names other starts, None the test episodes'.
    BenchmarkError if the store is missing, or the preset is of public tasks.
    """

    run_bytes = 1_000_000

    def __init__(
        self, preset: str, results: Path | str, episodes: int | None, starts: int | None
    ) -> None:
        load_preset(preset)  # an error for public tasks, which cannot be played here
        super().__init__(preset)
        self.results, self.episodes, self.starts = Path(results), episodes, starts
        where = str(self.results.resolve())
        self.recipe |= {"results": where, "episodes": episodes, "starts": starts}
        self.source = self.open_store(self.results)

    def leave_out(self) -> tuple[int, int]:
        """Keep the cells that can play; returns how many have not run, how many lack a policy."""
        for cell in self.cells:
            self.source.run(cell.id).check_config(self.settings(cell))
        complete = [cell for cell in self.cells if self.source.run(cell.id).is_complete()]
        playing = [c for c in complete if not c.learns or self.source.run(c.id).has_policy()]
        not_run, without_policy = len(self.cells) - len(complete), len(complete) - len(playing)
        self.cells = [cell for cell in playing if cell.method != DESIGN]
        if not any(cell.learns or not without_policy for cell in self.cells):
            fix = "run the preset first"
            if without_policy:  # git keeps those of few presets
                fix = f"the policies of {without_policy} complete runs are not here; delete the "
                fix += "folder of one and run the preset again"
            raise BenchmarkError(f"{self.source.folder} has nothing to score: {fix}")
        return not_run, without_policy

    def check(self, todo: Sequence[Cell]) -> None:
        """Check nothing: what has run once can be built."""

    def units(self, config: dict[str, Any]) -> int:
        # it does not matter how long a policy was trained
        return int(config["evaluation"]["episodes"])

    def run(
        self, cell: Cell, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any]:
        """Play the episodes; meta.json otherwise repeats the first run's."""
        stored, report = self.source.run(cell.id), ProgressReporter(folder, stop_requested)
        model = load_stored(stored.policy) if cell.learns else None
        rows = evaluate_cell(self.shortened(cell), cell, report, self.starts, model)
        folder.write_rows("episodes", rows)
        return {key: value for key, value in stored.meta().items() if key != "schema"}

    def shortened(self, cell: Cell) -> Preset:
        """The preset with the number of episodes to play, and for other starts its main levels."""
        tests = self.preset.evaluation
        number = tests.episodes if self.episodes is None else self.episodes
        if self.starts is not None:
            if self.episodes is None:
                number = min(number, FRESH_EPISODES)
            machine = self.preset.tracks[cell.track].sim_to_real if cell.track else None
            own = [own_error(machine)] if machine else tests.errors
            tests = replace(tests, noise=[0.0], errors=own)
        return replace(self.preset, evaluation=replace(tests, episodes=number))

    def checkpoint_bytes(self, cell: Cell) -> int:
        return 0

    def verdict(self, folder: RunFolder) -> str:
        return "; " + next(metric_lines(Result.read(folder).test(), "now"))

    def compare(self, store: Store, console: Console) -> None:
        """Print each run's success in both ways of acting, stored and now, and how many agree."""
        rows, equal = [], 0
        for cell in self.cells:
            first, again = (Result.read(s.run(cell.id)) for s in (self.source, store))
            columns = first.episodes.columns.drop("plan_seconds")  # of runs that are older, fewer
            equal += first.episodes[columns].equals(again.episodes[columns])
            row = [cell.id]
            for level in (MAIN, AS_TRAINED):
                stored, tests = first.test(level), again.test(level)
                if self.starts is None:  # the same episodes, where only some were played
                    stored = stored[stored["episode"].isin(tests["episode"])]
                rates = [100.0 * one["success"].mean() for one in (stored, tests)]
                row += [f"{rate:.1f}" if len(tests) else "-" for rate in rates]
            rows.append(row)
        head = "run | greedily: stored | now | as trained: stored | now"
        text = plain("Success (%) of the played runs; scripts with 5 % random moves", head, rows)
        console.print(text, highlight=False)
        if self.starts is None and self.episodes is None:
            console.print(f"Runs whose every episode came out as stored: {equal} of {len(rows)}")
        console.print(f"Episodes of this time: {store.folder}")


def score_again(replay: Replay, console: Console) -> int:
    """Play the runs of a store again; returns the command's exit code."""
    not_run, without_policy = replay.leave_out()
    if not_run:
        console.print(f"Left out, not run yet: {not_run} runs")
    if without_policy:
        console.print(
            f"Left out, their policy is not here: {without_policy} runs; git keeps those of "
            "the headline methods, and a run whose folder is deleted is trained again"
        )
    jobs = min(default_jobs(), len(replay.cells))
    console.print(f"{len(replay.cells)} runs play again, {jobs} at a time; Ctrl-C ends it")
    which = "test" if replay.starts is None else f"starts-{replay.starts}"
    again = Store.open(replay.results / AGAIN / which, replay.name, create=True)
    with again.lock():  # before anything is deleted, as another process may be at work
        shutil.rmtree(again.folder / "runs", ignore_errors=True)
        outcome = Harness(replay, again, Backend(jobs), console).run()
    if outcome.interrupted:
        console.print("Interrupted; the store is as it was")
        return 130
    if outcome.failed:
        console.print(f"Failed: {', '.join(outcome.failed)}; the store is as it was")
        return 1
    replay.compare(again, console)
    return 0


def metric_lines(rows: pd.DataFrame, name: str) -> Iterator[str]:
    """One line per level of noise: the paper's metrics, and holes."""
    for noise, group in rows.groupby("noise"):
        values = {metric: metric.reduce(group) for metric in (*PAPER_METRICS, *EXTRA_METRICS)}
        parts = [  # NaN where no episode inserted
            f"{metric.label} {'-' if math.isnan(value) else f'{value:.{metric.digits}f}'}"
            for metric, value in values.items()
        ]
        yield f"{name}, noise {noise:g}: {'; '.join(parts)}"
