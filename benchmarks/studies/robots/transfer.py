"""Policies and planners of the kinematic task in the simulated machine: the sim-to-sim table.

    python -m benchmarks transfer

The exact optimum, RRT-Connect, and under the same masks with the same memory the two-move lookahead
and Rainbow's stored policies play the same test starts in the kinematic task, in the twin without
errors of the machine, in the twin with them, and there with a script or a learner that inserts
where they have arrived. Plans are made on the nominal model, run open loop, and made anew for each
hole; a player stops where a plan does not bring it to its hole.
The scripts have the gains that ``python -m benchmarks contact`` chose; what has learned to insert
is of preset ``contact``, a policy for each seed. Written to ``results/transfer/`` and to
``docs/physics.md``; a cell that this commit measured is not measured again.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from shlex import quote
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from rich.console import Console
from rich.progress import Progress

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.methods.controls import Choose, control
from benchmarks.methods.episodes import Episode, env_arguments
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.verify import Report
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from benchmarks.studies.robots.pages import check_tables, kept, publish
from benchmarks.studies.robots.trials import LEVEL, inserter
from benchmarks.studies.speed.report import table
from coop_env.env import CoopInsertionEnv

BLOCK: Final = "transfer"
PAGE: Final = "physics.md"
PRESET: Final = "cut"
SEEDS: Final = 5
EPISODES: Final = 10  # of each seed
PLAYERS: Final = {
    "exact optimum": ("optimum", ""),
    "RRT-Connect": ("rrt", ""),
    "lookahead, safe": ("lookahead", "safe"),
    "lookahead, uncertain": ("lookahead", "uncertain"),
    "Rainbow, safe": ("rainbow", "safe"),
    "Rainbow, uncertain": ("rainbow", "uncertain"),
}
"""Who plays, and under which track's masks and memory; a planner has neither."""
FINISHES: Final = {
    "+ push": "compliant push",
    "+ spiral": "spiral search",
    "+ moment": "moment-guided search",
    "+ SAC": "SAC",
}
"""What inserts."""
WORLDS: Final = ("kinematics", "twin, no error", "twin", *FINISHES)
NO_ERROR: Final = {"position_error": 0.0, "tilt_error": 0.0}
Row = dict[str, list[Any]]
Play = Callable[[Episode], str]


def make_world(
    world: str, results: Path, arguments: Mapping[str, Any], seed: int = 0
) -> CoopInsertionEnv:
    """The environment of a world, for a player that has such arguments, in a seed's episodes."""
    if world == "kinematics":
        return CoopInsertionEnv(**arguments)
    from coop_env.physics.whole.moves import CoopInsertionPhysicsDiscreteEnv

    level: Any = NO_ERROR if world == "twin, no error" else LEVEL
    finish = inserter(results, FINISHES[world], seed) if world in FINISHES else None
    return CoopInsertionPhysicsDiscreteEnv(level=level, finish=finish, **arguments)


def by_plans(plan: Callable[[Any], Any]) -> Play:
    """Hole after hole by plans run open loop; says why it stopped before the last."""

    def play(episode: Episode) -> str:
        while not episode.over:
            target, answer = int(episode.env.state["target"]), plan(episode.env)
            if answer.moves is None:
                return "no plan"
            for move in answer.moves[: episode.moves_left]:
                if episode.move(int(move))["target"] != target or episode.over:
                    break
            else:
                return "not reached"
        return ""

    return play


def by_policy(path: Path) -> Play:
    """Moves of a stored policy to the end of the episode."""
    from benchmarks.evaluation.evaluate import model_policy
    from benchmarks.evaluation.model_files import load_model

    act = model_policy(load_model(path))

    def play(episode: Episode) -> str:
        while not episode.over:
            masks = episode.env.action_masks()
            episode.move(int(act(episode.observation[None], masks[None])[0]))
        return ""

    return play


def by_control(begin: Callable[[Sequence[Episode]], Choose]) -> Play:
    """Moves of a script that sees what a policy sees, to the end of the episode."""

    def play(episode: Episode) -> str:
        choose = begin([episode])
        while not episode.over:
            masks = episode.env.action_masks()
            episode.move(int(choose(episode.observation[None], masks[None], [0])[0]))
        return ""

    return play


def player(name: str, preset: Preset, results: Path, seed: int) -> tuple[Play, dict[str, Any]]:
    """Who plays the episodes of a seed, and the arguments of its environment.

    Raises:
        BenchmarkError: a policy is not among the results.
    """
    limits, (method, track) = preset.planner, PLAYERS[name]
    if not track:
        from benchmarks.methods.oracle import LatticeOracle
        from benchmarks.methods.rrt_connect import RRTConnect

        arguments: dict[str, Any] = {"reward": "progress"}
        if method == "optimum":
            return by_plans(LatticeOracle(limits.node_limit).plan), arguments
        number = 1 + derive("planner", seed) % 2**30
        rrt = RRTConnect(limits.time_limit, limits.max_iterations, number)
        return by_plans(rrt.plan), arguments
    cell = Cell(method, "full", "optimized", track, seed)
    arguments = env_arguments(preset, cell, preset.tracks[track])
    del arguments["sim_to_real"]  # the machine of this study's worlds, not the track's
    if method != "rainbow":
        return by_control(control(method, preset.tracks[track].controls, seed)), arguments
    return by_policy(results / PRESET / "runs" / cell.id / "policy.zip"), arguments


def measure(name: str, world: str, results: Path, episodes: int = EPISODES) -> Row:
    """A player's test episodes in a world, so many of each seed, a column for each quantity."""
    preset = load_preset(PRESET)
    keys = ("success", "first", "holes", "failure", "moves", "time_first", "force")
    found: Row = {key: [] for key in keys}
    for seed in range(SEEDS):
        play, arguments = player(name, preset, results, seed)
        env = make_world(world, results, arguments, seed)
        for number, start in enumerate(episode_seeds(seed, episodes)):
            row = play_one(env, play, number, start)
            for key in keys:
                found[key].append(row[key])
        env.close()
    return found


def play_one(env: CoopInsertionEnv, play: Play, number: int, start: int) -> dict[str, Any]:
    """One episode; a failure is why its first hole was not filled."""
    episode = Watched(env, number, start)
    first, why = int(env.state["target"]), play(episode)
    filled = first in episode.filled
    info = episode.last
    if not filled:
        ended = "singular" if info["singular"] else "time" if episode.over else ""
        gave_up = "not inserted" if first in info.get("given_up", []) else ""
        why = gave_up or info.get("failure", "") or why or ended
    return {
        "success": bool(episode.filled), "first": filled, "holes": len(episode.filled),
        "failure": "" if filled else why, "moves": episode.moves,
        "time_first": round(episode.time_first, 3) if filled else None,
        "force": round(float(info.get("peak_force", 0.0)), 3),
    }  # fmt: skip


class Watched(Episode):
    """An episode that keeps which holes were filled, when the first was, and the last ``info``."""

    def __init__(self, env: CoopInsertionEnv, number: int, reset_seed: int) -> None:
        super().__init__(env, number, reset_seed)
        self.filled: list[int] = []
        self.time_first = math.nan
        self.last = self._info

    def move(self, action: int) -> dict[str, Any]:
        """Make one move and account for it; returns the environment's info."""
        info = self.last = super().move(action)
        if info["inserted"]:
            self.filled.append(int(info["inserted_hole"]))
            if len(self.filled) == 1:
                self.time_first = float(info["time"])
        return info


def _tables(cells: Mapping[str, Mapping[str, Row]]) -> Iterator[str]:
    names = [name for name in PLAYERS if name in cells]
    worlds = [world for world in WORLDS if any(world in cells[name] for name in names)]
    shown: dict[str, Callable[[Row], str]] = {
        "Success (%) / first hole filled (%) / holes filled": _shares,
        "Why the first hole was not filled, episodes": _causes,
        "Median time of the first hole (s) / median peak force (N)": _medians,
    }
    for title, cell in shown.items():
        rows = [
            [name, *(cell(cells[name][w]) if w in cells[name] else "-" for w in worlds)]
            for name in names
        ]
        yield table(title, " | ".join(["player", *worlds]), rows)


def _shares(row: Row) -> str:
    success, first = (100.0 * np.mean(row[key]) for key in ("success", "first"))
    return f"{success:.0f} / {first:.0f} / {np.mean(row['holes']):.2f}"


def _causes(row: Row) -> str:
    counted = Counter(cause for cause in row["failure"] if cause)
    return ", ".join(f"{cause} {n}" for cause, n in sorted(counted.items())) or "-"


def _medians(row: Row) -> str:
    times = [time for time in row["time_first"] if time is not None]
    time = f"{np.median(times):.1f}" if times else "-"
    return f"{time} / {np.median(row['force']):.1f}"


def tell(found: Mapping[str, Any]) -> str:
    """The measurements as Markdown."""
    machine, n = found["machine"], SEEDS * found["asked"]["episodes"]
    low, high = (100.0 * share for share in wilson(n, n))
    return "\n\n".join(
        [
            *_tables(found["cells"]),
            f"{n} episodes a cell, on the same test starts for all (all of them successful: "
            f"{low:.0f} to {high:.0f} %, 95 % interval); success: at least one hole. Without a "
            "script (+) a hole counts as in the kinematic task, within its tolerance; with one "
            "when the peg is 10 mm deep in the bore. "
            f"Command: `{found['command']}`. {machine['machine']['processor']}, commit "
            f"{machine['commit'][:9]}.",
        ]
    )


def main(words: Sequence[str]) -> int:
    """Measure, print, write ``transfer/`` below the results folder and the block of the docs."""
    line = argparse.ArgumentParser(
        prog="python -m benchmarks transfer",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = line.add_argument
    add("--results", type=Path, default=Path("results"))
    add("--docs", type=Path, default=Path("docs"), help=f"folder of {PAGE}")
    add("--episodes", type=at_least(1), default=EPISODES, help=f"of each of {SEEDS} seeds")
    add("--jobs", type=at_least(1), default=1, help="processes")
    add("--players", nargs="+", choices=[*PLAYERS], default=[*PLAYERS])
    add("--worlds", nargs="+", choices=WORLDS, default=[*WORLDS])
    given = line.parse_args(list(words))
    try:
        import coop_env.physics.engine  # noqa: F401
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    console, path = Console(soft_wrap=True), given.results / "transfer" / "transfer.json"
    asked = {"episodes": given.episodes, "commit": describe()["commit"]}
    found = kept(path, asked, {"cells": {}})
    found |= {
        "command": " ".join(["python -m benchmarks transfer", *map(quote, words)]),
        "machine": describe(),
    }
    todo = [
        (name, world)
        for name in given.players
        for world in given.worlds
        if world not in found["cells"].get(name, {})
    ]
    with Progress(console=console, refresh_per_second=2) as progress:
        task = progress.add_task("cells", total=len(todo))
        for (name, world), row in _measured(todo, given.results, given.episodes, given.jobs):
            found["cells"].setdefault(name, {})[world] = row
            write_text(path, json.dumps(found) + "\n")
            progress.advance(task)
    publish(path, tell(found), given.docs / PAGE, BLOCK, console)
    return 0


def _measured(
    todo: Sequence[tuple[str, str]], results: Path, episodes: int, jobs: int
) -> Iterator[tuple[tuple[str, str], Row]]:
    """Cells as they are done, each in a process of its own: OMPL takes one seed per process."""
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1) as pool:
        running = {pool.submit(measure, *cell, results, episodes): cell for cell in todo}
        for done in as_completed(running):
            yield running[done], done.result()


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the tables, here and in the docs, follow from the stored episodes."""
    check_tables(report, results / "transfer/transfer.json", tell, docs / PAGE, BLOCK)
