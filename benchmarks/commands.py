"""What each word of the command line does. Heavy imports wait until a word needs them."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Any, Final

from rich.console import Console

from benchmarks.errors import BenchmarkError, known
from benchmarks.plan import expand, find, settings, work_units
from benchmarks.presets import Preset, load_preset
from benchmarks.store import Store

GUESSED_RATE: Final = 1.5e-3  # seconds per unit of work, where nothing was measured yet
DELEGATED: Final = ("speed", "design")
SPEED: Final = {"env": "benchmarks.speed_env", "rainbow": "benchmarks.speed_rainbow"}


def _open(arguments: argparse.Namespace, create: bool = False) -> tuple[Preset, Store]:
    preset = load_preset(arguments.preset)
    expand(preset)  # an impossible cell is an error before anything is written
    return preset, Store.open(arguments.results, preset.name, create)


def run(arguments: argparse.Namespace) -> int:
    """Everything: what is missing is run, then tables and figures are written."""
    from benchmarks.run import Harness, default_jobs

    console = Console(soft_wrap=True)
    preset, store = _open(arguments, create=True)
    with store.lock():
        jobs = default_jobs() if arguments.jobs is None else arguments.jobs
        harness = Harness(preset, arguments.preset, store, arguments.results, jobs, console)
        outcome = harness.run()
        if outcome.skipped:
            console.print(f"{len(outcome.skipped)} runs were complete already")
        if outcome.interrupted:
            console.print(f"Interrupted; the same command resumes. Results so far: {store.folder}")
            return 130
        _write_tables(store, console)
        _write_figures(store, console)
    console.print(f"Runs: {store.folder / 'runs'}")
    if outcome.failed:
        console.print(f"Failed: {', '.join(outcome.failed)}; the same command tries again")
        return 1
    return 0


def _write_tables(store: Store, console: Console) -> None:
    from benchmarks.tables import PRINTED, build_tables, write_tables

    built = build_tables(store)
    write_tables(store, built)
    for table in built:
        if table.name in PRINTED:
            console.print(table.markdown(), markup=False, highlight=False)
    console.print(f"Tables (CSV, Markdown, LaTeX): {store.tables}")


def _write_figures(store: Store, console: Console) -> None:
    from benchmarks.figures import write_figures

    if write_figures(store):
        console.print(f"Figures: {store.figures}")


def plan(arguments: argparse.Namespace) -> int:
    """The cells of a preset, whether they are complete, and what they cost."""
    from rich.table import Column, Table

    preset = load_preset(arguments.preset)
    cells = expand(preset)
    store = Store(arguments.results, preset.name)
    if store.folder.is_dir() and any(store.folder.iterdir()):
        store = Store.open(arguments.results, preset.name)
    width = max(len(cell.id) for cell in cells)
    name = Column("cell", no_wrap=True, min_width=width)
    table = Table(name, "state", Column("wall (s)", no_wrap=True), Column("left (s)", no_wrap=True))
    rates = _measured_rate(preset, store)
    left = 0.0
    for cell in cells:
        folder = store.run(cell.id)
        folder.check_config(settings(preset, cell))
        share = 0.0 if folder.is_complete() else folder.progress()[0]
        if folder.is_done(cell.learns):
            table.add_row(cell.id, "complete", f"{folder.meta()['wall_seconds']:.0f}", "")
            continue
        ahead = (1.0 - share) * work_units(preset, cell) * rates.get(cell.method, GUESSED_RATE)
        left += ahead
        state = f"{100 * share:.0f} %" if share else "missing"
        table.add_row(cell.id, state, "", f"{ahead:.0f}")
    console = Console(soft_wrap=True)
    console.print(table)
    guess = "" if rates else ", a guess before the first run"
    text = f"; about {left / 60:.0f} min of one core left{guess}" if left else ""
    console.print(f"{len(cells)} cells of preset '{preset.name}' in {store.folder}{text}")
    return 0


def _measured_rate(preset: Preset, store: Store) -> dict[str, float]:
    """Seconds per unit of work of each method, from complete runs."""
    totals: dict[str, tuple[float, int]] = {}
    for cell in expand(preset):
        folder = store.run(cell.id)
        if folder.is_complete():
            seconds, units = totals.get(cell.method, (0.0, 0))
            wall = float(folder.meta()["wall_seconds"])
            totals[cell.method] = seconds + wall, units + work_units(preset, cell)
    return {method: seconds / units for method, (seconds, units) in totals.items()}


def train(arguments: argparse.Namespace) -> int:
    """One cell in this process; what the harness starts, and what a cluster can start."""
    from benchmarks.cell import StopFlag, run_cell

    preset, store = _open(arguments, create=True)
    cell = find(preset, arguments.cell)
    flag = StopFlag(arguments.parent)
    flag.listen()
    complete = run_cell(preset, cell, store, flag)
    folder = store.run(cell.id).path
    if not complete:
        print(f"{cell.id}: stopped, the checkpoint is in {folder}; the same command resumes")
        return 130
    print(f"{cell.id}: complete, see {folder}")
    return 0


def evaluate(arguments: argparse.Namespace) -> int:
    """Score stored policies again, or a model of one's own, on the test episodes."""
    from benchmarks.scores import score_model, score_store

    preset = load_preset(arguments.preset)
    if arguments.model is not None:
        lines = score_model(preset, arguments.model, arguments.algorithm, arguments.episodes)
    else:
        store = Store.open(arguments.results, preset.name)
        lines = score_store(preset, store, arguments.episodes)
    for line in lines:
        print(line)
    return 0


def tables(arguments: argparse.Namespace) -> int:
    """Write and print the tables from stored data."""
    _, store = _open(arguments)
    with store.lock():
        _write_tables(store, Console(soft_wrap=True))
    return 0


def figures(arguments: argparse.Namespace) -> int:
    """Draw the figures from stored data."""
    _, store = _open(arguments)
    with store.lock():
        _write_figures(store, Console(soft_wrap=True))
    return 0


def curves(arguments: argparse.Namespace) -> int:
    """Where each learner's training curve ended."""
    from benchmarks.results import Results

    _, store = _open(arguments)
    learners = [run for run in Results(store).all() if run.folder.has_rows("curve")]
    if not learners:
        print(f"{store.folder} has no complete training run")
        return 0
    for run_result in learners:
        training = run_result.meta["training"]
        reached = training["steps_to_75"]
        print(
            f"{run_result.folder.id}: {training['episodes']} episodes in "
            f"{training['timesteps']} steps, 75 % over 20 at {reached or 'never'}, "
            f"last 20: {100 * training['final_success_20']:.0f} %, "
            f"{run_result.folder.path / 'curve.csv'}"
        )
    print(f"TensorBoard: tensorboard --logdir {store.folder}")
    return 0


def verify(arguments: argparse.Namespace) -> int:
    """Recompute every table; exit code 1 if one, or the README, disagrees."""
    from benchmarks.verify import verify as check

    _, store = _open(arguments)
    problems = check(store, arguments.readme)
    for problem in problems:
        print(problem, file=sys.stderr)
    if not problems:
        print(f"{store.folder}: tables and README agree with the stored episodes")
    return 1 if problems else 0


def readme(arguments: argparse.Namespace) -> int:
    """Rewrite the README's results section."""
    from benchmarks.readme import rewrite

    _, store = _open(arguments)
    changed = rewrite(arguments.readme, store)
    print(f"{arguments.readme}: {'rewritten' if changed else 'up to date'}")
    return 0


def delegate(word: str, rest: Sequence[str]) -> int:
    """``speed`` and ``design`` have command lines of their own."""
    if word == "design":
        return _main_of("benchmarks.design", rest)
    if not rest or rest[0] not in SPEED:
        given = f"'{rest[0]}'" if rest else "nothing"
        raise BenchmarkError(f"speed of what? known: {known(SPEED)}; given: {given}")
    return _main_of(SPEED[rest[0]], rest[1:])


def _main_of(module: str, rest: Sequence[str]) -> int:
    main: Any = importlib.import_module(module).main
    return int(main(list(rest)) or 0)
