"""What each reward pays for: the return of farming it against the return of doing the task.

Scripted policies play the same validation starts under each reward, on the first track of the
preset that has it. *Insert* follows the exact optimum hole after hole, *insert one* stops at the
first. *Farm* looks on the optimum's way to the first hole, and two moves off it, for the place
where a move and its reversal pay most, goes there and repeats the two until the time is up;
*oscillate* does so where the episode starts. *Random* takes any unmasked move.
Beside them stands what the trained policies of a preset came to. Written to ``results/audit/``:
``scripted.csv``, ``scripted.md``, ``learned.csv``, ``audit.png``, ``meta.json``.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.errors import BenchmarkError
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.scripts import SCRIPTS, Moves, Simulator, moves_of
from benchmarks.protocol import labels
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.figures.style import canvas, save, style
from benchmarks.reporting.results import Results, in_order, tail_mean
from benchmarks.reporting.stats import over_seeds
from benchmarks.reporting.tables.table import plain
from benchmarks.runs.machine import describe
from benchmarks.runs.store import Store, write_csv, write_text
from benchmarks.studies.base import Part, Study, Tick, count
from coop_env.env import CoopInsertionEnv

CELL: Final = ("track", "method", "ablation", "geometry", "seed")
LEARNED: Final = (*CELL, "return", "holes")
MARKS: Final = {"rainbow": "o", "dqn": "s", "maskable_ppo": "^"}


def of_each_reward(preset: Preset) -> Preset:
    """The preset with the first of its tracks that has a reward for each reward there is."""
    result: dict[str, str] = {}
    for name, track in preset.tracks.items():
        result.setdefault(f"{track.reward} {sorted(track.reward_kwargs.items())}", name)
    return replace(preset, tracks={name: preset.tracks[name] for name in result.values()})


def scripted(preset: Preset, starts: int, tick: Tick = lambda share: None) -> pd.DataFrame:
    """One row per track, script and validation start: return, discounted return, holes, moves."""
    oracle = LatticeOracle()
    rows = []
    for name, track in preset.tracks.items():
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
    return pd.DataFrame(rows)


def _returns(
    env: CoopInsertionEnv, simulator: Simulator, moves: Moves, gamma: float
) -> dict[str, float]:
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


def learned(store: Store) -> pd.DataFrame:
    """One row per stored learner: mean return and holes of its last training episodes.

    The last tenth of the run: with exploration on, as the learner saw it.
    """
    rows = []
    for run in Results(store).all():
        if run.folder.has_rows("curve"):
            cell, curve = run.config["cell"], run.folder.rows("curve")
            earned, holes = tail_mean(curve, "episode_reward"), tail_mean(curve, "holes")
            rows.append([*(cell[key] for key in CELL), earned, holes])
    return pd.DataFrame(rows, columns=LEARNED)


def ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean return of each script over that of inserting, by track; above 1 the reward is farmed."""
    means = rows.groupby(["track", "script"])["return"].mean().unstack()
    tracks = in_order(str(name) for name in means.index)
    return means.div(means["insert"], axis=0).loc[tracks, list(SCRIPTS)]


def draw(rows: pd.DataFrame, learners: pd.DataFrame) -> Figure:
    """Left: scripts' returns over that of inserting. Right: what the learners came to."""
    figure, (left, right) = canvas(1, 2, (9.0, 3.6), grid=False)
    shares = ratios(rows)
    tracks = shares.index.tolist()
    for k, script in enumerate(SCRIPTS):
        left.bar(np.arange(len(tracks)) + (k - 2) * 0.16, shares[script], width=0.16, label=script)
    for level, line in ((0.0, "-"), (1.0, ":")):
        left.axhline(level, color="black", linewidth=0.8, linestyle=line)
    left.set_xticks(np.arange(len(tracks)), [labels.track(name) for name in tracks])
    left.set_ylabel("return / return of inserting")
    left.legend()
    insert = rows[rows["script"] == "insert"].groupby("track")["return"].mean()
    learners = learners.query("ablation == 'full' and geometry == 'optimized'")
    for k, name in enumerate(tracks):
        for method, mark in MARKS.items():
            result = learners.query("track == @name and method == @method")
            if len(result):
                share, label = result["return"] / insert[name], labels.METHODS[method]
                label += f", {labels.track(name)}"
                right.plot(share, result["holes"], mark, color=f"C{k}", label=label, markersize=5)
    right.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
    right.set_xlabel("return of the last training episodes / return of inserting")
    right.set_ylabel("holes per episode")
    right.set_ylim(-0.2, 6.2)
    if right.get_legend_handles_labels()[0]:
        right.legend()
    else:
        right.text(0.5, 0.5, "no learner stored", ha="center", transform=right.transAxes)
    return figure


def markdown(rows: pd.DataFrame) -> str:
    """The scripts' returns and holes as a Markdown table, one line per track and script."""
    lines = []
    for name, shares in ratios(rows).iterrows():
        for script, share in shares.items():
            result = rows[(rows["track"] == name) & (rows["script"] == script)]
            mean, earned = result[["discounted", "holes"]].mean(), over_seeds(result["return"])
            numbers = [earned.text(1), f"{mean['discounted']:.1f}", f"{mean['holes']:.2f}"]
            lines.append([labels.track(str(name)), str(script), *numbers, f"{share:.2f}"])
    head = "Reward | Script | Return | Discounted | Holes | Return / inserting"
    return plain("What each reward pays the scripts", head, lines) + "\n"


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
        rows = scripted(preset, self.given.starts, tick)
        write_csv(self.folder / "scripted.csv", _records(rows))
        try:
            learners = learned(Store.open(self.results, preset.name))
        except BenchmarkError:
            learners = pd.DataFrame(columns=LEARNED)
        write_csv(self.folder / "learned.csv", _records(learners))
        record = {**describe(), "starts": self.given.starts, "preset": preset.name}
        write_text(self.folder / "meta.json", json.dumps(record, indent=1, sort_keys=True) + "\n")

    def finish(self) -> None:
        rows, learners = (pd.read_csv(self.folder / f"{n}.csv") for n in ("scripted", "learned"))
        with style():
            save(draw(rows, learners), self.folder / "audit.png")

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        path = results / "audit" / "scripted.csv"
        return {path.with_suffix(".md"): markdown(pd.read_csv(path))} if path.is_file() else {}


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(k): v for k, v in row.items()} for row in frame.to_dict("records")]
