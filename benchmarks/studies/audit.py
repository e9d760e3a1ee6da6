"""What each reward pays for: the return of exploiting it beside the return of doing the task.

Scripted policies play the same validation starts under each reward, on the first track of the
preset that has it; results go to ``results/audit/``. *Insert* follows the exact
optimum hole after hole, *insert one* stops at the first. *Farm* looks on the optimum's way to the
first hole, and two moves off it, for the place where a move and its reversal pay most, goes there
and repeats the two until the time is up; *oscillate* does so where the episode starts. *Random*
takes any unmasked move. Beside them stand the trained policies of a preset.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.scripts import SCRIPTS, Moves, Simulator, moves_of
from benchmarks.protocol import labels
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.results import Results, in_order, tail_mean
from benchmarks.reporting.stats import over_seeds
from benchmarks.reporting.tables.table import plain
from benchmarks.reporting.verify import check_file
from benchmarks.runs.machine import describe
from benchmarks.runs.store import Store, csv_text, write_csv, write_text
from benchmarks.studies.base import Part, Study, Tick, count, read_stored
from coop_env.env import CoopInsertionEnv

CELL: Final = ("track", "method", "ablation", "geometry", "seed")
Row = dict[str, Any]


def of_each_reward(preset: Preset) -> Preset:
    """The preset with one track for each reward: the first that has it."""
    result: dict[str, str] = {}
    for name, track in preset.tracks.items():
        result.setdefault(f"{track.reward} {sorted(track.reward_kwargs.items())}", name)
    return replace(preset, tracks={name: preset.tracks[name] for name in result.values()})


def scripted(preset: Preset, starts: int, tick: Tick = lambda share: None) -> list[Row]:
    """One row per track, script and validation start: return, discounted return, holes, moves."""
    oracle = LatticeOracle()
    rows: list[Row] = []
    for name, track in preset.tracks.items():
        if track.team or track.shield is not None:
            raise BenchmarkError(f"track '{name}': scripts play the plain task, no team or shield")
        cell = Cell("rainbow", "full", "optimized", name, 0)
        env = CoopInsertionEnv(**env_arguments(preset, cell, track))
        simulator = Simulator(env)
        for number, seed in enumerate(episode_seeds(0, starts, "validate")):
            env.reset(seed=seed)
            result = oracle.plan_episode(env)
            plans = [[int(m) for m in plan.moves] for plan in result if plan.moves is not None]
            for script in SCRIPTS:
                moves = moves_of(script, env, simulator, plans, seed)
                row = {"track": name, "script": script, "start": number}
                rows.append(row | _returns(env, simulator, moves, track.hyperparameters.gamma))
            tick(len(rows) / (len(SCRIPTS) * starts * len(preset.tracks)))
    return rows


def _returns(env: CoopInsertionEnv, simulator: Simulator, moves: Moves, gamma: float) -> Row:
    if not moves:  # no hole can be reached from here
        return {"return": 0.0, "discounted": 0.0, "holes": 0, "moves": 0}
    outcomes = simulator.play(np.array([env.state]), moves)
    rewards = outcomes["reward"]
    return {
        "return": float(rewards.sum()),
        "discounted": float(rewards @ gamma ** np.arange(len(rewards))),
        "holes": int(outcomes["inserted"].sum()),
        "moves": len(rewards),
    }


def learned(results: Path, preset: str) -> str | None:
    """The text of learned.csv for a preset's runs, empty if none; None where there is no store.

    One row per stored learner: mean return and holes of the last tenth of its training.
    """
    if not (results / preset / "store.json").is_file():
        return None
    rows = []
    for run in Results(Store.open(results, preset)).all():
        if run.folder.has_rows("curve"):
            cell = {key: run.config["cell"][key] for key in CELL}
            earned = tail_mean(run.curve, "episode_reward")
            rows.append({**cell, "return": earned, "holes": tail_mean(run.curve, "holes")})
    return csv_text(rows) if rows else ""


def markdown(rows: pd.DataFrame, learners: pd.DataFrame | None = None) -> str:
    """Returns and holes as a Markdown table, a line for each track and script or learner."""
    lines = []
    for name in in_order(rows["track"].astype(str).unique()):
        here = rows[rows["track"] == name].groupby("script", sort=False)
        parts = {script: here.get_group(script) for script in SCRIPTS}
        if learners is not None:
            mine = learners.query("ablation == 'full' and geometry == 'optimized'")
            for method, part in mine[mine["track"] == name].groupby("method", sort=False):
                parts[f"{labels.METHODS[str(method)]}, trained"] = part
        for who, part in parts.items():
            mean, insert = part.mean(numeric_only=True), parts["insert"]["return"].mean()
            discounted = f"{mean['discounted']:.1f}" if "discounted" in mean else "-"
            numbers = [over_seeds(part["return"]).text(1), discounted, f"{mean['holes']:.2f}"]
            lines.append([labels.track(name), who, *numbers, f"{mean['return'] / insert:.2f}"])
    head = "Reward | Script | Return | Discounted | Holes | Return / inserting"
    return plain("What each reward pays", head, lines) + "\n"


class Audit(Study):
    """What each reward pays for."""

    name = "audit"
    options = {  # noqa: RUF012
        "--preset": {"default": "cut", "help": "whose tracks and stored learners"},
        "--starts": count(100, "validation starts per script"),
    }

    def parts(self) -> dict[str, Part]:
        return {"scripted policies": self._scripted}

    def _scripted(self, tick: Tick) -> None:
        preset = of_each_reward(load_preset(self.given.preset))
        write_csv(self.folder / "scripted.csv", scripted(preset, self.given.starts, tick))
        path = self.folder / "learned.csv"
        path.unlink(missing_ok=True)
        if text := learned(self.results, preset.name):
            write_text(path, text)
        record = {**describe(), "starts": self.given.starts, "preset": preset.name}
        write_text(self.folder / "meta.json", json.dumps(record, indent=1, sort_keys=True) + "\n")

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        path = results / "audit" / "scripted.csv"
        if not path.is_file():
            return {}
        learners = path.with_name("learned.csv")
        stored = read_stored(learners) if learners.is_file() else None
        return {path.with_suffix(".md"): markdown(read_stored(path), stored)}

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        folder, result = results / "audit", super().problems(results)
        if (meta := folder / "meta.json").is_file():
            preset = read_stored(meta)["preset"]
            if (text := learned(results, preset)) is not None:
                source = f"the runs in {results / preset}"
                result += check_file(folder / "learned.csv", text, source)
        return result
