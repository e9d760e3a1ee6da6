"""Bring your own method: a model or planner scored on the test protocol, beside a store's own runs.

An entry lies in ``results/<preset>/entries/<name>-optimized-s<seed>/`` with the same files as a run
and takes its place in the leaderboard. It never mixes with the preset's own cells.
"""

import argparse
import dataclasses
import hashlib
import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from operator import index
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from rich.console import Console
from rich.progress import Progress

from benchmarks.errors import BenchmarkError, known, resolve
from benchmarks.evaluation import evaluate
from benchmarks.evaluation.model_files import detect_algorithm, fitting_observation, load_model
from benchmarks.methods.base import Plan
from benchmarks.methods.episodes import Episode, env_arguments
from benchmarks.protocol import labels
from benchmarks.protocol.plan import DESIGN, METHODS, Cell
from benchmarks.protocol.presets import Preset
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.runs.cell import run_once
from benchmarks.runs.harness import bar
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.base import source_digest
from benchmarks.studies.scoring.scores import metric_lines
from coop_env.simulation.task import TRAIL

Given = argparse.Namespace
GEOMETRY: Final = "optimized"
OPTIMUM: Final = "optimum"  # OMPL's planners take one seed a process, so that no entry resumes
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,60}")
Run = Callable[[evaluate.OnProgress], evaluate.Rows]
#: a seed's settings, and a function that plays its test episodes
Scorer = tuple[dict[str, Any], Run]


def prepare(preset: Preset, given: Given) -> list[Scorer]:
    """Load and check the entry before anything is written; returns a scorer for each seed.

    The masks are those of the environment that the method acts in, as the model was trained with.
    BenchmarkError if the name, the files or their spaces do not fit.
    """
    _check(preset, given)
    number = len(preset.seeds)
    files = given.model if len(given.model) > 1 else given.model * number
    loaded = {path: load_model(path, given.algorithm, given.trust) for path in given.model}
    named = {path: given.algorithm or detect_algorithm(path) for path in loaded}
    if len(kinds := set(named.values())) > 1:
        raise BenchmarkError(f"the models are of {known(kinds)}: score each by a --name of its own")
    masks = {name: getattr(given, name) for name in ("mask_singularities", "mask_visited")}
    own = ":" in given.planner

    def scorer(seed: int, path: Path | None) -> Scorer:
        cell = Cell(given.name, "full", GEOMETRY, "", seed)
        if path is None:
            player, noise = evaluate.in_turn(_planner(preset, given.planner, seed)), [0.0]
            edited = source_digest(resolve(given.planner, "planner")) if own else {}
            source = {"algorithm": given.planner, "sha256": "", **edited}
            protocol = dict(masks)
        else:
            player = evaluate.by_policy(evaluate.model_policy(loaded[path]), seed)
            noise = preset.evaluation.noise
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            source = {"algorithm": named[path], "sha256": digest}
            protocol = {"observation": fitting_observation(loaded[path], path), **masks}
        tests, entry = asdict(preset.evaluation), {**source, **protocol}
        config = {"cell": asdict(cell), "evaluation": tests, "entry": entry}
        arguments = env_arguments(preset, cell) | protocol
        conditions = [evaluate.Condition(arguments, level) for level in noise]
        return config, partial(evaluate.play, player, preset, seed, conditions)

    return list(map(scorer, preset.seeds, files or (None,) * number))


def score(preset: Preset, given: Given, console: Console) -> None:
    """Score an entry on the preset's test episodes, store it, and write the leaderboard.

    Complete seeds are kept. With ``--replace`` it may replace an entry of the same name; without, a
    name that is taken is a BenchmarkError.
    """
    scorers = prepare(preset, given)
    store = Store.open(given.results, preset.name, create=True)
    with store.lock():
        replacing, old = store.folder / "replacing", []
        shutil.rmtree(replacing, ignore_errors=True)
        todo = [(RunFolder(store.entries / Cell(**c["cell"]).id), c, run) for c, run in scorers]
        ids = {folder.id for folder, *_ in todo}
        mine = (run for run in store.entered() if run.config()["cell"]["method"] == given.name)
        # entries of seeds that the preset no longer has
        old += [_given_up(run, given) for run in mine if run.id not in ids]
        for folder, config, _ in todo:
            if (folder.path / "config.yaml").is_file() and folder.config() != config:
                # a failed entry does not reserve its name
                old.append(_given_up(folder, given) if folder.is_complete() else folder.path)
        if complete := sum(folder.is_complete() and folder.path not in old for folder, *_ in todo):
            console.print(f"{complete} of {len(todo)} seeds were scored already")
        with bar(console) as progress:
            for folder, config, run in todo:
                here = RunFolder(replacing / folder.id) if folder.path in old else folder
                _score(here, config, run, preset.name, progress)
        for path in old:  # removed only once all seeds of the new one have played
            shutil.rmtree(path)
        for path in old:  # so that old and new never stand side by side
            if path.name in ids:
                (replacing / path.name).rename(path)
        shutil.rmtree(replacing, ignore_errors=True)
        built = {table.name: table for table in build_tables(Results(store))}
        for table in built.values():
            table.write(store.tables)
    console.print(built["leaderboard"].markdown(), highlight=False)
    console.print(f"Episodes: {', '.join(str(folder.path) for folder, *_ in todo)}")
    console.print(f"Leaderboard (CSV, Markdown, LaTeX): {store.tables / 'leaderboard.md'}")


def _given_up(folder: RunFolder, given: Given) -> Path:
    """The path of an entry to replace; BenchmarkError without ``--replace``."""
    if not given.replace:
        raise BenchmarkError(
            f"'{given.name}' is already on the board with another model, protocol or seed "
            f"({folder.path}); choose another --name, or --replace it"
        )
    return folder.path


def _score(
    folder: RunFolder, config: dict[str, Any], run: Run, preset: str, progress: Progress
) -> None:
    task = progress.add_task(folder.id, total=1.0)

    def work() -> dict[str, Any]:
        folder.write_rows("episodes", run(lambda share: progress.update(task, completed=share)))
        return {"training": {}}

    run_once(folder, config, preset, work)
    progress.update(task, completed=1.0)


def glance(preset: Preset, given: Given) -> Iterator[str]:
    """An entry's metrics on the first ``--episodes`` of each seed; nothing is stored."""
    tests = dataclasses.replace(preset.evaluation, episodes=given.episodes)
    preset = dataclasses.replace(preset, evaluation=tests)
    for config, run in prepare(preset, given):
        name = f"{given.name}, seed {config['cell']['seed']}"
        yield from metric_lines(pd.DataFrame(run(lambda share: None)), name)


def _check(preset: Preset, given: Given) -> None:
    if not _NAME.fullmatch(given.name):
        raise BenchmarkError(
            f"name '{given.name}': letters, digits and . _ + - only, 61 at most; say another with "
            "--name"
        )
    if varied := [name for name, track in preset.tracks.items() if track.task]:
        raise BenchmarkError(
            f"preset '{preset.name}' has no leaderboard, as its tracks vary the task "
            f"('{varied[0]}'): take another --preset"
        )
    taken = {*METHODS, DESIGN, *labels.METHODS.values()}
    if given.name in taken:
        raise BenchmarkError(
            f"name '{given.name}' is one of the harness's own: choose another --name than "
            f"{known(taken)}"
        )
    if given.mask_visited > TRAIL:
        raise BenchmarkError(f"--mask-visited {given.mask_visited}: at most {TRAIL}")
    if bool(given.model) == bool(given.planner):
        raise BenchmarkError("give either --model or --planner")
    if given.model and len(given.model) not in (1, len(preset.seeds)):
        raise BenchmarkError(
            f"{len(given.model)} models for {len(preset.seeds)} seeds: give one for all, or one "
            f"for each of the seeds {preset.seeds}"
        )


def _planner(preset: Preset, planner: str, seed: int) -> Callable[[Episode], None]:
    if planner == OPTIMUM:
        return evaluate.planner_runner(preset, Cell(planner, "full", GEOMETRY, "", seed))
    if ":" not in planner:
        raise BenchmarkError(
            f"unknown planner '{planner}'; known: {OPTIMUM}, or module:function of your own; a "
            "preset has the others as methods"
        )
    function = resolve(planner, "planner")
    if not callable(function):
        kind = type(function).__name__
        raise BenchmarkError(f"planner '{planner}' is no function but {kind}")
    ask = checked(function, planner)
    return lambda episode: evaluate.follow(episode, ask)


def checked(plan: Callable[[Any], Any], name: str) -> Callable[[Any], Plan]:
    """A user's own planner in the harness's form.

    ``plan(env)`` returns the moves to make next, as integers from 0 to 11 (or a
    :class:`~benchmarks.methods.base.Plan`); none ends the episode.
    """

    def ask(env: Any) -> Plan:
        before = env.configuration
        began = time.perf_counter()
        answer = plan(env)
        seconds = time.perf_counter() - began
        if not np.array_equal(before, env.configuration):
            raise BenchmarkError(f"planner '{name}' moved the environment; plan on a copy")
        status = answer.status if isinstance(answer, Plan) else "no plan"
        moves = _moves(answer.moves if isinstance(answer, Plan) else answer, name)
        return Plan(status, np.array(moves, np.int64), seconds)

    return ask


def _moves(answer: Any, name: str) -> list[int]:
    if answer is None:
        return []
    try:
        moves = [index(move) for move in answer]
    except (TypeError, ValueError):
        raise BenchmarkError(f"planner '{name}' returned {answer!r}, not a list of moves") from None
    wrong = [move for move in moves if not 0 <= move < 12]
    if wrong:
        raise BenchmarkError(f"planner '{name}' returned move {wrong[0]}; moves are 0 to 11")
    return moves
