"""Stored policies and the planners play once more; the tables are built from what they do then.

    python -m benchmarks evaluate --preset paper
    python -m benchmarks evaluate --preset paper --starts 2026

The first plays the test episodes and says whether every episode and every cell of every table came
out as stored. The second plays episodes that begin elsewhere: any whole number stands for starts of
its own, none of which was ever trained on or looked at. Nothing of the store is changed; the
episodes and tables go to ``results/again/``.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path
from typing import Final

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import Rows, evaluate_planner, evaluate_policy, model_policy
from benchmarks.evaluation.model_files import load_model
from benchmarks.methods.learners import env_arguments
from benchmarks.protocol.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.protocol.plan import DESIGN, Cell, expand, settings
from benchmarks.protocol.presets import Preset
from benchmarks.reporting.tables.paper import build_tables, write_tables
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.backends import PINNED, default_jobs
from benchmarks.runs.harness import terminable
from benchmarks.runs.store import RunFolder, Store

AGAIN: Final = "again"
TIMES: Final = ("plan_seconds",)  # columns that differ from one play to the next


def score_again(
    preset: Preset,
    store: Store,
    results: Path,
    console: Console,
    episodes: int | None = None,
    starts: int | None = None,
) -> Store:
    """Play what a store holds once more, and build its tables from that.

    Args:
        preset: the experiment.
        store: with its complete runs; those that are not are left out, and named.
        results: the folder in which ``again/`` is made.
        console: hears how far it is and what came of it.
        episodes: test episodes per seed, for a quick look; None for the preset's.
        starts: stands for other starts than the test episodes'; None for the test episodes.

    Returns:
        A store with the episodes and tables of this time.

    Raises:
        BenchmarkError: the store has no trained policy.
    """
    cells = [cell for cell in expand(preset) if cell.method != DESIGN]
    for cell in cells:
        store.run(cell.id).check_config(settings(preset, cell))
    ready = [cell for cell in cells if _can_play(cell, store.run(cell.id))]
    if not any(cell.learns for cell in ready):
        raise BenchmarkError(f"{store.folder} has no trained policy to score: run the preset first")
    if len(ready) < len(cells):
        console.print(f"Left out, not run yet or without a policy: {len(cells) - len(ready)} runs")
    if episodes is not None:
        tests = dataclasses.replace(preset.evaluation, episodes=episodes)
        preset = dataclasses.replace(preset, evaluation=tests)
    which = "test" if starts is None else f"starts-{starts}"
    again = _fresh_store(store, results / AGAIN / which)
    os.environ.update(PINNED)  # of the processes that are started now
    jobs = min(default_jobs(), len(ready))
    console.print(f"{len(ready)} runs play again, {jobs} at a time; Ctrl-C ends it")
    equal = 0
    with (
        terminable(),
        progress_bar(console) as progress,
        ProcessPoolExecutor(jobs, get_context("spawn"), _begin_worker) as pool,
    ):
        task = progress.add_task("test episodes", total=len(ready))
        futures = {
            pool.submit(_play, preset, cell, store.run(cell.id).policy, starts): cell
            for cell in ready
        }
        try:
            for future in as_completed(futures):
                cell, rows = futures[future], future.result()
                equal += _keep(store.run(cell.id), again.run(cell.id), rows)
                progress.advance(task)
                console.print(next(in_words(pd.DataFrame(rows), cell.id)), markup=False)
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in active_children():  # what is queued in them is no use any more
                process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise BenchmarkError(
                    "a process that played was killed, for want of memory perhaps; the store is as "
                    "it was, the same command starts again"
                ) from error
            if isinstance(error, KeyboardInterrupt):
                console.print("Interrupted; the store is as it was")
            raise
    built = build_tables(again)
    write_tables(again, built)
    for table in built:
        if table.name in ("performance", "ablation", "geometry", "robustness"):
            console.print(table.markdown(), markup=False, highlight=False)
    if starts is None and episodes is None and len(ready) == len(cells):
        console.print(f"Runs whose every episode came out as stored: {equal} of {len(ready)}")
        console.print(_compare(build_tables(store), built), markup=False, highlight=False)
    console.print(f"Episodes and tables of this time: {again.folder}")
    return again


def _can_play(cell: Cell, run: RunFolder) -> bool:
    return run.has_policy() if cell.learns else run.is_complete()


def progress_bar(console: Console) -> Progress:
    """What is done, how long it took and will take."""
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), Elapsed(), Remaining())
    return Progress(*columns, console=console, refresh_per_second=2)


def _fresh_store(store: Store, root: Path) -> Store:
    """A store beside the first with its runs' settings and training, without episodes."""
    folder = root / store.folder.name
    if folder.exists():
        shutil.rmtree(folder)
    again = Store.open(root, store.folder.name, create=True)
    if store.entries.is_dir():
        shutil.copytree(store.entries, again.entries)
    for run in store.completed():
        copy = again.run(run.id).path
        copy.mkdir(parents=True)
        names = ["config.yaml", "curve.csv", "design.csv"]
        if not run.has_rows("episodes"):
            names.append("meta.json")  # which completes it; the others have to play first
        for name in names:
            if (run.path / name).is_file():
                shutil.copy(run.path / name, copy / name)
    return again


def _keep(stored: RunFolder, again: RunFolder, rows: Rows) -> bool:
    """Store a run's rows, which completes it; whether they are those of the first time."""
    again.write_rows("episodes", rows)
    shutil.copy(stored.path / "meta.json", again.path / "meta.json")
    first, second = (folder.rows("episodes").drop(columns=[*TIMES]) for folder in (stored, again))
    return first.equals(second)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and do not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def end_with(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=end_with, args=(parent.sentinel,), daemon=True).start()


def _play(preset: Preset, cell: Cell, policy: Path, starts: int | None) -> Rows:
    import torch

    torch.set_num_threads(1)
    track = preset.tracks[cell.track] if cell.learns else None
    arguments = env_arguments(preset, cell, track)
    if not cell.learns:
        return evaluate_planner(preset, cell, arguments, lambda share: None, starts)
    model = load_model(policy, cell.method)
    return evaluate_policy(model_policy(model), preset, cell.seed, arguments, starts=starts)


def _compare(stored: list[Table], again: list[Table]) -> str:
    cells = differing = 0
    lines: list[str] = []
    for one, two in zip(stored, again, strict=True):
        first, second = _by_label(one), _by_label(two)
        for key in dict.fromkeys([*first, *second]):
            cells += 1
            a, b = first.get(key, "nothing"), second.get(key, "nothing")
            if a != b:
                differing += 1
                lines.append(f"  {one.name}, {', '.join(key)}: {a} stored, {b} now")
    head = f"Cells of the tables that came out as stored: {cells - differing} of {cells}"
    return "\n".join([head, *lines])


def _by_label(table: Table) -> dict[tuple[str, ...], str]:
    """Every cell of a table under its row's labels and its column."""
    labels = {"leaderboard": (1,), "deviations": (0, 1, 2)}.get(table.name, table.left)
    return {
        (*(row[i] for i in labels), name): text
        for row in table.texts()
        for name, text in zip(table.header, row, strict=True)
    }


def in_words(rows: pd.DataFrame, name: str) -> Iterator[str]:
    """One line per level of noise: the paper's metrics, and holes."""
    for noise, group in rows.groupby("noise"):
        parts = [
            f"{metric.label} {metric.reduce(group):.{metric.digits}f}"
            for metric in (*PAPER_METRICS, *EXTRA_METRICS[:2])
        ]
        yield f"{name}, noise {noise:g}: {'; '.join(parts)}"
