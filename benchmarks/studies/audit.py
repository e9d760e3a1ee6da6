"""What each reward pays for: the return of farming it against the return of doing the task.

    python -m benchmarks audit

Scripted policies play the same validation starts under each reward, on the first track of the
preset that has it. *Insert* follows the exact optimum hole after hole, *insert one* stops at the
first. *Farm* looks on the optimum's way to the first hole, and two moves off it, for the place
where a move and its reversal pay most, goes there and repeats the two until the time is up;
*oscillate* does so where the episode starts. *Random* takes any unmasked move.
Beside them stands what the trained policies of a preset came to. Written to ``results/audit/``:
``scripted.csv``, ``scripted.md``, ``learned.csv``, ``audit.png``, ``meta.json``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress

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
from benchmarks.reporting.verify import Report, check_file
from benchmarks.runs import machine
from benchmarks.runs.store import Store, write_csv, write_text
from coop_env.env import CoopInsertionEnv

CELL: Final = ("track", "method", "ablation", "geometry", "seed")
LEARNED: Final = (*CELL, "return", "holes")
MARKS: Final = {"rainbow": "o", "dqn": "s", "maskable_ppo": "^"}


def of_each_reward(preset: Preset) -> Preset:
    """The preset with the first of its tracks that has a reward for each reward there is."""
    found: dict[str, str] = {}
    for name, track in preset.tracks.items():
        found.setdefault(f"{track.reward} {sorted(track.reward_kwargs.items())}", name)
    return replace(preset, tracks={name: preset.tracks[name] for name in found.values()})


def scripted(preset: Preset, starts: int, tell: Callable[[], None] = lambda: None) -> pd.DataFrame:
    """One row per track, script and validation start: return, discounted return, holes, moves.

    ``tell`` is called after each start of a track.
    """
    oracle = LatticeOracle()
    rows = []
    for name, track in preset.tracks.items():
        cell = Cell("rainbow", "full", "optimized", name, 0)
        env = CoopInsertionEnv(**env_arguments(preset, cell, track))
        simulator = Simulator(env)
        for number, seed in enumerate(episode_seeds(0, starts, "validate")):
            env.reset(seed=seed)
            found = oracle.plan_episode(env)
            plans = [[int(m) for m in plan.moves] for plan in found if plan.moves is not None]
            for script in SCRIPTS:
                moves = moves_of(script, env, simulator, plans, seed)
                row = {"track": name, "script": script, "start": number}
                rows.append(row | _returns(env, simulator, moves, track.hyperparameters.gamma))
            tell()
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
    left.axhline(0.0, color="black", linewidth=0.8)
    left.axhline(1.0, color="black", linewidth=0.8, linestyle=":")
    left.set_xticks(np.arange(len(tracks)), [labels.track(name) for name in tracks])
    left.set_ylabel("return / return of inserting")
    left.legend()
    insert = rows[rows["script"] == "insert"].groupby("track")["return"].mean()
    learners = learners.query("ablation == 'full' and geometry == 'optimized'")
    for k, name in enumerate(tracks):
        for method, mark in MARKS.items():
            found = learners.query("track == @name and method == @method")
            if len(found):
                share, label = found["return"] / insert[name], labels.METHODS[method]
                label += f", {labels.track(name)}"
                right.plot(share, found["holes"], mark, color=f"C{k}", label=label, markersize=5)
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
    lines = [
        "| Reward | Script | Return | Discounted | Holes | Return / inserting |",
        "|---|---|---|---|---|---|",
    ]
    for name, shares in ratios(rows).iterrows():
        for script, share in shares.items():
            found = rows[(rows["track"] == name) & (rows["script"] == script)]
            lines.append(
                f"| {labels.track(str(name))} | {script} "
                f"| {found['return'].mean():.1f} ± {found['return'].std():.1f} "
                f"| {found['discounted'].mean():.1f} | {found['holes'].mean():.2f} "
                f"| {share:.2f} |"
            )
    return "\n".join(lines) + "\n"


def main(words: Sequence[str]) -> int:
    """Play the scripts, read the learners, write the table and the figure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks audit", description=__doc__)
    parser.add_argument("--preset", default="cut", help="whose tracks and stored learners")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--starts", type=int, default=100, help="validation starts for each script")
    arguments = parser.parse_args(list(words))
    if arguments.starts < 1:
        raise BenchmarkError(f"--starts {arguments.starts}: must be 1 or above")
    preset = of_each_reward(load_preset(arguments.preset))
    console = Console(soft_wrap=True)
    with Progress(console=console) as bar:
        job = bar.add_task("scripted policies", total=len(preset.tracks) * arguments.starts)
        rows = scripted(preset, arguments.starts, lambda: bar.advance(job))
    try:
        learners = learned(Store.open(arguments.results, preset.name))
    except BenchmarkError:
        learners = pd.DataFrame(columns=LEARNED)
    folder = arguments.results / "audit"
    write_csv(folder / "scripted.csv", _records(rows))
    write_csv(folder / "learned.csv", _records(learners))
    rows = pd.read_csv(folder / "scripted.csv")  # what is told follows from what is stored
    write_text(folder / "scripted.md", markdown(rows))
    with style():
        save(draw(rows, learners), folder / "audit.png")
    record = {**machine.describe(), "starts": arguments.starts, "preset": preset.name}
    write_text(folder / "meta.json", json.dumps(record, indent=1, sort_keys=True) + "\n")
    console.print(markdown(rows), markup=False, highlight=False)
    console.print(f"Audit: {folder}")
    return 0


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    return [{str(k): v for k, v in row.items()} for row in frame.to_dict("records")]


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the table of the scripted policies follows from their episodes."""
    path = results / "audit" / "scripted.csv"
    if path.is_file():
        wanted = markdown(pd.read_csv(path))
        found = check_file(path.with_suffix(".md"), wanted, f"the rows of {path.name}")
        report.add(f"{path.parent}: table", found)
