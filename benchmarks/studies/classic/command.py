"""``python -m benchmarks classic``: Rainbow beside DQN and QR-DQN on small tasks.

Exit codes: 0 done, 1 a run failed, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.errors import BenchmarkError
from benchmarks.runs.store import Store
from benchmarks.studies.classic.plan import expand, find, settings
from benchmarks.studies.classic.presets import DEFAULT_PRESET, Preset, load_preset, preset_names

FOLDER = "classic"
WORDS = {
    "run": "train what is missing, then tables and figures",
    "plan": "list the runs of a preset and their state",
    "tables": "write and print the tables from stored runs",
    "figures": "draw the figures from stored runs",
    "docs": "rewrite the results in docs/rainbow.md",
    "train": "one run in this process",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = _parser().parse_args(argv)
    preset = load_preset(arguments.preset)
    action = {
        "run": _run,
        "plan": _plan,
        "tables": _tables,
        "figures": _figures,
        "docs": _docs,
        "train": _train,
    }[arguments.word]
    return action(preset, arguments)


def _parser() -> argparse.ArgumentParser:
    words = "; ".join(f"{word}: {text}" for word, text in WORDS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks classic",
        description=__doc__.splitlines()[0] if __doc__ else None,
        epilog=words,
    )
    parser.add_argument("word", nargs="?", default="run", choices=WORDS, help="default: run")
    parser.add_argument(
        "--preset",
        default=DEFAULT_PRESET,
        help=f"{', '.join(preset_names())}, or a .yaml file (default: {DEFAULT_PRESET})",
    )
    parser.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    parser.add_argument(
        *("--workers", "--jobs"), type=_positive, default=None, help="processes (default: cores)"
    )
    parser.add_argument(
        "--page", type=Path, default=Path("docs/rainbow.md"), help="of docs: the file"
    )
    parser.add_argument("--cell", default=None, help="of train: the run's id, as plan lists them")
    parser.add_argument("--parent", type=int, default=None, help=argparse.SUPPRESS)
    parser.add_argument("--wait", type=float, default=0.0, help=argparse.SUPPRESS)
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is below 1")
    return number


def _store(preset: Preset, arguments: argparse.Namespace, create: bool = False) -> Store:
    root = arguments.results / FOLDER
    if not create and not (root / preset.name).is_dir():
        raise BenchmarkError(
            f"{root / preset.name} has no results; "
            f"run: python -m benchmarks classic --preset {arguments.preset}"
        )
    return Store.open(root, preset.name, create)


def _run(preset: Preset, arguments: argparse.Namespace) -> int:
    from benchmarks.runs.backends import default_jobs
    from benchmarks.studies.classic.run import ClassicHarness

    console = Console(soft_wrap=True)
    _check(preset)
    store = _store(preset, arguments, create=True)
    with store.lock():
        jobs = default_jobs() if arguments.workers is None else arguments.workers
        console.print(
            f"Preset '{preset.name}': {preset.description}. {len(expand(preset))} runs, "
            f"{jobs} at a time; Ctrl-C stops, the same command goes on",
            highlight=False,
        )
        harness = ClassicHarness(preset, arguments.preset, store, arguments.results, jobs, console)
        outcome = harness.run()
        return outcome.close(store, console, lambda: _write_page(preset, store, console))


def _write_page(preset: Preset, store: Store, console: Console) -> None:
    _write_tables(preset, store, console)
    _write_figures(preset, store, console)


def _check(preset: Preset) -> None:
    """Have what can be known to fail fail before the first run: settings, missing packages."""
    from benchmarks.studies.classic.train import build_model

    for task in preset.tasks.values():
        for method in preset.methods:
            env = build_model(task, method, 0).get_env()
            assert env is not None
            env.close()


def _train(preset: Preset, arguments: argparse.Namespace) -> int:
    from benchmarks.runs.cell import StopFlag, tell_end
    from benchmarks.studies.classic.cell import run_cell

    if arguments.cell is None:
        raise BenchmarkError("train needs --cell; `plan` lists the ids")
    cell = find(preset, arguments.cell)
    store = _store(preset, arguments, create=True)
    flag = StopFlag(arguments.parent)
    flag.listen()
    complete = run_cell(preset, cell, store, flag, arguments.wait)
    return tell_end(cell.id, store.run(cell.id), complete)


def _plan(preset: Preset, arguments: argparse.Namespace) -> int:
    store = Store(arguments.results / FOLDER, preset.name)
    cells = expand(preset)
    complete = 0
    for cell in cells:
        folder = store.run(cell.id)
        folder.check_config(settings(preset, cell))
        share, note = folder.progress()
        complete += folder.is_complete()
        state = note if folder.is_complete() else f"{100 * share:.0f} % {note}".strip()
        print(f"{cell.id}: {state}")
    print(f"{complete} of {len(cells)} runs of preset '{preset.name}' are complete")
    print(f"Their place: {store.folder}")
    return 0


def _tables(preset: Preset, arguments: argparse.Namespace) -> int:
    store = _store(preset, arguments)
    with store.lock():
        _write_tables(preset, store, Console(soft_wrap=True))
    return 0


def _write_tables(preset: Preset, store: Store, console: Console) -> None:
    from benchmarks.studies.classic.docs import SHOWN
    from benchmarks.studies.classic.results import Results
    from benchmarks.studies.classic.tables import build_tables

    for table in build_tables(Results(preset, store)):
        table.write(store.tables)
        if table.name in SHOWN:
            console.print(table.markdown(), markup=False, highlight=False)
    console.print(f"Tables (CSV, Markdown, LaTeX): {store.tables}")


def _figures(preset: Preset, arguments: argparse.Namespace) -> int:
    store = _store(preset, arguments)
    with store.lock():
        _write_figures(preset, store, Console(soft_wrap=True))
    return 0


def _write_figures(preset: Preset, store: Store, console: Console) -> None:
    from benchmarks.studies.classic.figures import write_figures
    from benchmarks.studies.classic.results import Results

    write_figures(Results(preset, store), store)
    console.print(f"Figures: {store.figures}")


def _docs(preset: Preset, arguments: argparse.Namespace) -> int:
    from benchmarks.studies.classic.docs import write
    from benchmarks.studies.classic.results import Results

    store = _store(preset, arguments)
    page: Path = arguments.page
    root = os.path.relpath(store.folder, page.parent)
    changed = write(page, Results(preset, store), Path(root).as_posix())
    print(f"{page}: {'rewritten' if changed else 'up to date'}")
    return 0
