"""Policies and planners of the kinematic task in the simulated machine: the sim-to-sim table.

The exact optimum, RRT-Connect, the two-move lookahead and Rainbow's stored policies play the same
test starts in four worlds: the kinematic task, the twin without errors of the machine, the twin
with them, and there with a script or a learner that inserts where they arrive. Plans are made on
the nominal model, one for each hole, and run open loop; a player stops where a plan misses its
hole. The scripts have the gains that the study ``contact`` chose, the learners are preset
``contact``'s, a policy for each seed. Where the policies of ``contact_errors`` are stored too,
scripts and learners insert on machines within the trained errors and beyond them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.evaluation.evaluate import model_policy, play_together
from benchmarks.evaluation.model_files import load_model
from benchmarks.methods.base import Chooser
from benchmarks.methods.controls import control
from benchmarks.methods.episodes import Episode, env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, Tick, count, source
from benchmarks.studies.robots.trials import LEARNED, LEVEL, WHAT, in_cell, inserter, policy_of_run
from benchmarks.studies.robots.trials import play as play_contact
from coop_env.env import CoopInsertionEnv
from coop_env.simulation.sim_to_real import FORGE, SimToReal

PRESET: Final = "cut"
SEEDS: Final = 5
PLAYERS: Final = {
    "exact optimum": ("optimum", ""),
    "RRT-Connect": ("rrt", ""),
    "lookahead, safe": ("lookahead", "safe"),
    "lookahead, uncertain": ("lookahead", "uncertain"),
    "Rainbow, safe": ("rainbow", "safe"),
    "Rainbow, uncertain": ("rainbow", "uncertain"),
}
"""The players: a method, and the track whose masks and memory it has; planners have none."""
FINISHES: Final = {
    "+ push": "compliant push",
    "+ spiral": "spiral search",
    "+ moment": "moment-guided search",
    "+ SAC": "SAC",
}
"""The inserters: a column for each."""
WORLDS: Final = ("kinematics", "twin, no error", "twin", *FINISHES)
INSERTERS: Final = ("compliant push", "moment-guided search", *LEARNED)
"""The inserters that are tested on :func:`machines`."""
NO_ERROR: Final = {"position_error": 0.0, "tilt_error": 0.0}
Row = dict[str, list[Any]]
Play = Callable[[Episode], None]


def make_world(
    world: str, results: Path, arguments: Mapping[str, Any], seed: int = 0
) -> CoopInsertionEnv:
    """The environment of a world for a player's arguments; ``seed``: the inserter's."""
    if world == "kinematics":
        return CoopInsertionEnv(**arguments)
    from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv

    level: Any = NO_ERROR if world == "twin, no error" else LEVEL
    finish = inserter(results, FINISHES[world], seed) if world in FINISHES else None
    return CoopInsertionPhysicsDiscreteEnv(level=level, finish=finish, **arguments)


def by_acting(begin: Callable[[Sequence[Episode]], Chooser]) -> Play:
    """Plays a script or policy to the end of the episode."""
    return lambda episode: play_together(begin([episode]), [episode], 0.0, 0)


def player(name: str, preset: Preset, results: Path, seed: int) -> tuple[Play, dict[str, Any]]:
    """A player for the episodes of a seed, and the arguments of its environment."""
    limits, (method, track) = preset.planner, PLAYERS[name]
    if not track:
        from benchmarks.methods.rrt_connect import RRTConnect, execute  # needs OMPL

        planner: Any = LatticeOracle(limits.node_limit)
        if method == "rrt":
            planner = RRTConnect(limits, 1 + derive("planner", seed) % 2**30)
        return lambda episode: execute(episode, planner.plan), {"reward": "progress"}
    cell = Cell(method, "full", "optimized", track, seed)
    arguments = env_arguments(preset, cell, preset.tracks[track])
    del arguments["sim_to_real"]  # the machine of this study's worlds, not the track's
    if method == "rainbow":
        policy = model_policy(load_model(results / PRESET / "runs" / cell.id / "policy.zip"))
        return by_acting(lambda _: lambda seen, masks, _: policy(seen, masks)), arguments
    return by_acting(control(method, preset.tracks[track].controls, seed)), arguments


def measure(name: str, world: str, results: Path, episodes: int) -> Row:
    """A player's test episodes in a world, ``episodes`` of each seed, by column."""
    preset, rows = load_preset(PRESET), []
    for seed in range(SEEDS):
        play, arguments = player(name, preset, results, seed)
        env = make_world(world, results, arguments, seed)
        starts = enumerate(episode_seeds(seed, episodes))
        rows += [play_one(env, play, number, start) for number, start in starts]
        env.close()
    return {key: [row[key] for row in rows] for key in rows[0]}


def play_one(env: CoopInsertionEnv, play: Play, number: int, start: int) -> dict[str, Any]:
    """One episode: whether it filled a hole, whether its first target, and how many in all."""
    episode = Episode(env, number, start)
    first = int(env.state["target"])
    play(episode)
    filled = env.state["filled"]
    return {"success": bool(filled.any()), "first": bool(filled[first]), "holes": int(filled.sum())}


def machines() -> dict[str, SimToReal]:
    """Machines of the contact task, by the size of their errors; training had up to ``FORGE``.

    At ``n`` times the bounds all errors are that large in every episode.
    """
    bounds = {name: getattr(FORGE, name) for name in FORGE.turned - {"latency"}}
    outside = {
        f"{n:g} times the bounds": SimToReal(
            **{name: n * bound for name, bound in bounds.items()}, latency=1
        )
        for n in (1.5, 2.0)
    }
    return {"nominal": SimToReal(), "within the bounds": FORGE, **outside}


def on_machines(name: str, results: Path, episodes: int, tick: Tick) -> Row:
    """Test episodes of an inserter, all its policies, on each of :func:`machines`."""
    from coop_env.physics.env import CoopInsertionContactEnv

    rows: Row = {}
    for machine, errors in machines().items():
        env = CoopInsertionContactEnv(LEVEL, sim_to_real=errors)
        scripts = [inserter(results, name, s) for s in range(SEEDS if name in LEARNED else 1)]
        played = [play_contact(env, script, "test", SEEDS * episodes) for script in scripts]
        rows[machine] = [{key: [v for each in played for v in each[key]] for key in played[0]}]
        env.close()
        tick(len(rows) / len(machines()))
    return rows


def _machines(parts: Mapping[str, Row]) -> Iterator[str]:
    """The table of the inserters on machines with errors, if it was measured."""
    rows = [
        [name, *(in_cell(part[machine][0]) for machine in machines())]
        for name in INSERTERS
        if (part := parts.get(f"machines: {name}"))
    ]
    if rows:
        title = f"One insertion on machines that err: {WHAT}"
        yield plain(title, " | ".join(["", *machines()]), rows)


def _cell(name: str, world: str, results: Path, episodes: int, tick: Tick) -> Row:
    """A cell, in a process of its own: OMPL takes one seed per process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure, name, world, results, episodes).result()


def _shares(row: Row) -> str:
    success, first = (100.0 * np.mean(row[key]) for key in ("success", "first"))
    return f"{success:.0f} / {first:.0f} / {np.mean(row['holes']):.2f}"


class Transfer(Measured):
    """Players of the kinematic task in the twin."""

    name, file, needs = "transfer", "transfer/transfer.json", ("mujoco", "ompl", "physics")
    options = {"--episodes": count(10, f"episodes of each of {SEEDS} seeds")}  # noqa: RUF012

    def measures(self) -> dict[str, Part]:
        place = (self.results, self.given.episodes)
        parts: dict[str, Part] = {
            f"{name}: {world}": partial(_cell, name, world, *place)
            for name, world in product(PLAYERS, WORLDS)
        }
        policies = (policy_of_run(self.results, *run) for run in product(LEARNED, range(SEEDS)))
        if all(path.is_file() for path in policies):  # git has not every one
            parts |= {f"machines: {name}": partial(on_machines, name, *place) for name in INSERTERS}
        return parts

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        parts, n = result["parts"], SEEDS * result["asked"]["episodes"]
        low, high = (100.0 * share for share in wilson(n, n))
        table = plain(
            "Success (%) / first hole filled (%) / holes filled",
            " | ".join(["player", *WORLDS]),
            [[name, *(_shares(parts[f"{name}: {w}"]) for w in WORLDS)] for name in PLAYERS],
        )
        note = (
            f"{n} episodes a cell (of learners in the second table, of each of {SEEDS} policies), "
            f"on the same test starts for all (all of {n} successful: {low:.0f} to {high:.0f} %, "
            "95 % interval); success: at least one hole. Without a "
            "script (+) a hole counts as in the kinematic task, within its tolerance; with one "
            f"when the peg is 10 mm deep in the bore. {source(result)}"
        )
        return "\n\n".join([table, *_machines(parts), note])
