"""The physics twin beside the kinematics: errors over random poses, speed, and its model folder.

Speed is CPU time of the process on threads that do nothing else, in turns, the median round;
actions are random, drawn beforehand, with a bias downwards so that the peg meets the dome.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from benchmarks.errors import at_least
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, source
from benchmarks.studies.speed.timing import in_turns, options, resident_mb
from coop_env.geometry import GEOMETRIES

if TYPE_CHECKING:
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.vector_env import CoopInsertionContactVectorEnv

BATCH: Final = 16
SINGLE: Final = "single"
ENGINE: Final = "engine alone, as many timesteps"
BATCHES: Final = {f"batch of {BATCH}, {n} thread{'s' * (n > 1)}": n for n in (1, 2)}
# figure: unit, factor from SI, goal
ERRORS: Final = {
    "tip": ("mm", 1e3, 0.05),
    "platform": ("degrees", float(np.degrees(1.0)), 0.05),
    "centre": ("mm", 1e3, None),
    "joints": ("degrees", float(np.degrees(1.0)), None),
    "loop": ("mm", 1e3, None),
}
NAMES: Final = {
    "tip": "tip of the peg",
    "platform": "rotation of the platform",
    "centre": "centre of the platform",
    "joints": "worst actuated joint",
    "loop": "widest gap of a loop",
}
STEPS_PER_SECOND: Final = 1000.0
PER_CORE: Final = 0.9


def measure_errors(geometry: str, poses: int) -> dict[str, Any]:
    """Median and largest error of each kind, SI, over so many random valid poses."""
    from coop_env.physics.model import Machine
    from coop_env.physics.twin import Twin
    from coop_env.physics.validation import draw_poses, validate

    twin = Twin(Machine(rrs=GEOMETRIES[geometry]), n=min(poses, 20))
    result = validate(twin, draw_poses(twin, poses, seed=0))
    return {
        name: {"median": float(np.median(part)), "largest": float(np.max(part))}
        for name, part in result._asdict().items()
        if name != "steps"
    }


def _actions(steps: int) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (max(1, steps // BATCH), BATCH, 6))
    drawn[..., 2] -= 0.3
    return np.clip(drawn, -1.0, 1.0)


def _single_loop(env: CoopInsertionContactEnv, steps: int) -> Callable[[], None]:
    actions = _actions(steps).reshape(-1, 6)
    env.reset(seed=0)

    def loop() -> None:
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return loop


def _batch_loop(env: CoopInsertionContactVectorEnv, steps: int) -> Callable[[], None]:
    actions = _actions(steps)
    env.reset(seed=0)

    def loop() -> None:
        for row in actions:
            env.step(row)

    return loop


def measure_speed(steps: int, rounds: int) -> dict[str, float]:
    """Control steps a CPU second: the single form, batches, and the engine alone above a hole."""
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.twin import Twin
    from coop_env.physics.vector_env import CoopInsertionContactVectorEnv

    twin = Twin()
    substeps, home = CoopInsertionContactEnv().task.substeps, twin.machine.home()
    targets = twin.servo_targets(home)[None]
    steps = BATCH * max(1, steps // BATCH)

    def engine() -> None:
        for _ in range(steps):
            twin.advance(targets, substeps)

    loops = {
        SINGLE: _single_loop(CoopInsertionContactEnv(), steps),
        **{
            name: _batch_loop(CoopInsertionContactVectorEnv(BATCH, threads=n), steps)
            for name, n in BATCHES.items()
        },
        ENGINE: engine,
    }
    return {name: steps / each for name, each in in_turns(loops, rounds).items()}


def measure_memory(steps: int) -> float:
    """Megabytes that the process grows by over so many control steps after a tenth as many."""
    from coop_env.physics.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv()
    chunk = max(1, steps // 10)
    loop = _single_loop(env, chunk)
    loop()
    before = resident_mb()
    for _ in range(10):
        loop()
    return resident_mb() - before


class Physics(Measured):
    """The twin: its errors, its speed, its model folder."""

    name, file, needs = "physics", "physics/physics.json", ("mujoco", "physics")
    options = {  # noqa: RUF012
        "--poses": {"type": at_least(1), "default": 1000, "help": "poses of each geometry"},
        **options(steps=800, rounds=7),
        "--memory-steps": {
            "type": at_least(10), "default": 20_000, "help": "control steps of the memory test",
        },
    }  # fmt: skip

    def measures(self) -> dict[str, Part]:
        given = self.given
        return {
            **{
                f"errors, {name}": lambda _, of=name: measure_errors(of, given.poses)  # type: ignore[misc]
                for name in GEOMETRIES
            },
            "load": lambda _: os.getloadavg()[0],
            "speed": lambda _: measure_speed(given.steps, given.rounds),
            "memory": lambda _: measure_memory(given.memory_steps),
        }

    def finish(self) -> None:
        from coop_env.physics.model import Machine
        from coop_env.physics.model_folder import save_model

        save_model(Machine(), self.folder / "model")

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        asked, parts = result["asked"], result["parts"]
        rows = []
        for geometry in GEOMETRIES:
            for name, error in parts[f"errors, {geometry}"].items():
                unit, factor, goal = ERRORS[name]
                median, largest = (f"{factor * error[of]:.2g}" for of in ("median", "largest"))
                wanted = "" if goal is None else f"{goal:g}"
                rows.append([geometry, f"{NAMES[name]}, {unit}", median, largest, wanted])
        rate, load = parts["speed"], f", load {parts['load']:.1f}"
        per_core = {name: rate[name] / rate[SINGLE] for name in BATCHES}
        speeds = [
            [name, f"{value:,.0f}", f"{per_core[name]:.2f}" if name in per_core else "",
             f"{STEPS_PER_SECOND:,.0f}" if name == SINGLE else f"{PER_CORE} of single"
             if name in per_core else ""]
            for name, value in rate.items()
        ]  # fmt: skip
        return "\n\n".join(
            [
                plain(
                    f"Twin against kinematics, {asked['poses']:,} random valid poses",
                    "geometry | error | median | largest | goal, at most",
                    rows,
                ),
                plain(
                    "Control steps a CPU second (one is 25 timesteps)",
                    "form | steps/s | per core, of single | goal, at least",
                    speeds,
                ),
                f"Memory over {asked['memory_steps']:,} control steps: {parts['memory']:+.1f} MB. "
                f"{source(result, load)} Speed is the median of "
                f"{asked['rounds']} rounds of {asked['steps']:,} control steps.",
            ]
        )
