"""Episodes as joint trajectories: to files for a controller, and on the twin's servos.

Without --export, the optimum, RRT-Connect and a stored Rainbow play the same test starts. Their
paths become trajectories, stop-and-go and blended, and the twin drives each to the first insertion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pandas as pd
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.errors import BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.team.env import make_env
from benchmarks.protocol.presets import load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.figures.style import save
from benchmarks.reporting.tables.table import plain
from benchmarks.runs.machine import describe
from benchmarks.studies.base import (
    Act,
    Measured,
    Part,
    Tick,
    by_plans,
    count,
    episode,
    source,
    stored_player,
)
from coop_env.env import CoopInsertionEnv
from coop_env.geometry import resolve_rrs
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.trajectory import Trajectory, make_trajectory

if TYPE_CHECKING:
    from coop_env.physics.driver import TwinDriver

MODEL: Final = Path("paper/runs/rainbow-optimized-repaired-s0/policy.zip")
FORCE_LIMIT: Final = 40.0  # N, as in the contact task

#: columns that are empty for starts without an insertion
KEYS: Final = ("seconds_first", "seconds", "blocked_first", "error", "torque", "force", "inserted")
OPTIMUM: Final = "optimum"
PLANNER: Final = "RRT-Connect"

Play = Callable[[CoopInsertionEnv], Act]  # who plays in an environment
Row = dict[str, Any]


class Way(NamedTuple):
    """Configurations (n, 6) of an episode, the hole aimed at first, moves made to fill it, or 0."""

    configurations: NDArray[np.float64]
    target: int
    first: int


def optimum(env: CoopInsertionEnv) -> Act:
    """The exact optimum in an environment."""
    return by_plans(env, LatticeOracle().plan)


def planner(env: CoopInsertionEnv) -> Act:
    """RRT-Connect in an environment."""
    from benchmarks.methods.rrt_connect import RRTConnect

    return by_plans(env, RRTConnect(load_preset("cut").planner).plan)


NOMINAL: Final[tuple[dict[str, Any], Play]] = ({"geometry": "optimized"}, optimum)


def stored(path: Path) -> tuple[dict[str, Any], Play]:
    """The environment's arguments of a stored policy, and the policy."""
    arguments, act = stored_player(path)
    return {**NOMINAL[0], **arguments}, lambda env: act


def played(arguments: dict[str, Any], play: Play, seed: int) -> Way:
    """The way of one episode, and what it filled; refused moves add nothing."""
    env = make_env(**arguments)
    act = play(env)
    steps = episode(env, lambda seen: act(seen, env.action_masks()), seed=seed)
    target, first, way = int(next(steps)["target"]), 0, [env.configuration]
    for info in steps:
        if not (info["violation"] or info["singular"]):
            way.append(env.configuration)
        first = first or (len(way) - 1 if info["inserted"] else 0)
    return Way(np.array(way), target, first)


def rows_of(method: str, way: Way, number: int, driver: TwinDriver) -> Iterator[Row]:
    """A row for each kind of trajectory, to the first insertion and for the whole episode."""
    geometry = driver.twin.machine.rrs
    for kind, blend in (("stop-and-go", False), ("blended", True)):
        row: Row = {"method": method, "kind": kind, "start": number}
        row |= {"moves_first": way.first, "moves": len(way.configurations) - 1}
        row |= dict.fromkeys(KEYS, math.nan)
        if way.first:
            first = make_trajectory(way.configurations[: way.first + 1], geometry, blend=blend)
            driver.place(way.configurations[0])
            driver.command(first)
            distance, angle = driver.miss(way.target)
            row |= {
                "seconds_first": first.duration,
                "seconds": make_trajectory(way.configurations, geometry, blend=blend).duration,
                "blocked_first": len(first.blocked()),
                "error": 1e3 * float(np.abs(driver.errors).max()),
                "torque": float(np.abs(driver.torques).max()),
                "force": float(np.linalg.norm(driver.force())),
                "inserted": distance < PAPER_TASK.tolerance and angle < PAPER_TASK.angle_tolerance,
            }
        yield row


def table(rows: pd.DataFrame) -> str:
    """The rows as a Markdown table."""
    lines = []
    for (method, kind), all_of in rows.groupby(["method", "kind"], sort=False):
        done = all_of[all_of["moves_first"] > 0]
        mean, error = done.mean(numeric_only=True), done["error"]
        free, inserted = (done["blocked_first"] == 0).sum(), done["inserted"].astype(bool)
        soft = inserted & (done["force"] <= FORCE_LIMIT)
        lines.append(
            [
                *(str(method), str(kind), f"{len(done)} of {len(all_of)}"),
                *_lengths(mean["moves_first"], mean["seconds_first"]),
                *(f"{free}", f"{error.median():.1f} / {error.max():.1f}"),
                *(f"{done['torque'].max():.1f}", f"{inserted.sum()}", f"{soft.sum()}"),
                " / ".join(_lengths(mean["moves"], mean["seconds"])[1:]),
            ]
        )
    return plain(
        "To the first insertion, and the whole episode",
        "method | trajectory | starts with an insertion | moves to it | s by moves | s | "
        "ways free | error, mrad: median / largest peak | peak torque, N m | "
        f"inserted on the twin | and at most {FORCE_LIMIT:.0f} N | episode: s by moves / s",
        lines,
    )


def _lengths(moves: float, seconds: float) -> list[str]:
    return [f"{moves:.1f}", f"{PAPER_TASK.dt * moves:.1f}", f"{seconds:.2f}"]


def export(folder: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV, as YAML of a JointTrajectory and as a picture."""
    console = Console(soft_wrap=True, markup=False)
    folder.mkdir(parents=True, exist_ok=True)
    trajectory.to_csv(folder / "trajectory.csv")
    trajectory.to_yaml(folder / "joint_trajectory.yaml")
    save(trajectory.plot(), folder / "trajectory.png")
    console.print(f"{trajectory.duration:.2f} s in {len(trajectory.stops) - 1} moves")
    for move, reason in trajectory.blocked():
        console.print(f"move {move} is not free: on its way there is {reason}")
    console.print(f"Written to {folder}")


def measure(method: str, model: Path, starts: int, tick: Tick) -> list[Row]:
    """The trajectories of ``starts`` test starts, driven by the twin."""
    from coop_env.physics.driver import TwinDriver
    from coop_env.physics.model import Machine

    players = {OPTIMUM: NOMINAL, PLANNER: (NOMINAL[0], planner)}
    arguments, play = players.get(method) or stored(model)
    driver = TwinDriver(Machine(rrs=resolve_rrs(arguments["geometry"])))
    rows: list[Row] = []
    for number, seed in enumerate(episode_seeds(0, starts, "test")):
        rows += rows_of(method, played(arguments, play, seed), number, driver)
        tick((number + 1) / starts)
    return rows


class TrajectoryStudy(Measured):
    """Joint trajectories of episodes, on the twin; or the files of one."""

    name, file = "trajectory", "trajectory/trajectory.json"
    needs = ("mujoco", "ruckig", "ompl", "trajectory")
    options = {  # noqa: RUF012
        "--export": {"type": Path, "metavar": "FOLDER", "help": "place of one episode's files"},
        "--model": {
            "type": Path,
            "help": f"policy of a run (default: {MODEL}; with --export the exact optimum)",
        },
        "--start": count(None, "number of the start to export (default: 0)", 0),
        "--blend": {"action": "store_true", "help": "blended moves in what is exported"},
        "--starts": count(100, "test starts of the tables"),
    }

    @classmethod
    def main(cls, argv: Sequence[str]) -> int:
        given = cls.parser().parse_args(list(argv))
        if given.export is None:
            if given.blend or given.start is not None:
                raise BenchmarkError("--start and --blend belong to --export, which is not given")
            return super().main(argv)
        given.start = given.start or 0
        arguments, play = NOMINAL if given.model is None else stored(given.model)
        way = played(arguments, play, episode_seeds(0, given.start + 1, "test")[-1])
        if len(way.configurations) < 2:
            raise BenchmarkError(f"start {given.start}: no move was made; choose another --start")
        try:
            trajectory = make_trajectory(
                way.configurations, arguments["geometry"], blend=given.blend
            )
        except DependencyNotInstalled as missing:
            raise BenchmarkError(str(missing)) from missing
        export(given.export, trajectory)
        return 0

    def asked(self) -> dict[str, Any]:
        model = self.given.results / MODEL if self.given.model is None else self.given.model
        kept = {"model": model.as_posix(), "starts": self.given.starts}
        return {**kept, "commit": describe()["commit"]}

    def measures(self) -> dict[str, Part]:
        place = (Path(self.asked()["model"]), self.given.starts)
        return {name: partial(measure, name, *place) for name in (OPTIMUM, PLANNER, "Rainbow")}

    def finish(self) -> None:
        arguments, play = NOMINAL
        for seed in episode_seeds(0, self.given.starts, "test"):
            if (way := played(arguments, play, seed)).first:
                trajectory = make_trajectory(way.configurations[: way.first + 1])
                save(trajectory.plot(), self.folder / "trajectory.png")
                return

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        rows = pd.DataFrame([row for part in result["parts"].values() for row in part])
        return f"{table(rows)}\n\n{source(result)}"
