"""Runs of the zoo, killed in the middle and resumed, beside runs that nobody disturbed."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.reporting.tables.table import Cell, Table
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text

EVALUATIONS: Final = 20  # in a whole run
LAST: Final = 3  # evaluations at the end that count as where a run ended
POLL: Final = 0.1  # s
RUNS: Final = 2.0  # whole runs that a seed costs: one undisturbed, one in two halves

Tick = Callable[[float], None]  # takes how many of a seed's whole runs are behind it


@dataclass(frozen=True)
class Recipe:
    """What all runs of a study share.

    Attributes:
        env: the environment's id.
        timesteps: of a whole run.
        episodes: of an evaluation.
        rest: more words for the zoo's command line.
    """

    env: str
    timesteps: int
    episodes: int
    rest: tuple[str, ...] = ()

    def command(self, folder: Path, seed: int, *more: str) -> list[str]:
        """The zoo's command line of a run that can be resumed."""
        every = str(max(self.timesteps // EVALUATIONS, 1))
        return [
            *(sys.executable, "-m", "sb3_rainbow.zoo", "train", "--env", self.env),
            *("-n", str(self.timesteps), "--seed", str(seed), "-f", str(folder)),
            *("--eval-freq", every, "--eval-episodes", str(self.episodes)),
            *("--save-freq", every, "--save-replay-buffer", "--verbose", "0"),
            *("--device", "cpu", "--num-threads", "1", *self.rest, *more),
        ]

    def line(self, seeds: int) -> str:
        """The study's own command line."""
        words = ["--env", self.env, "--timesteps", str(self.timesteps), "--seeds", str(seeds)]
        words += ["--episodes", str(self.episodes), *self.rest]
        return shlex.join(["python", "-m", "benchmarks", "resume", *words])

    def run_of(self, folder: Path) -> Path:
        """Where the zoo puts the first run of a folder."""
        return folder / "rainbow" / f"{self.env.replace('/', '-')}_1"


def evaluations(run: Path) -> tuple[list[int], list[float]]:
    """Steps and mean returns of a run's evaluations so far."""
    try:
        with np.load(run / "evaluations.npz") as stored:
            return stored["timesteps"].tolist(), stored["results"].mean(axis=1).tolist()
    except (OSError, ValueError, EOFError, BadZipFile):  # not there yet, or being written
        return [], []


def train(recipe: Recipe, folder: Path, seed: int, tick: Tick, more: Sequence[str] = ()) -> Path:
    """Let a run end, unless it has; begin anew what was cut off."""
    run = recipe.run_of(folder)
    if not (run / "replay_buffer.pkl").exists():
        shutil.rmtree(folder, ignore_errors=True)
        code = _watch(recipe.command(folder, seed, *more), run, recipe, tick)
        if code != 0:
            raise BenchmarkError(f"the run in {folder} ended with {code}")
    return run


def train_and_kill(recipe: Recipe, folder: Path, seed: int, tick: Tick) -> Path:
    """Kill a run once it has a checkpoint behind its middle, unless one was."""
    run = recipe.run_of(folder)
    mark = folder / "killed"
    if not mark.exists():
        shutil.rmtree(folder, ignore_errors=True)
        code = _watch(recipe.command(folder, seed), run, recipe, tick, kill=True)
        if code >= 0:
            raise BenchmarkError(f"the run in {folder} ended by itself, with {code}")
        mark.touch()
    return run


def _watch(words: list[str], run: Path, recipe: Recipe, tick: Tick, kill: bool = False) -> int:
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
        try:
            while process.poll() is None:
                steps, _ = evaluations(run)
                share = steps[-1] / recipe.timesteps if steps else 0.0
                tick(share)
                if kill and share > 0.5 and (run / "checkpoint.zip").exists():
                    break
                time.sleep(POLL)
        finally:  # a study that is interrupted does not wait for its run
            process.kill()
    return process.returncode


def measure(recipe: Recipe, folder: Path, seed: int, tick: Tick) -> dict[str, Any]:
    """The evaluations of a seed's three runs, and what they were made with."""
    whole = train(recipe, folder / "whole", seed, lambda share: tick(share))
    killed = train_and_kill(recipe, folder / "killed", seed, lambda share: tick(1.0 + share))
    go_on = ("-i", os.fspath(killed / "checkpoint.zip"))
    resumed = train(recipe, folder / "resumed", seed, lambda share: tick(1.5 + share / 2), go_on)
    tick(RUNS)
    runs = {"undisturbed": whole, "killed": killed, "resumed": resumed}
    return {
        "seed": seed,
        "machine": describe(),
        **{name: evaluations(run) for name, run in runs.items()},
    }


def row_of(found: Mapping[str, Any]) -> list[str]:
    """A seed's three runs in numbers."""
    killed, resumed = found["killed"], found["resumed"]
    return [
        str(found["seed"]),
        f"{killed[0][-1]:,}",
        f"{killed[1][-1]:.1f}",
        f"{resumed[0][0]:,}",
        f"{resumed[1][0]:.1f}",
        f"{np.mean(resumed[1][-LAST:]):.1f}",
        f"{np.mean(found['undisturbed'][1][-LAST:]):.1f}",
    ]


def table_of(recipe: Recipe, found: Sequence[Mapping[str, Any]]) -> Table:
    """All seeds, and their means."""
    rows = [row_of(one) for one in found]
    numbers = np.array([[float(text.replace(",", "")) for text in row[1:]] for row in rows])
    means = [f"{x:,.0f}" if i in (0, 2) else f"{x:.1f}" for i, x in enumerate(numbers.mean(axis=0))]
    cells: list[list[Cell]] = [[*row] for row in (*rows, ["mean", *means])]
    commits = sorted({one["machine"]["commit"][:9] for one in found})
    machines = sorted({one["machine"]["machine"]["processor"] for one in found})
    return Table(
        name="resume",
        title=f"{recipe.env}, {recipe.timesteps:,} steps: killed and resumed",
        header=["Seed", "Killed at", "return", "Next at", "return", "Ends at", "Undisturbed"],
        rows=cells,
        notes=[
            f"Returns: means of {recipe.episodes} greedy episodes; at the end of the last {LAST} "
            "evaluations.",
            "Killed by SIGKILL after its last evaluation; resumed from its checkpoint with -i.",
            f"Command: `{recipe.line(len(found))}`; commit {', '.join(commits)}; "
            f"{'; '.join(machines)}.",
        ],
    )


def main(words: Sequence[str]) -> int:
    """Run what is missing, then write and print the table."""
    line = argparse.ArgumentParser(
        prog="python -m benchmarks resume",
        description=__doc__,
        epilog="What is not known here goes to the zoo's train, such as --conf-file.",
    )
    line.add_argument("--env", default="CartPole-v1")
    line.add_argument("--timesteps", type=at_least(100), default=50_000, help="of a whole run")
    line.add_argument("--seeds", type=at_least(1), default=5, help="how many")
    line.add_argument("--episodes", type=at_least(1), default=10, help="of an evaluation")
    line.add_argument("--out", type=Path, default=Path("results/resume"), help="folder")
    arguments, rest = line.parse_known_args(words)
    recipe = Recipe(arguments.env, arguments.timesteps, arguments.episodes, tuple(rest))
    folder = arguments.out / recipe.env.replace("/", "-")
    console = Console(soft_wrap=True)
    found = []
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), Elapsed(), Remaining())
    with Progress(*columns, console=console, refresh_per_second=2, transient=True) as progress:
        bar = progress.add_task(recipe.env, total=RUNS * arguments.seeds)
        for seed in range(arguments.seeds):
            stored = folder / f"seed_{seed}.json"
            if not stored.exists():

                def tick(share: float, behind: float = RUNS * seed) -> None:
                    progress.update(bar, completed=behind + share)

                one = measure(recipe, folder / "runs" / f"s{seed}", seed, tick)
                write_text(stored, json.dumps({"recipe": asdict(recipe), **one}, indent=1) + "\n")
            one = json.loads(stored.read_text(encoding="utf-8"))
            if one["recipe"] != json.loads(json.dumps(asdict(recipe))):
                raise BenchmarkError(
                    f"{stored} was made with other arguments ({one['recipe']}); choose another "
                    "--out, or remove it"
                )
            found.append(one)
            progress.update(bar, completed=RUNS * (seed + 1))
    text = table_of(recipe, found).markdown()
    write_text(folder / "resume.md", text)
    console.print(text, markup=False)
    console.print(f"{folder / 'resume.md'}; the runs lie in {folder / 'runs'}", markup=False)
    return 0
