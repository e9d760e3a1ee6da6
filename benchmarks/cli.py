"""Trains, plans, tests, compares and reports.

Exit codes: 0 done, 1 a run failed or a check found a difference, 2 bad input, 130 interrupted.
"""

import argparse
import errno
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from benchmarks.errors import TRUSTED, BenchmarkError, at_least
from benchmarks.protocol.presets import DEFAULT_PRESET, load_preset, preset_names
from benchmarks.reporting import blocks
from benchmarks.runs.backends import BACKENDS, Backend
from benchmarks.runs.cell import check_gpu, opened, run_here
from benchmarks.runs.costs import print_plan
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.harness import Harness, check_disk, check_settings, shown
from benchmarks.runs.store import Store
from benchmarks.studies import catalogue

Given = argparse.Namespace
Options = Mapping[str, Mapping[str, Any]]
MISPLACED: Final = (
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ELOOP, errno.ENAMETOOLONG),
    *(errno.EACCES, errno.EPERM, errno.EROFS),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        parser().print_help()
        return 0
    try:
        if arguments[0] == "study" and len(arguments) > 1 and not arguments[1].startswith("-"):
            return catalogue.study(arguments[1]).main(arguments[2:])
        given = parser().parse_args(arguments)
        return int(given.command(given) or 0)
    except BenchmarkError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where, fix = error.filename, "name another place"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            where, fix = where or "the results folder", "make room, the same command goes on"
        elif where is None or error.errno not in MISPLACED:
            raise
        print(f"error: {error.strerror}: {where}; {fix}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemError) as error:
        # numba makes the latter of a Ctrl-C that meets it in a kernel
        if isinstance(error, SystemError) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        print("Interrupted; the same command goes on from what is stored", file=sys.stderr)
        return 130


def _open(given: Given, create: bool = False) -> tuple[Experiment, Store]:
    one = catalogue.experiment(given.preset)  # a bad one is an error before anything is written
    return one, one.open_store(given.results, create)


def run(given: Given) -> int:
    """Everything: what is missing is run, then tables and figures are written."""
    device = _device(given, given.gpus_per_run)
    console, (one, store) = Console(soft_wrap=True, markup=False), _open(given, create=True)
    with store.lock(), closing(_backend(given)) as backend:
        console.print(f"{backend.describe()}, networks on {device}")
        outcome = Harness(one, store, backend, console, device).run()
        return outcome.close(store, console, lambda: _write(one, "report", store, console))


def _device(given: Given, gpus_per_run: float = 0.0) -> str:
    """Where networks live; a GPU that no run could use is refused before each fails for itself."""
    device = given.device or ("cuda" if gpus_per_run else "cpu")
    if device == "cuda" and catalogue.experiment(given.preset).place:
        raise BenchmarkError(
            "cuda: public tasks run on the CPU; leave out --device, --gpus-per-run"
        )
    if getattr(given, "backend", "") != "ray":
        check_gpu(given.device)
    return device


def _backend(given: Given) -> Backend:
    if given.backend == "ray":
        from benchmarks.runs.ray_backend import RayBackend

        return RayBackend(given.address, given.gpus_per_run, given.jobs)
    for option in ("address", "gpus_per_run"):
        if value := getattr(given, option):
            name = option.replace("_", "-")
            raise BenchmarkError(f"--{name} {value}: only with --backend ray")
    return Backend(given.jobs)


def plan(given: Given) -> None:
    """The cells of a preset, whether they are complete, and what they cost."""
    one = catalogue.experiment(given.preset)
    print_plan(one, given.results, Backend(given.jobs).slots, Console(soft_wrap=True, markup=False))


def train(given: Given) -> int:
    """One cell in this process; for a debugger, or a scheduler of one's own."""
    one = catalogue.experiment(given.preset)
    cell, device = one.find(given.cell), _device(given)  # before anything is written
    store = one.open_store(given.results, create=True)
    if not store.run(cell.id).is_complete():
        check_settings(one, store, [cell])
        check_disk(one, store, [cell], 1)
        one.check([cell])
    with shown(store.run(cell.id), Console(soft_wrap=True, markup=False)):
        return run_here(one, store, cell.id, given.parent, given.wait, device)


def cell(given: Given) -> int:
    """One cell of any experiment, as the harness starts it."""
    one, store = opened(given.experiment, given.recipe, given.store)
    device = given.device or "cpu"
    return run_here(one, store, given.cell, given.parent, given.wait, device, given.settings or "")


def evaluate(given: Given) -> int:
    """Score a model or planner of one's own for the leaderboard, or stored policies again."""
    console = Console(soft_wrap=True, markup=False)
    if given.model or given.planner:
        from benchmarks.studies.scoring.entries import glance, score

        if given.starts is not None:
            raise BenchmarkError("--starts is for stored policies, not for --model or --planner")
        preset = load_preset(given.preset)
        source = given.model[0].stem if given.model else given.planner.partition(":")[2]
        given.name = given.name or source or f"own-{given.planner}"
        if given.episodes is None:
            score(preset, given, console)
            return 0
        for line in glance(preset, given):
            print(line)
        print("Nothing was stored: the leaderboard needs all test episodes")
        return 0
    of_entries = ("name", "algorithm", "trust", "mask_singularities", "mask_visited", "replace")
    if result := [word for word in of_entries if getattr(given, word)]:
        raise BenchmarkError(
            f"--{result[0].replace('_', '-')} belongs to a --model or --planner, which is not given"
        )
    from benchmarks.studies.scoring.scores import Replay, score_again

    return score_again(Replay(given.preset, given.results, given.episodes, given.starts), console)


def _write(one: Experiment, method: str, store: Store, console: Console) -> None:
    try:
        getattr(one, method)(store, console)
    except BenchmarkError:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        # perhaps of a file that can be read, and holds what it must not
        if problems := catalogue.named(store.folder, lambda: one.problems(store)):
            message = f"{problems[0]} ({type(error).__name__}: {error})"
            raise BenchmarkError(message) from error
        raise


def _of_stored(method: str) -> Callable[[Given], None]:
    def command(given: Given) -> None:
        one, store = _open(given)
        with store.lock():
            _write(one, method, store, Console(soft_wrap=True, markup=False))

    return command


def report(given: Given) -> None:
    """Tables and figures of presets and studies, then the blocks of all pages beside the folder."""
    names = [given.preset] if given.preset else list(catalogue.stores(given.results))
    others = [] if given.preset else catalogue.others(given.results)
    for folder in others:
        print(f"{folder}: left out; --preset FILE says what is in it")
    if not (names or others):
        raise BenchmarkError(f"{given.results} has no results; run: python -m benchmarks run")
    for name in names:
        _of_stored("report")(argparse.Namespace(preset=name, results=given.results))
    if not given.preset:
        catalogue.write_studies(given.results)
    for page in blocks.rewrite(given.results, catalogue.all_blocks(given.results)):
        print(f"{page}: rewritten")


def verify(given: Given) -> int:
    """Recompute every table and block; exit code 1 if one disagrees with the stored data."""
    number = 0
    for what, problems in catalogue.verify(given.results, [given.preset] if given.preset else []):
        if what:
            print(what, flush=True)
        number += len(problems)
        for problem in problems:
            print(problem, file=sys.stderr)
    if number:
        print(f"{number} difference{'s' if number > 1 else ''} found", file=sys.stderr)
        return 1
    print("Everything agrees with the stored data")
    return 0


def watch(given: Given) -> None:
    """The optimum or a policy in the browser."""
    from benchmarks.studies.media import watch as show

    show(given)


def studies(given: Given) -> None:
    """All studies, a line for each."""
    for name, (_, text) in sorted(catalogue.STUDIES.items()):
        print(f"{name:15} {text}")


# keyword arguments of add_argument by name, as a study has them
RESULTS: Options = {
    "--results": {"type": Path, "default": Path("results"), "help": "results folder"}
}
PRESET: Options = {
    "--preset": {"default": DEFAULT_PRESET, "help": f"{', '.join(preset_names())}, one of the "
                 f"public tasks', or the path of a .yaml file (default: {DEFAULT_PRESET})"},
}  # fmt: skip
OF_ONE: Options = {"--preset": {"help": "one preset (default: all with results, and all pages)"}}
DEVICE: Options = {
    "--device": {"choices": ("cpu", "cuda"),
                 "help": "place of the networks (default: cpu, with GPUs cuda)"},
}  # fmt: skip
JOBS: Options = {"--jobs": {"type": at_least(1), "help": "number of processes (default: cores)"}}
CELL: Options = {
    "--cell": {"required": True, "help": "id of the cell, as `plan` lists it"},
    "--parent": {"type": int, "help": argparse.SUPPRESS},  # the harness
    "--wait": {"type": float, "default": 0.0, "help": "s to wait for another process"},
}
OPENED: Options = {"experiment": {}, "recipe": {}, "store": {"type": Path}, "--settings": {}}
CLUSTER: Options = {
    "--backend": {"choices": BACKENDS, "default": BACKENDS[0], "help": "place of processes"},
    "--address": {"help": "address of the Ray cluster, 'auto' for the one at hand"},
    "--gpus-per-run": {"type": float, "default": 0.0, "help": "GPUs of a run (Ray)"},
}
TRUST: Options = {"--trust": {"action": "store_true", "help": TRUSTED}}
ENTRY: Options = {
    "--model": {"type": Path, "nargs": "+", "metavar": "FILE", "default": [],
                "help": ".zip of any SB3 or sb3-contrib algorithm: one, or one per seed"},
    "--planner": {"default": "", "metavar": "NAME",
                  "help": "optimum, or module:function of your own"},
    "--name": {"help": "name on the leaderboard (default: the file's)"},
    "--algorithm": {"help": "class of the model (default: the file's)"},
    **TRUST,
    "--mask-singularities": {"action": "store_true", "help": "mask collisions and singular moves"},
    "--mask-visited": {"type": at_least(0), "default": 0, "metavar": "N",
                       "help": "mask the last N configurations"},
    "--replace": {"action": "store_true", "help": "overwrite the entry of this name, every seed"},
    "--episodes": {"type": at_least(1), "metavar": "N",
                   "help": "test episodes per seed, for a look: nothing joins the leaderboard"},
    "--starts": {"type": at_least(0), "metavar": "NUMBER",
                 "help": "number of a set of new starts for stored policies, 20 episodes per seed"},
}  # fmt: skip
WATCH: Options = {
    "--geometry": {"choices": ("initial", "optimized"),
                   "help": "geometry of the 3-RRS (default: the model's)"},
    "--model": {"type": Path, "help": "a trained model instead of the optimum"},
    **TRUST,
    "--twin": {"action": "store_true", "help": "masses, servos and contact (MuJoCo)"},
    "--host": {"default": "127.0.0.1", "help": "address to listen on"},
    "--port": {"type": int, "default": 8080, "help": "port to listen on"},
}  # fmt: skip
#: verb -> function, help, options
VERBS: Final[dict[str, tuple[Callable[[Given], Any], str, Options]]] = {
    "run": (run, "missing runs, then tables and figures",
            {**PRESET, **RESULTS, **JOBS, **DEVICE, **CLUSTER}),
    "plan": (plan, "cells of a preset, their state and cost", {**PRESET, **RESULTS, **JOBS}),
    "train": (train, "one cell in this process", {**PRESET, **RESULTS, **CELL, **DEVICE}),
    "evaluate": (evaluate, "a --model or --planner of your own on the leaderboard, or stored "
                 "policies again", {**PRESET, **RESULTS, **ENTRY}),
    "tables": (_of_stored("write_tables"), "tables from stored runs", {**PRESET, **RESULTS}),
    "figures": (_of_stored("write_figures"), "figures from stored runs", {**PRESET, **RESULTS}),
    "report": (report, "tables, figures, README and docs from stored data", {**OF_ONE, **RESULTS}),
    "verify": (verify, "comparison of tables, README and docs with stored data",
               {**OF_ONE, **RESULTS}),
    "watch": (watch, "the optimum or a policy in the browser", {**RESULTS, **WATCH}),
    "study": (studies, "one of the studies: study NAME --help; alone, their names", {}),
    "cell": (cell, "", {**OPENED, **CELL, **DEVICE}),
}  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """The parser of all verbs."""
    result = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    verbs = result.add_subparsers(required=True, metavar="verb")
    for name, (command, text, options) in VERBS.items():
        texts: dict[str, Any] = {"help": text, "description": text} if text else {}
        verb = verbs.add_parser(name, **texts)
        for option, settings in options.items():
            verb.add_argument(option, **settings)
        verb.set_defaults(command=command)
    return result
