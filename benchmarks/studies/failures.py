"""Where a learned policy fails, why, and by how much it is slower than the optimum.

The stored policies play their test episodes again, up to the first insertion. A failure is
*infeasible* if no sequence of moves inserts from that start, *singular* if a singularity ended the
episode, *cycle* if the last moves only repeated a few configurations, and else *wandering*.
Written to ``results/<preset>/failures/`` as ``<method>-<track>``: ``.csv``, one row per episode,
and ``.md``.
"""

import argparse
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd

from benchmarks.errors import BenchmarkError, known
from benchmarks.evaluation.evaluate import begin_episodes
from benchmarks.evaluation.model_files import load_stored
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.plan import Cell, expand, settings
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.reporting.results import tail_mean
from benchmarks.runs.store import Store, write_csv
from benchmarks.studies.base import Part, Study, Tick, greedy, read_stored

RECENT: Final = 40  # moves at the end of an episode ...
FEW: Final = 4  # ... among which a cycle has at most so many configurations
CAUSES: Final = ("infeasible", "singular", "cycle", "wandering")


def play(
    preset: Preset, cell: Cell, model: Any, oracle: LatticeOracle, tick: Tick = lambda share: None
) -> list[dict[str, object]]:
    """One row per test episode of a cell's seed."""
    arguments = env_arguments(preset, cell, preset.tracks[cell.track])
    policy, tests, rows = greedy(model), preset.evaluation, []
    for episode in begin_episodes(arguments, cell.seed, tests.episodes, tests.stream):
        env = episode.env
        target, plan = int(env.state["target"]), oracle.plan(env)
        trail, singular = [], False
        while not episode.over and not episode.insertions:
            action = policy(episode.observation, env.action_masks())
            singular = bool(episode.move(action)["singular"])
            trail.append(env.state["offset"].tobytes())
        success = bool(episode.insertions)
        causes = (plan.status == "infeasible", singular, len(set(trail[-RECENT:])) <= FEW, True)
        cause = next(name for name, holds in zip(CAUSES, causes, strict=True) if holds)
        rows.append({
            "seed": cell.seed, "episode": episode.number, "start": episode.start, "target": target,
            "optimum": math.nan if plan.moves is None else float(len(plan.moves)),
            "success": success, "moves": float(episode.moves) if success else math.nan,
            "cause": "" if success else cause,
        })  # fmt: skip
        tick(len(rows) / tests.episodes)
    return rows


def summary(rows: pd.DataFrame) -> str:
    """Success beside the optimum's, the excess in moves, the causes, and success in training."""
    failed, won = rows[rows["success"] == 0]["cause"].tolist(), rows[rows["success"] == 1]
    moves, optimum = won[["moves", "optimum"]].dropna().sum()
    named = ", ".join(f"{failed.count(cause)} {cause}" for cause in CAUSES)
    lines = [
        f"Success at the first hole: {100.0 * len(won) / len(rows):.1f} % of {len(rows)} test "
        f"episodes, the exact optimum's {100.0 * rows['optimum'].notna().mean():.1f} %."
    ]
    if optimum:
        lines.append(f"Moves over the optimum's: {100.0 * (moves / optimum - 1.0):.1f} %.")
    lines.append(f"Failures: {named}.")
    acting = rows.groupby("seed")["acting"].first().mean()
    if not math.isnan(acting):  # a training episode ended there
        lines.append(f"Success with exploration, last tenth of training: {100.0 * acting:.1f} %.")
    return "\n".join(f"- {line}" for line in lines) + "\n"


class Failures(Study):
    """Where stored policies fail, and why."""

    name = "failures"
    options = {  # noqa: RUF012
        "--preset": {"default": "paper", "help": "whose stored policies"},
        "--track": {"help": "their track (default: the preset's first)"},
        "--method": {"default": "rainbow", "choices": LEARNERS, "help": "the learner"},
    }

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.preset = load_preset(given.preset)
        self.store = Store.open(self.results, self.preset.name)
        self.folder = self.store.folder / "failures"
        self.track = given.track or next(iter(self.preset.tracks))
        if self.track not in self.preset.tracks:
            raise BenchmarkError(
                f"unknown track '{self.track}'; known: {known(self.preset.tracks)}"
            )
        if self.preset.tracks[self.track].team:
            raise BenchmarkError(
                f"track '{self.track}': the robots move at once; failures are of those that take "
                "turns"
            )
        wanted = Cell(given.method, "full", "optimized", self.track, 0)
        alike = (cell for cell in expand(self.preset) if replace(cell, seed=0) == wanted)
        self.cells = sorted(cell for cell in alike if self.store.run(cell.id).has_policy())
        if not self.cells:
            raise BenchmarkError(
                f"{self.store.folder} has no stored policy of {given.method}, track {self.track}; "
                f"run: python -m benchmarks run --preset {self.preset.name}"
            )
        for cell in self.cells:
            self.store.run(cell.id).check_config(settings(self.preset, cell))
        self.rows: list[dict[str, object]] = []

    def parts(self) -> dict[str, Part]:
        return {cell.id: partial(self._play, cell) for cell in self.cells}

    def _play(self, cell: Cell, tick: Tick) -> None:
        run = self.store.run(cell.id)
        model = load_stored(run.policy)
        # the share that it solved in the last tenth of its training, with its exploration
        acting = tail_mean(run.curve("success"), "success")
        real = self.preset.tracks[cell.track].sim_to_real is not None
        oracle = LatticeOracle(self.preset.planner.node_limit, real)
        played = play(self.preset, cell, model, oracle, tick)
        self.rows += [{**row, "acting": acting} for row in played]

    def finish(self) -> None:
        write_csv(self.folder / f"{self.given.method}-{self.track}.csv", self.rows)

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        paths = sorted(results.glob("*/failures/*.csv"))
        return {path.with_suffix(".md"): summary(read_stored(path)) for path in paths}
