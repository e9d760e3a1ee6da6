"""The physics twin beside the kinematics: errors over random poses, speed, and its model folder.

Speed is control steps per CPU second in the median round; single form, batches and engine take
turns. Actions are random, drawn beforehand, with a bias downwards so that the peg meets the dome.
"""

import os
from functools import partial
from typing import Any, Final

import numpy as np
import psutil

from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, Tick, count, source
from benchmarks.studies.speed import in_turns, options, stepping
from coop_env.geometry import GEOMETRIES

BATCH: Final = 16
SINGLE: Final = "single"
ENGINE: Final = "engine alone, as many timesteps"
BATCHES: Final = {f"batch of {BATCH}, {n} thread{'s' * (n > 1)}": n for n in (1, 2)}
DEGREE: Final = float(np.degrees(1.0))
# an error's name, unit, factor from SI, goal
ERRORS: Final = {
    "tip": ("tip of the peg", "mm", 1e3, "0.05"),
    "platform": ("rotation of the platform", "degrees", DEGREE, "0.05"),
    "centre": ("centre of the platform", "mm", 1e3, ""),
    "joints": ("worst actuated joint", "degrees", DEGREE, ""),
    "loop": ("widest gap of a loop", "mm", 1e3, ""),
}


def measure_errors(geometry: str, poses: int, _: Tick) -> dict[str, Any]:
    """Median and largest error of each kind, SI, over ``poses`` random valid poses."""
    from coop_env.physics.model import Machine
    from coop_env.physics.twin import Twin
    from coop_env.physics.validation import draw_poses, validate

    twin = Twin(Machine(rrs=GEOMETRIES[geometry]), n=min(poses, 20))
    result = validate(twin, draw_poses(twin, poses, seed=0))
    return {
        name: {"median": float(np.median(part)), "largest": float(np.max(part))}
        for name, part in result._asdict().items()
    }


def _actions(steps: int) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (max(1, steps // BATCH), BATCH, 6))
    drawn[..., 2] -= 0.3
    return np.clip(drawn, -1.0, 1.0)


def measure_speed(steps: int, rounds: int, _: Tick) -> dict[str, float]:
    """Control steps a CPU second: the single form, batches, and the engine alone above a hole."""
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.twin import Twin
    from coop_env.physics.vector_env import CoopInsertionContactVectorEnv

    twin, env, actions = Twin(), CoopInsertionContactEnv(), _actions(steps)
    targets = twin.servo_targets(twin.machine.home())[None]
    steps = actions.shape[0] * BATCH

    def engine() -> None:
        for _ in range(steps):
            twin.advance(targets, env.task.substeps)

    loops = {SINGLE: stepping(env, actions.reshape(-1, 6))}
    for name, n in BATCHES.items():
        loops[name] = stepping(CoopInsertionContactVectorEnv(BATCH, threads=n), actions)
    loops[ENGINE] = engine
    return {name: steps / each for name, each in in_turns(loops, rounds).items()}


def measure_memory(steps: int, tick: Tick) -> float:
    """Growth of the process, MB, over ``steps`` control steps, after a tenth as many."""
    from coop_env.physics.env import CoopInsertionContactEnv

    loop = stepping(CoopInsertionContactEnv(), _actions(max(1, steps // 10)).reshape(-1, 6))
    loop()
    process = psutil.Process()
    before = process.memory_info().rss
    for done in range(10):
        loop()
        tick((done + 1) / 10)
    return float(process.memory_info().rss - before) / 1e6


class Physics(Measured):
    """The twin: its errors, its speed, its model folder."""

    name, file, needs = "physics", "physics/physics.json", ("mujoco", "physics")
    options = {  # noqa: RUF012
        "--poses": count(1000, "poses of each geometry"),
        **options(steps=800, rounds=7),
        "--memory-steps": count(20_000, "control steps of the memory test", 10),
    }

    def measures(self) -> dict[str, Part]:
        given, n = self.given, self.given.poses
        return {
            **{f"errors, {name}": partial(measure_errors, name, n) for name in GEOMETRIES},
            "load": lambda _: os.getloadavg()[0],
            "speed": partial(measure_speed, given.steps, given.rounds),
            "memory": partial(measure_memory, given.memory_steps),
        }

    def finish(self) -> None:
        from coop_env.physics.model import Machine
        from coop_env.physics.model_folder import save_model

        save_model(Machine(), self.folder / "model")

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        asked, parts = result["asked"], result["parts"]
        rows, rate = [], parts["speed"]
        for geometry in GEOMETRIES:
            for key, error in parts[f"errors, {geometry}"].items():
                name, unit, factor, goal = ERRORS[key]
                numbers = [f"{factor * error[of]:.2g}" for of in ("median", "largest")]
                rows.append([geometry, f"{name}, {unit}", *numbers, goal])
        title = f"Twin against kinematics, {asked['poses']:,} random valid poses"
        errors = plain(title, "geometry | error | median | largest | goal, at most", rows)
        goals, rows = {SINGLE: "1,000", **dict.fromkeys(BATCHES, "0.9 of single")}, []
        for name, value in rate.items():
            per_core = f"{value / rate[SINGLE]:.2f}" if name in BATCHES else ""
            rows.append([name, f"{value:,.0f}", per_core, goals.get(name, "")])
        title = "Control steps a CPU second (one is 25 timesteps)"
        speeds = plain(title, "form | steps/s | per core, of single | goal, at least", rows)
        load = f", load {parts['load']:.1f}"
        note = (
            f"Memory over {asked['memory_steps']:,} control steps: {parts['memory']:+.1f} MB. "
            f"{source(result, load)} Speed is the median of "
            f"{asked['rounds']} rounds of {asked['steps']:,} control steps."
        )
        return "\n\n".join([errors, speeds, note])
