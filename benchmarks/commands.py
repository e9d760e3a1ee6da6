"""What each word of the command line does. Heavy imports wait until a word needs them."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.presets import DEFAULT_PRESET, load_preset, preset_names
from benchmarks.runs.store import Store
from benchmarks.studies.classic.presets import preset_names as classic_names

if TYPE_CHECKING:
    from benchmarks.runs.experiment import Experiment

STUDIES: Final = {
    "insertion": "benchmarks.studies.insertion:Insertion",
    "classic": "benchmarks.studies.classic.experiment:Classic",
}
CLASSIC: Final = {
    "run": "train what is missing, then tables and figures",
    "plan": "list the runs of a preset, their state and cost",
    "tables": "write and print the tables from stored runs",
    "figures": "draw the figures from stored runs",
    "docs": "rewrite the results on the page of docs/ that shows them",
    "train": "one run in this process",
}
# words with a command line of their own, beside `speed`
MODULES: Final = {
    "audit": "audit",
    "codesign": "design.codesign.command",
    "contact": "robots.contact",
    "data": "sharing.data",
    "design": "design.command",
    "failures": "failures",
    "media": "viewing.media",
    "physics": "robots.physics",
    "shield": "robots.shield",
    "trajectory": "trajectory",
    "transfer": "robots.transfer",
    "watch": "viewing.watch",
}
DELEGATED: Final = ("speed", *MODULES)
# the studies that keep tables: each has a `check` of what it stored
CHECKED: Final = (
    *("design.docs", "design.codesign.tell", "audit", "failures", "classic.docs"),
    *("robots.physics", "robots.contact", "robots.shield", "robots.transfer"),
    *("sharing.data_page", "trajectory"),
)
SPEED: Final = {
    "env": "benchmarks.studies.speed.env",
    "rainbow": "benchmarks.studies.speed.rainbow",
}


def _experiment(arguments: argparse.Namespace) -> Experiment[Any]:
    study, preset = arguments.study, arguments.preset
    if study == "insertion" and preset not in preset_names() and preset in classic_names():
        study = "classic"  # the suites of other tasks: a name says which, without the word
    module, _, name = STUDIES[study].partition(":")
    experiment: Experiment[Any] = getattr(importlib.import_module(module), name)(preset)
    return experiment


def _open(arguments: argparse.Namespace, create: bool = False) -> tuple[Experiment[Any], Store]:
    experiment = _experiment(arguments)  # an impossible one is an error before anything is written
    return experiment, experiment.open_store(arguments.results, create)


def run(arguments: argparse.Namespace) -> int:
    """Everything: what is missing is run, then tables and figures are written."""
    from benchmarks.runs.harness import Harness, open_backend

    console = Console(soft_wrap=True)
    experiment, store = _open(arguments, create=True)
    place = (arguments.address, arguments.gpus_per_run)
    device = arguments.device or ("cuda" if arguments.gpus_per_run else "cpu")
    with store.lock(), open_backend(arguments.backend, arguments.jobs, *place) as backend:
        console.print(f"{backend.describe()}, networks on {device}", markup=False)
        outcome = Harness(experiment, store, backend, console, device).run()
        return outcome.close(store, console, lambda: experiment.report(store, console))


def plan(arguments: argparse.Namespace) -> int:
    """The cells of a preset, whether they are complete, and what they cost."""
    from benchmarks.runs.backends import default_jobs
    from benchmarks.runs.costs import print_plan

    jobs = default_jobs() if arguments.jobs is None else arguments.jobs
    print_plan(_experiment(arguments), arguments.results, jobs, Console(soft_wrap=True))
    return 0


def train(arguments: argparse.Namespace) -> int:
    """One cell in this process; for a debugger, or a scheduler of one's own."""
    from benchmarks.runs.cell import run_here

    experiment = _experiment(arguments)
    experiment.find(arguments.cell)  # before anything is written
    store = experiment.open_store(arguments.results, create=True)
    device = arguments.device or "cpu"
    return run_here(experiment, store, arguments.cell, arguments.parent, arguments.wait, device)


def cell(arguments: argparse.Namespace) -> int:
    """One cell of any experiment, as the harness starts it."""
    from benchmarks.runs.cell import opened, run_here

    experiment, store = opened(arguments.experiment, arguments.recipe, arguments.store)
    parent, wait, device = arguments.parent, arguments.wait, arguments.device or "cpu"
    return run_here(experiment, store, arguments.cell, parent, wait, device)


def evaluate(arguments: argparse.Namespace) -> int:
    """Score a model or planner of one's own for the leaderboard, or stored policies again."""
    if arguments.model or arguments.planner:
        if arguments.starts is not None:
            raise BenchmarkError("--starts is for stored policies, not for --model or --planner")
        return _evaluate_entry(arguments)
    of_entries = ("name", "algorithm", "trust", "mask_singularities", "mask_visited", "replace")
    given = [word for word in of_entries if getattr(arguments, word)]
    if given:
        raise BenchmarkError(
            f"--{given[0].replace('_', '-')} belongs to a --model or --planner, which is not given"
        )
    from benchmarks.studies.scoring.scores import Replay, score_again

    chosen = (arguments.episodes, arguments.starts)
    replay = Replay(arguments.preset, arguments.results, *chosen)
    return score_again(replay, Console(soft_wrap=True))


def _evaluate_entry(arguments: argparse.Namespace) -> int:
    from benchmarks.studies.scoring.entries import Entry, glance, join, prepare

    preset, console = load_preset(arguments.preset), Console(soft_wrap=True)
    source = arguments.model[0].stem if arguments.model else arguments.planner.partition(":")[2]
    entry = Entry(
        arguments.name or source or arguments.planner,
        tuple(arguments.model),
        arguments.algorithm,
        arguments.planner,
        arguments.trust,
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


def _of_stored(method: str, text: str) -> Callable[[argparse.Namespace], int]:
    def command(arguments: argparse.Namespace) -> int:
        experiment, store = _open(arguments)
        with store.lock():
            getattr(experiment, method)(store, Console(soft_wrap=True))
        return 0

    command.__doc__ = text
    return command


tables = _of_stored("write_tables", "Write and print the tables from stored data.")
figures = _of_stored("write_figures", "Draw the figures from stored data.")
report = _of_stored("report", "Tables and figures from stored data.")


def verify(arguments: argparse.Namespace) -> int:
    """Recompute every table; exit code 1 if one, the README or the docs disagree."""
    from benchmarks.reporting.verify import store_names, verify_all

    presets = [] if arguments.preset is None else [load_preset(arguments.preset).name]
    report = verify_all(arguments.results, presets, arguments.readme, arguments.docs)
    names = presets or store_names(arguments.results)
    for study in CHECKED:
        check = importlib.import_module(f"benchmarks.studies.{study}").check
        check(report, arguments.results, names, arguments.docs)
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
    from benchmarks.reporting.pages import gallery
    from benchmarks.reporting.pages.includes import rewrite_all
    from benchmarks.reporting.pages.readme import rewrite
    from benchmarks.reporting.verify import presets_of

    if not arguments.readme.is_file():
        raise BenchmarkError(f"{arguments.readme} is missing; name another with --readme")
    if arguments.preset is None:  # the one that the page is about
        named = presets_of(arguments.readme)
        arguments.preset = named[0] if named else DEFAULT_PRESET
    _, store = _open(arguments)
    changed = rewrite(arguments.readme, store)
    print(f"{arguments.readme}: {'rewritten' if changed else 'up to date'}")
    for page in sorted((arguments.readme.parent / "docs").glob("*.md")):
        if store.folder.name in presets_of(page):
            print(f"{page}: {'rewritten' if rewrite(page, store) else 'up to date'}")
    docs = arguments.readme.parent / "docs"
    for page in rewrite_all(docs, arguments.results):
        print(f"{page}: its included tables are up to date")
    if (page := docs / gallery.PAGE).is_file():
        changed = gallery.rewrite(page, arguments.results)
        print(f"{page}: {'rewritten' if changed else 'up to date'}")
    return 0


def classic(arguments: argparse.Namespace) -> int:
    """The same words for the classic tasks, and ``docs``."""
    if arguments.word == "docs":
        from benchmarks.studies.classic import docs
        from benchmarks.studies.classic.presets import load_preset as load_classic
        from benchmarks.studies.classic.results import Results

        _, store = _open(arguments)
        results = Results(load_classic(arguments.preset), store)
        page = arguments.page or docs.page_of(results.preset.name, Path("docs"))
        root = Path(os.path.relpath(store.folder, page.parent)).as_posix()
        changed = docs.write(page, results, root)
        print(f"{page}: {'rewritten' if changed else 'up to date'}")
        return 0
    if arguments.word == "train" and arguments.cell is None:
        raise BenchmarkError("train needs --cell; `plan` lists the ids")
    words = {"run": run, "plan": plan, "tables": tables, "figures": figures, "train": train}
    return words[arguments.word](arguments)


def delegate(word: str, rest: Sequence[str]) -> int:
    """A word with a command line of its own."""
    if word == "codesign":
        try:
            import optuna  # noqa: F401
        except ImportError as error:
            raise BenchmarkError(f"{word} needs pip install '.[tune]': {error}") from error
    if word in MODULES:
        return _main_of(f"benchmarks.studies.{MODULES[word]}", rest)
    if not rest or rest[0] not in SPEED:
        given = f"'{rest[0]}'" if rest else "nothing"
        raise BenchmarkError(f"speed of what? known: {known(SPEED)}; given: {given}")
    return _main_of(SPEED[rest[0]], rest[1:])


def _main_of(module: str, rest: Sequence[str]) -> int:
    main: Any = importlib.import_module(module).main
    return int(main(list(rest)) or 0)
