"""What each word of the command line does. Heavy imports wait until a word needs them."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.plan import expand, find
from benchmarks.protocol.presets import DEFAULT_PRESET, Preset, load_preset
from benchmarks.runs.store import Store

if TYPE_CHECKING:
    from benchmarks.reporting.figures.parts import Picture
    from benchmarks.reporting.tables.table import Table

DELEGATED: Final = ("speed", "design", "classic", "audit", "failures", "tune", "media", "watch")
SPEED: Final = {
    "env": "benchmarks.studies.speed.env",
    "rainbow": "benchmarks.studies.speed.rainbow",
}


def _open(arguments: argparse.Namespace, create: bool = False) -> tuple[Preset, Store]:
    preset = load_preset(arguments.preset)
    expand(preset)  # an impossible cell is an error before anything is written
    return preset, Store.open(arguments.results, preset.name, create)


def run(arguments: argparse.Namespace) -> int:
    """Everything: what is missing is run, then tables and figures are written."""
    from benchmarks.runs.backends import open_backend
    from benchmarks.runs.harness import Harness

    console = Console(soft_wrap=True)
    preset, store = _open(arguments, create=True)
    place = (arguments.address, arguments.gpus_per_run)
    device = arguments.device or ("cuda" if arguments.gpus_per_run else "cpu")
    with store.lock(), open_backend(arguments.backend, arguments.jobs, *place) as backend:
        console.print(f"{backend.describe()}, networks on {device}", markup=False)
        # a process of a cluster starts in another folder
        is_file = Path(arguments.preset).suffix in (".yaml", ".yml")
        name = str(Path(arguments.preset).resolve()) if is_file else arguments.preset
        results = arguments.results.resolve()
        options = ("--device", device)
        harness = Harness(preset, name, store, results, backend, console, options)
        outcome = harness.run()
        return outcome.close(store, console, lambda: _write_report(store, console))


def _write_tables(store: Store, console: Console) -> list[Table]:
    from benchmarks.reporting.tables.paper import PRINTED, build_tables, write_tables

    built = build_tables(store)
    write_tables(store, built)
    for table in built:
        if table.name in PRINTED:
            console.print(table.markdown(), markup=False, highlight=False)
    console.print(f"Tables (CSV, Markdown, LaTeX): {store.tables}")
    return built


def _write_figures(store: Store, console: Console) -> list[tuple[Picture, Path]]:
    from benchmarks.reporting.figures.learning import write_figures

    drawn = write_figures(store)
    if drawn:
        console.print(f"Figures: {store.figures}")
    return drawn


def _write_report(store: Store, console: Console) -> None:
    from benchmarks.reporting.pages.html_report import write_report

    path = write_report(store, _write_tables(store, console), _write_figures(store, console))
    console.print(f"Report: {path}")


def plan(arguments: argparse.Namespace) -> int:
    """The cells of a preset, whether they are complete, and what they cost."""
    from rich.table import Column, Table

    from benchmarks.runs.backends import default_jobs
    from benchmarks.runs.costs import costs, duration, wall_seconds

    preset = load_preset(arguments.preset)
    store = Store(arguments.results, preset.name)
    if store.folder.is_dir() and any(store.folder.iterdir()):
        store = Store.open(arguments.results, preset.name)
    others = [
        Store(arguments.results, path.parent.name)
        for path in sorted(arguments.results.glob("*/store.json"))
        if path.parent != store.folder
    ]
    found = costs(preset, store, others)
    name = Column("cell", no_wrap=True, min_width=max(len(cost.cell.id) for cost in found))
    table = Table(name, "state", Column("took", no_wrap=True), Column("left", no_wrap=True))
    for cost in found:
        times = (duration(cost.seconds), "") if cost.complete else ("", duration(cost.seconds))
        table.add_row(cost.cell.id, cost.state, *times)
    console = Console(soft_wrap=True)
    console.print(table)
    todo = [cost for cost in found if not cost.complete]
    console.print(
        f"{len(found)} cells of preset '{preset.name}' in {store.folder}, {len(todo)} to run"
    )
    if todo:
        jobs = default_jobs() if arguments.jobs is None else arguments.jobs
        alone = duration(sum(cost.seconds for cost in todo))
        guessed = sum(cost.guessed for cost in todo)
        text = f"About {alone} of one core left, {duration(wall_seconds(found, jobs))} with "
        text += f"{jobs} process{'es' if jobs > 1 else ''}"
        if guessed:
            text += f"; a guess for {guessed} cells of a kind that never ran here"
        console.print(text)
    return 0


def train(arguments: argparse.Namespace) -> int:
    """One cell in this process; what the harness starts, and what a cluster can start."""
    from benchmarks.runs.cell import StopFlag, check_device, run_cell, tell_end

    preset, store = _open(arguments, create=True)
    cell = find(preset, arguments.cell)
    device = arguments.device or "cpu"
    check_device(device)
    flag = StopFlag(arguments.parent)
    flag.listen()
    complete = run_cell(preset, cell, store, flag, arguments.wait, device)
    return tell_end(cell.id, store.run(cell.id), complete)


def evaluate(arguments: argparse.Namespace) -> int:
    """Score a model or planner of one's own for the leaderboard, or stored policies again."""
    if arguments.model or arguments.planner:
        if arguments.starts is not None:
            raise BenchmarkError("--starts is for stored policies, not for --model or --planner")
        return _evaluate_entry(arguments)
    of_entries = ("name", "algorithm", "mask_singularities", "mask_visited", "replace")
    given = [word for word in of_entries if getattr(arguments, word)]
    if given:
        raise BenchmarkError(
            f"--{given[0].replace('_', '-')} belongs to a --model or --planner, which is not given"
        )
    from benchmarks.studies.scoring.scores import score_again

    preset, store = _open(arguments)
    console = Console(soft_wrap=True)
    score_again(preset, store, arguments.results, console, arguments.episodes, arguments.starts)
    return 0


def _evaluate_entry(arguments: argparse.Namespace) -> int:
    from benchmarks.studies.scoring.entries import Entry, glance, join, prepare

    preset, console = load_preset(arguments.preset), Console(soft_wrap=True)
    source = arguments.model[0].stem if arguments.model else arguments.planner.partition(":")[2]
    entry = Entry(
        arguments.name or source or arguments.planner,
        tuple(arguments.model),
        arguments.algorithm,
        arguments.planner,
        arguments.mask_singularities,
        arguments.mask_visited,
    )
    if arguments.episodes is not None:
        for line in glance(preset, entry, arguments.episodes):
            print(line)
        print("Nothing was stored: the leaderboard needs all test episodes")
        return 0
    from benchmarks.reporting.tables.paper import build_tables, write_tables

    scorers = prepare(preset, entry)
    store = Store.open(arguments.results, preset.name, create=True)
    with store.lock():
        folders = join(preset, store, entry, scorers, console, arguments.replace)
        built = build_tables(store)
        write_tables(store, built)
    board = next(table for table in built if table.name == "leaderboard")
    console.print(board.markdown(), markup=False, highlight=False)
    console.print(f"Episodes: {', '.join(str(folder) for folder in folders)}")
    console.print(f"Leaderboard (CSV, Markdown, LaTeX): {store.tables / 'leaderboard.md'}")
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


def report(arguments: argparse.Namespace) -> int:
    """Tables, figures and the one-page report from stored data."""
    _, store = _open(arguments)
    with store.lock():
        _write_report(store, Console(soft_wrap=True))
    return 0


def curves(arguments: argparse.Namespace) -> int:
    """Where each learner's training curve ended."""
    from benchmarks.reporting.results import Results

    _, store = _open(arguments)
    learners = [run for run in Results(store).all() if run.folder.has_rows("curve")]
    if not learners:
        print(f"{store.folder} has no complete training run")
        return 0
    for run_result in learners:
        training = run_result.meta["training"]
        reached, share = training["steps_to_75"], training["final_success_20"]
        last = "no episode" if share is None else f"{100 * share:.0f} %"
        print(
            f"{run_result.folder.id}: {training['episodes']} episodes in "
            f"{training['timesteps']} steps, 75 % over 20 at {reached or 'never'}, "
            f"last 20: {last}, "
            f"{run_result.folder.path / 'curve.csv'}"
        )
    print(f"TensorBoard: tensorboard --logdir {store.folder}")
    return 0


def verify(arguments: argparse.Namespace) -> int:
    """Recompute every table; exit code 1 if one, the README or the docs disagree."""
    from benchmarks.reporting.verify import verify_all

    presets = [] if arguments.preset is None else [load_preset(arguments.preset).name]
    report = verify_all(arguments.results, presets, arguments.readme, arguments.docs)
    for line in report.checked:
        print(line)
    for problem in report.problems:
        print(problem, file=sys.stderr)
    if report.problems:
        number = len(report.problems)
        print(f"{number} difference{'s' if number > 1 else ''} found", file=sys.stderr)
        return 1
    print("Everything agrees with the stored data")
    return 0


def readme(arguments: argparse.Namespace) -> int:
    """Rewrite the README's results section, and what the pages beside it include."""
    from benchmarks.reporting.pages.includes import rewrite_all
    from benchmarks.reporting.pages.readme import rewrite

    if arguments.preset is None:  # the one that the page is about
        from benchmarks.reporting.verify import presets_of

        named = presets_of(arguments.readme)
        arguments.preset = named[0] if named else DEFAULT_PRESET
    _, store = _open(arguments)
    changed = rewrite(arguments.readme, store)
    print(f"{arguments.readme}: {'rewritten' if changed else 'up to date'}")
    for page in rewrite_all(arguments.readme.parent / "docs", arguments.results):
        print(f"{page}: its included tables are up to date")
    return 0


def delegate(word: str, rest: Sequence[str]) -> int:
    """``speed``, ``design``, ``classic`` and ``tune`` have command lines of their own."""
    if word == "tune":
        try:
            import optuna  # noqa: F401
        except ImportError as error:
            raise BenchmarkError(f"tune needs pip install '.[tune]': {error}") from error
        return _main_of("benchmarks.studies.tuning.tune", rest)
    if word in ("audit", "failures", "media", "watch"):
        return _main_of(f"benchmarks.studies.{word}", rest)
    if word == "design":
        return _main_of("benchmarks.studies.design.command", rest)
    if word == "classic":
        return _main_of("benchmarks.studies.classic.command", rest)
    if not rest or rest[0] not in SPEED:
        given = f"'{rest[0]}'" if rest else "nothing"
        raise BenchmarkError(f"speed of what? known: {known(SPEED)}; given: {given}")
    return _main_of(SPEED[rest[0]], rest[1:])


def _main_of(module: str, rest: Sequence[str]) -> int:
    main: Any = importlib.import_module(module).main
    return int(main(list(rest)) or 0)
