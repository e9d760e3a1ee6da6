"""Runs of the zoo, killed in the middle and resumed, beside runs that nobody disturbed."""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.reporting.tables.table import Cell, Table
from benchmarks.runs.store import write_text

EVALUATIONS: Final = 20  # in a whole run
LAST: Final = 3  # evaluations at the end that count as where a run ended
POLL: Final = 0.1  # s


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

    def run_of(self, folder: Path) -> Path:
        """Where the zoo puts the first run of a folder."""
        return folder / "rainbow" / f"{self.env.replace('/', '-')}_1"


def evaluations(run: Path) -> tuple[list[int], list[float]]:
    """Steps and mean returns of a run's evaluations so far."""
    try:
        with np.load(run / "evaluations.npz") as stored:
            return stored["timesteps"].tolist(), stored["results"].mean(axis=1).tolist()
    except (OSError, ValueError, EOFError):  # not there yet, or being written
        return [], []


def train(recipe: Recipe, folder: Path, seed: int, *more: str) -> Path:
    """Let a run end, unless it has; begin anew what was cut off."""
    run = recipe.run_of(folder)
    if not (run / "replay_buffer.pkl").exists():
        shutil.rmtree(folder, ignore_errors=True)
        done = subprocess.run(recipe.command(folder, seed, *more), stdout=subprocess.DEVNULL)
        if done.returncode != 0:
            raise BenchmarkError(f"the run in {folder} ended with {done.returncode}")
    return run


def train_and_kill(recipe: Recipe, folder: Path, seed: int) -> Path:
    """Kill a run once it has a checkpoint behind its middle, unless one was."""
    run = recipe.run_of(folder)
    mark = folder / "killed"
    if mark.exists():
        return run
    shutil.rmtree(folder, ignore_errors=True)
    with subprocess.Popen(recipe.command(folder, seed), stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            steps, _ = evaluations(run)
            if steps and steps[-1] > recipe.timesteps / 2 and (run / "checkpoint.zip").exists():
                process.kill()
                break
            time.sleep(POLL)
    if process.returncode >= 0:
        raise BenchmarkError(f"the run in {folder} ended by itself, with {process.returncode}")
    mark.touch()
    return run


def row_of(recipe: Recipe, folder: Path, seed: int) -> list[str]:
    """A seed's three runs in numbers."""
    whole = evaluations(train(recipe, folder / "whole", seed))
    killed_run = train_and_kill(recipe, folder / "killed", seed)
    go_on = ("-i", os.fspath(killed_run / "checkpoint.zip"))
    killed = evaluations(killed_run)
    resumed = evaluations(train(recipe, folder / "resumed", seed, *go_on))
    return [
        str(seed),
        f"{killed[0][-1]:,}",
        f"{killed[1][-1]:.1f}",
        f"{resumed[0][0]:,}",
        f"{resumed[1][0]:.1f}",
        f"{np.mean(resumed[1][-LAST:]):.1f}",
        f"{np.mean(whole[1][-LAST:]):.1f}",
    ]


def table_of(recipe: Recipe, rows: Sequence[Sequence[str]]) -> Table:
    """All seeds, and their means."""
    numbers = np.array([[float(text.replace(",", "")) for text in row[1:]] for row in rows])
    means = [f"{x:,.0f}" if i in (0, 2) else f"{x:.1f}" for i, x in enumerate(numbers.mean(axis=0))]
    cells: list[list[Cell]] = [[*row] for row in (*rows, ["mean", *means])]
    return Table(
        name="resume",
        title=f"{recipe.env}, {recipe.timesteps:,} steps: killed and resumed",
        header=["Seed", "Killed at", "return", "Next at", "return", "Ends at", "Undisturbed"],
        rows=cells,
        notes=[
            f"Returns: means of {recipe.episodes} greedy episodes; at the end of the last {LAST} "
            "evaluations.",
            "Killed by SIGKILL after its last evaluation; resumed from its checkpoint with -i.",
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
    rows = [row_of(recipe, folder / "runs" / f"s{s}", s) for s in range(arguments.seeds)]
    text = table_of(recipe, rows).markdown()
    write_text(folder / "resume.md", text)
    Console(soft_wrap=True).print(text, markup=False)
    return 0
