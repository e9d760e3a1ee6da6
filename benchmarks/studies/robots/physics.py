"""The physics twin beside the kinematics: errors over random poses, speed, and its model folder.

Speed is CPU time of the process on threads that do nothing else, in turns, the median round;
actions are random, drawn beforehand, with a bias downwards so that the peg meets the dome.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.reporting.pages import blocks
from benchmarks.reporting.verify import Report
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from benchmarks.studies.robots.pages import check_tables
from benchmarks.studies.speed import report
from coop_env.geometry import GEOMETRIES

if TYPE_CHECKING:
    from coop_env.physics.contact.env import CoopInsertionContactEnv
    from coop_env.physics.contact.vector_env import CoopInsertionContactVectorEnv

BLOCK: Final = "physics"
PAGE: Final = "physics.md"
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
    found = validate(twin, draw_poses(twin, poses, seed=0))
    return {
        name: {"median": float(np.median(part)), "largest": float(np.max(part))}
        for name, part in found._asdict().items()
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
    from coop_env.physics.contact.env import CoopInsertionContactEnv
    from coop_env.physics.contact.vector_env import CoopInsertionContactVectorEnv
    from coop_env.physics.twin import Twin

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
    return {name: steps / each for name, each in report.in_turns(loops, rounds).items()}


def measure_memory(steps: int) -> float:
    """Megabytes that the process grows by over so many control steps after a tenth as many."""
    from coop_env.physics.contact.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv()
    chunk = max(1, steps // 10)
    loop = _single_loop(env, chunk)
    loop()
    before = report.resident_mb()
    for _ in range(10):
        loop()
    return report.resident_mb() - before


def tell(found: dict[str, Any]) -> str:
    """The measurements as Markdown."""
    machine, rate = found["machine"], found["steps_per_second"]
    rows = []
    for geometry, errors in found["errors"].items():
        for name, error in errors.items():
            unit, factor, goal = ERRORS[name]
            median, largest = (f"{factor * error[which]:.2g}" for which in ("median", "largest"))
            wanted = "" if goal is None else f"{goal:g}"
            rows.append([geometry, f"{NAMES[name]}, {unit}", median, largest, wanted])
    per_core = {name: rate[name] / rate[SINGLE] for name in BATCHES}
    speeds = [
        [name, f"{value:,.0f}", f"{per_core[name]:.2f}" if name in per_core else "",
         f"{STEPS_PER_SECOND:,.0f}" if name == SINGLE else f"{PER_CORE} of single"
         if name in per_core else ""]
        for name, value in rate.items()
    ]  # fmt: skip
    return "\n\n".join(
        [
            report.table(
                f"Twin against kinematics, {found['poses']:,} random valid poses",
                "geometry | error | median | largest | goal, at most",
                rows,
            ),
            report.table(
                "Control steps a CPU second (one is 25 timesteps)",
                "form | steps/s | per core, of single | goal, at least",
                speeds,
            ),
            f"Memory over {found['memory_steps']:,} control steps: {found['memory_mb']:+.1f} MB. "
            f"Command: `{found['command']}`. {machine['machine']['processor']}, load "
            f"{found['load']:.1f}, commit {machine['commit'][:9]}, MuJoCo {found['mujoco']}; speed "
            f"is the median of {found['rounds']} rounds of {found['steps']:,} control steps.",
        ]
    )


def main(words: Sequence[str]) -> int:
    """Measure, print, write ``physics/`` below the results folder and the block of the docs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks physics", description=__doc__)
    add = parser.add_argument
    add("--results", type=Path, default=Path("results"))
    add("--docs", type=Path, default=Path("docs"), help=f"folder of {PAGE}")
    add("--poses", type=at_least(1), default=1000, help="for each geometry")
    add("--steps", type=at_least(BATCH), default=800, help="control steps per round")
    add("--rounds", type=at_least(1), default=7)
    add("--memory-steps", type=at_least(10), default=20_000)
    given = parser.parse_args(list(words))
    try:
        from coop_env.physics.engine import mujoco
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    from coop_env.physics.model import Machine
    from coop_env.physics.model_folder import save_model

    folder = given.results / "physics"
    found: dict[str, Any] = {
        "command": " ".join(["python -m benchmarks physics", *words]),
        "machine": describe(),
        "mujoco": mujoco.__version__,
        "poses": given.poses,
        "steps": given.steps,
        "rounds": given.rounds,
        "memory_steps": given.memory_steps,
        "errors": {
            name: report.measured(f"errors, {name}", measure_errors, name, given.poses)
            for name in GEOMETRIES
        },
        "load": os.getloadavg()[0],
        "steps_per_second": report.measured("speed", measure_speed, given.steps, given.rounds),
        "memory_mb": report.measured("memory", measure_memory, given.memory_steps),
    }
    write_text(folder / "physics.json", json.dumps(found, indent=1) + "\n")
    write_text(folder / "physics.md", tell(found) + "\n")
    save_model(Machine(), folder / "model")
    page = given.docs / PAGE
    if page.is_file():
        blocks.rewrite(page, lambda text: blocks.fill(text, BLOCK, lambda _: tell(found)))
    print(tell(found))
    print(f"Written to {folder}")
    return 0


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the tables, here and in the docs, follow from what was measured."""
    check_tables(report, results / "physics/physics.json", tell, docs / PAGE, BLOCK)
