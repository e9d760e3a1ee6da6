"""One test episode: it moves an environment and keeps what the metrics need. No torch here."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.protocol.plan import OPTIMUM_AT_ONCE, Cell
from benchmarks.protocol.presets import Preset, Track
from coop_env.env import CoopInsertionEnv, Observation
from coop_env.geometry import RRSGeometry
from coop_env.kinematics.rrs_kernels import platform_pose
from coop_env.trajectory import make_trajectory

Point = NDArray[np.float64]


def env_arguments(preset: Preset, cell: Cell, track: Track | None = None) -> dict[str, Any]:
    """Arguments of ``make_env`` for a cell; without a track, for a planner's."""
    geometry: str | RRSGeometry = cell.geometry
    if cell.geometry in preset.geometries:
        geometry = RRSGeometry(**preset.geometries[cell.geometry])
    if track is None:
        at_once = {"team": "central"} if cell.method == OPTIMUM_AT_ONCE else {}
        return {"geometry": geometry, "reward": "progress", **at_once}
    names = ("reward", "observation", "mask_singularities", "mask_visited", "mask_refused")
    given = {name: getattr(track, name) for name in names}
    given |= {"collision": track.collision} if track.collision != "refuse" else {}
    given |= {"reward_kwargs": dict(track.reward_kwargs) or None, "sim_to_real": track.sim_to_real}
    asked = {name: getattr(track, name) for name in ("task", "shield", "team")}
    given |= {name: value for name, value in asked.items() if value is not None}
    given |= {"sight": track.sight} if track.team not in (None, "central") else {}
    return {"geometry": geometry, **given}


def distance_to_segment(points: Point, start: Point, end: Point) -> Point:
    """Distances (n,) of points (n, 3) from the straight segment between two points (3,)."""
    axis = end - start
    length = float(axis @ axis)
    along = np.clip((points - start) @ axis / length, 0.0, 1.0) if length > 0.0 else 0.0
    foot = start + np.multiply.outer(along, axis)
    return np.asarray(np.linalg.norm(points - foot, axis=-1), dtype=np.float64)


def dome_frame(env: CoopInsertionEnv) -> Point:
    """The peg's tip (3,) in the dome's frame, m: fixed to the platform, origin at its centre."""
    state = env.state
    pose = platform_pose(*state["configuration"][3:6].tolist(), env.params.rrs)
    rotation = np.array(pose[3:12]).reshape(3, 3)
    return np.asarray(rotation.T @ (state["tip"] - np.array(pose[0:3])), dtype=np.float64)


class Episode:
    """Episode ``number`` of a seed under test, from ``reset`` to its row of the results."""

    def __init__(self, env: CoopInsertionEnv, number: int, reset_seed: int) -> None:
        self.env, self.number, self.reset_seed = env, number, reset_seed
        self.observation: Observation
        self.observation, info = env.reset(seed=reset_seed)
        self.over = False
        self.reward = 0.0
        self.moves = self.collisions = self.violations = self.duplicates = 0
        self.insertions: list[int] = []
        self.alignments: list[float] = []
        # a short digest of the initial state: equal for methods that began alike
        numbers = np.append(env.state["configuration"], env.state["target"])
        self.start = hashlib.sha256(np.round(numbers, 9).tobytes()).hexdigest()[:10]
        self.failure = ""
        self.plan_seconds = math.nan
        self._target = int(info["target"])
        self._track = [dome_frame(env)]
        self._way = [env.state["configuration"].copy()]
        self._at_first: defaultdict[str, float] = defaultdict(lambda: math.nan)
        self._info = info

    @property
    def moves_left(self) -> int:
        """Moves until the episode is cut off."""
        return int(self.env.params.task.max_moves) - self.moves

    def move(self, action: int) -> dict[str, Any]:
        """Make one move and account for it; returns the environment's info."""
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        self.moves += 1
        self.reward += float(reward)
        self.collisions += bool(info["collision"])
        self.violations += bool(info["violation"])
        self.duplicates += bool(info["duplicate"])
        if not self.insertions:
            self._track.append(dome_frame(self.env))
            if not (info["violation"] or info["singular"]):
                self._way.append(self.env.state["configuration"].copy())
        if info["inserted"]:
            self.insertions.append(self.moves)
            self.alignments.append(math.degrees(info["alignment_error"]))
            if len(self.insertions) == 1:
                self._at_first |= self._first(info)
        self._info = info
        self.over = bool(terminated or truncated)
        return info

    def _first(self, info: dict[str, Any]) -> dict[str, float]:
        task = self.env.task
        hole = task.dome_radius * np.array(task.hole_normals[self._target])
        points = np.array(self._track)
        deviation = distance_to_segment(points, points[0], hole)
        return {
            "moves_first": float(self.moves),
            "time_first": float(info["time"]),
            "alignment_error": math.degrees(info["alignment_error"]),
            "trajectory_error": 1000.0 * float(np.sqrt(np.mean(deviation**2))),
            "collisions_first": float(self.collisions),
            "energy_first": float(info["energy"]),
        }

    def seconds_first(self, arguments: Mapping[str, Any]) -> float:
        """Seconds to the first insertion under the joints' limits, stop-and-go; NaN without one."""
        if not self.insertions or arguments.get("sim_to_real"):
            return math.nan
        geometry = arguments.get("geometry", "optimized")
        return make_trajectory(np.array(self._way), geometry, task=arguments.get("task")).duration

    def row(self, noise: float = 0.0) -> dict[str, object]:
        """The episode's row of episodes.csv; what needs an insertion is empty without one."""
        first = self._at_first
        holes = len(self.insertions)
        dt = float(self._info["time"]) / self.moves if self.moves else math.nan
        return {
            "episode": self.number,
            "reset_seed": self.reset_seed,
            "start": self.start,
            "noise": noise,
            "success": holes > 0,
            "holes": holes,
            "all_holes": holes == len(self.env.task.holes),
            "singular": bool(self._info["singular"]),
            "moves": self.moves,
            "reward": self.reward,
            "moves_first": first["moves_first"],
            "time_first": first["time_first"],
            "time_per_hole": dt * self.insertions[-1] / holes if holes else math.nan,
            "alignment_error": first["alignment_error"],
            "alignment_error_all": float(np.mean(self.alignments)) if holes else math.nan,
            "trajectory_error": first["trajectory_error"],
            "collisions": self.collisions,
            "collisions_first": first["collisions_first"],
            "violations": self.violations,
            "duplicates": self.duplicates,
            "energy": float(self._info["energy"]),
            "energy_first": first["energy_first"],
            "insertion_moves": ";".join(str(move) for move in self.insertions),
            "failure": self.failure,
            "plan_seconds": self.plan_seconds,
        }
