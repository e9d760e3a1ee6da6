"""``python -m benchmarks codesign``: the 3-RRS is chosen for what the team achieves.

Two studies, of (lambda1, lambda2) and of (L2, home heave), in three parts. The exact optimum with
both robots moving at once scores designs for Optuna's NSGA-II: success and mean ticks. One policy
that sees the design, trained over random ones, scores them too. Then a policy is trained on each of
the designs that were chosen, over seeds, and tested on the test starts. What is complete is kept:
the same command goes on. Written to ``results/codesign/`` and to a block of ``docs/design.md``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd
import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import at_least
from benchmarks.reporting.pages import blocks
from benchmarks.runs.backends import LocalBackend
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.harness import Harness
from benchmarks.runs.machine import describe
from benchmarks.runs.store import RunFolder, write_text
from benchmarks.studies.design.codesign import search
from benchmarks.studies.design.codesign.conditioned import Conditioned
from benchmarks.studies.design.codesign.figures import write_figures
from benchmarks.studies.design.codesign.found import POLICIES, TABLES, Found, on_front
from benchmarks.studies.design.codesign.spaces import (
    ALL,
    OF_ONE,
    STUDIES,
    Machine,
    given,
    machine_of,
    margin,
    optimum,
)
from benchmarks.studies.design.codesign.tell import BLOCK, PAGE, block, tell
from benchmarks.studies.insertion import Insertion
from coop_env.geometry import GEOMETRIES

PARTS: Final = ("search", "conditioned", "policies")
EPISODES: Final = 100  # of a test, for each seed


def main(words: Sequence[str]) -> int:
    """Run what is missing, then tables, figures and the page's block; returns the exit code."""
    arguments = _parser().parse_args(list(words))
    folder, console = RunFolder(arguments.results / "codesign"), Console(soft_wrap=True)
    asked: dict[str, Any] = {"geometry": given(arguments.geometry), "bounds": arguments.bounds}
    machine = machine_of(**asked)
    names = ("designs", "starts", "steps", "candidates", "seeds", "policy_steps")
    searched = (folder.path / "codesign.json").is_file()
    best = {} if searched else {study: machine.area_best(study) for study in STUDIES}
    folder.begin(asked | {name: getattr(arguments, name) for name in names})
    with folder.lock():
        if not searched:
            _search(folder, machine, best, words, console)
        code, backend = 0, LocalBackend(arguments.jobs)
        if arguments.until != "search":
            code = _train(Conditioned(folder.path), folder, backend, console)
        if code == 0:
            _choose(folder, machine, arguments.seeds)
        if code == 0 and arguments.until == "policies":
            preset = _write_preset(folder, machine)
            code = _train(Insertion(str(preset)), folder, backend, console)
        if code:
            return code
        found = Found(folder.path)
        text, drawn = tell(found), write_figures(found)
        write_text(folder.path / TABLES, text + "\n")
    shown = block(text, folder.path, arguments.docs)
    if (page := arguments.docs / PAGE).is_file():
        blocks.rewrite(page, lambda old: blocks.fill(old, BLOCK, lambda _: shown))
    console.print(text, markup=False, highlight=False)
    console.print(f"Tables, data: {folder.path}; figures: {', '.join(map(str, drawn))}")
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks codesign", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add = parser.add_argument
    add("--results", type=Path, default=Path("results"), help="results folder")
    add("--docs", type=Path, default=Path("docs"), help=f"folder of {PAGE}")
    text = "what is varied: optimized, initial, or a YAML file of RRSGeometry's fields"
    add("--geometry", default="optimized", help=text)
    text = "of lambda1, lambda2, distal_length (m), home_heave (m), in place of the defaults"
    add("--bounds", nargs="+", default=[], metavar="NAME=LOW:HIGH", help=text)
    add("--designs", type=at_least(2), default=300, help="that the optimum scores, of each study")
    add("--starts", type=at_least(2), default=200, help="validation starts of each design")
    add("--steps", type=at_least(1), default=300_000, help="of the policy for all designs")
    add("--candidates", type=at_least(2), default=100, help="that it scores, of each study")
    add("--seeds", type=at_least(2), default=5, help="trainings on each chosen design")
    add("--policy-steps", type=at_least(1), default=None, help="of each (default: the track's)")
    add("--jobs", type=at_least(1), default=None, help="processes (default: cores)")
    add("--until", choices=PARTS, default=PARTS[-1], help="the last part to run (default: all)")
    return parser


def _search(
    folder: RunFolder, machine: Machine, best: dict[str, Any], words: Sequence[str],
    console: Console,
) -> None:  # fmt: skip
    """Score the designs by the optimum: designs.csv, and what the policy for all is to play."""
    asked, began = folder.config(), time.process_time()
    score = partial(optimum, seed=0, starts=asked["starts"])
    rows = []
    for name, geometry in machine.named.items():
        study = ALL if name == machine.base_name else "lambdas"
        rows.append({"design": name, **search.row_of(study, geometry, score(geometry))})
    floor = min(row["success"] for row in rows)
    for study, values in best.items():
        geometry = machine.geometry(values)
        rows.append({"design": f"{study}-area", **search.row_of(study, geometry, score(geometry))})
    studies = {}
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), Elapsed(), Remaining())
    with Progress(*columns, console=console, refresh_per_second=2) as progress:
        tasks = {study: progress.add_task(study, total=asked["designs"]) for study in STUDIES}
        for study, task in tasks.items():
            one = search.Search(folder.path, study, machine, floor)
            rows += one.run(asked["designs"], score, partial(_advance, progress, task))
            studies[study] = {"skipped": one.skipped(), "bounds": {
                name: machine.bounds[name] for name in STUDIES[study]}}  # fmt: skip
    folder.write_rows("designs", rows)
    played = _candidates(pd.DataFrame(rows), asked["candidates"], floor)
    folder.write_rows("candidates", [dict(row) for _, row in played.iterrows()])
    told = {
        "command": _command(words), "machine": describe(),
        "cpu_seconds": time.process_time() - began, "floor": floor, "most": machine.most,
        "base": machine.base_name, "studies": studies,
    }  # fmt: skip
    write_text(folder.path / "codesign.json", json.dumps(told, indent=1) + "\n")


def _command(words: Sequence[str]) -> str:
    """What makes all of it: the words without those that stop early, or say how many at once."""
    parts = ["python -m benchmarks codesign", *words]
    for name in ("--until", "--jobs"):
        if name in parts:
            del parts[parts.index(name) : parts.index(name) + 2]
    return " ".join(parts)


def _advance(progress: Progress, task: Any, done: int) -> None:
    progress.update(task, completed=done)


def _candidates(rows: pd.DataFrame, number: int, floor: float) -> pd.DataFrame:
    """The designs with a name, the fronts, and of each study so many, evenly by success."""
    keep = ~rows["design"].str.contains(r"\d")
    for study in STUDIES:
        mine = rows[rows["study"].isin([study, ALL])]
        keep[mine.index] |= on_front(mine, floor)
        ranked = mine.sort_values(["success", "ticks"]).index
        keep[ranked[:: -(-len(ranked) // number)]] = True
    return rows[keep]


def _train(
    experiment: Experiment[Any], folder: RunFolder, backend: LocalBackend, console: Console
) -> int:
    """Run the cells of an experiment that are missing; returns the command's exit code."""
    store = experiment.open_store(folder.path, create=True)
    with store.lock():
        outcome = Harness(experiment, store, backend, console).run()
        return outcome.close(store, console, lambda: None)


def _choose(folder: RunFolder, machine: Machine, seeds: int) -> None:
    """The optimum of the chosen designs on their test starts: chosen.csv, unless it is there."""
    found = Found(folder.path)
    chosen = found.choose()
    if folder.has_rows("chosen"):
        stored = zip(found.chosen["design"], found.chosen["chosen"], strict=True)
        if dict(stored) == chosen:
            return
    rows = []
    for design, why in chosen.items():
        geometry = found.geometry(machine, design)
        known = {"design": design, "chosen": why, "sigma_cone": margin(geometry)}
        rows += [
            known | {"seed": seed, **vars(optimum(geometry, seed, EPISODES, "test"))}
            for seed in range(seeds)
        ]
    folder.write_rows("chosen", rows)


def _write_preset(folder: RunFolder, machine: Machine) -> Path:
    """The preset that trains a policy on each of the chosen designs."""
    asked, found = folder.config(), Found(folder.path)
    chosen = list(found.choose())
    own = [design for design in chosen if design not in GEOMETRIES]
    preset = {
        "description": "A policy on each of the designs that the co-design chose",
        "seeds": list(range(asked["seeds"])),
        "evaluation": {"episodes": EPISODES, "noise": [0.0], "stream": "test"},
        "tracks": {OF_ONE: {"timesteps": asked["policy_steps"]} if asked["policy_steps"] else None},
        "geometries": {design: found.geometry(machine, design).as_dict() for design in own},
        "runs": [{"methods": ["rainbow"], "geometries": chosen, "tracks": [OF_ONE]}],
    }
    path = folder.path / f"{POLICIES}.yaml"
    write_text(path, yaml.safe_dump(preset, sort_keys=False))
    return path
