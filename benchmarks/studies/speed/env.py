"""How fast the environment is: single and batched steps, the design map, the optimum, memory.

One core, in turns, so that whatever else the machine does falls on all of them. A round's time is
CPU time of the process; the figure is the median round. Actions are random and drawn beforehand;
every step is followed by the action masks, as a masked learner needs them.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from benchmarks.methods.oracle import LatticeOracle
from benchmarks.studies.design.reference import workspace_map
from benchmarks.studies.speed.report import measured, provenance, write
from coop_env import design
from coop_env.env import CoopInsertionEnv
from coop_env.env_batch import EnvBatch
from coop_env.geometry import OPTIMIZED
from coop_env.simulation import batch as kernels
from coop_env.vec_env import CoopInsertionVecEnv

SINGLE: Final = "single, gymnasium.make, Python loop"
BATCH: Final = "batch of 64"
TARGETS: Final = {
    "batch_steps_per_second": 300_000.0,
    "batch_over_single": 20.0,
    "single_step_us": 20.0,
    "area_over_reference": 5.0,
    "oracle_500_starts_s": 60.0,
}


def _single_loop(env: gym.Env[Any, Any], steps: int) -> Callable[[], None]:
    actions = np.random.default_rng(0).integers(12, size=steps)
    bare: Any = env.unwrapped

    def loop() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            bare.action_masks()
            if terminated or truncated:
                env.reset()

    env.reset(seed=0)
    return loop


def _batch_loop(env: Any, steps: int) -> Callable[[], None]:
    rounds = max(1, steps // env.num_envs)
    actions = np.random.default_rng(0).integers(12, size=(rounds, env.num_envs))

    def loop() -> None:
        for row in actions:
            env.step(row)
            env.env_method("action_masks")

    env.reset()
    return loop


def _kernel_loop(env: EnvBatch, steps: int) -> Callable[[], None]:
    """The step kernel on a batch without resets and infos: moves to and fro from the start."""
    n = len(env.envs)
    rounds = max(1, steps // n)
    env.reset(range(n), [None] * n)
    arguments = env.packed, env.observation, env.outcomes, env.rows
    actions = np.random.default_rng(0).integers(12, size=(rounds, n))
    actions[1::2] = actions[: len(actions[1::2]) * 2 : 2] ^ 1

    def loop() -> None:
        for row in actions:
            kernels.step_batch(env.states, row, *arguments)

    return loop


def _dummy(n_envs: int) -> Any:
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([CoopInsertionEnv] * n_envs)


def measure_steps(steps: int, rounds: int) -> dict[str, float]:
    """Microseconds a step, median over rounds in turns."""
    loops = {
        SINGLE: _single_loop(gym.make("CoopInsertion-v0"), steps),
        "single, without Gymnasium's wrappers": _single_loop(CoopInsertionEnv(), steps),
        "SB3 DummyVecEnv of 64": _batch_loop(_dummy(64), steps),
        **{
            f"batch of {n}": _batch_loop(CoopInsertionVecEnv(n, seed=0), steps)
            for n in (1, 8, 64, 256)
        },
        "batch of 64, every option": _batch_loop(
            CoopInsertionVecEnv(
                64, seed=0, observation="markov", reward="progress", sim_to_real="randomized"
            ),
            steps,
        ),
        "kernel alone, batch of 64": _kernel_loop(EnvBatch(64), steps),
    }
    times: dict[str, list[float]] = {name: [] for name in loops}
    for loop in loops.values():
        loop()
    for _ in range(rounds):
        for name, loop in loops.items():
            began = time.process_time()
            loop()
            times[name].append((time.process_time() - began) / steps)
    return {name: 1e6 * statistics.median(values) for name, values in times.items()}


def measure_area(rounds: int) -> dict[str, float]:
    """Milliseconds for one map of the workspace A_w, ours and the batched-SVD numpy reference."""
    maps: dict[str, Callable[[], Any]] = {
        "coop_env.design": lambda: design.workspace_area(OPTIMIZED),
        "numpy, batched SVD": lambda: workspace_map(OPTIMIZED),
    }
    times: dict[str, list[float]] = {name: [] for name in maps}
    for run in maps.values():
        run()
    for _ in range(rounds):
        for name, run in maps.items():
            began = time.process_time()
            run()
            times[name].append(time.process_time() - began)
    return {name: 1e3 * statistics.median(values) for name, values in times.items()}


def measure_oracle(starts: int) -> dict[str, Any]:
    """CPU seconds, feasible share and mean length of the exact optimum over the first seeds."""
    found: dict[str, Any] = {"starts": starts}
    for geometry in ("optimized", "initial"):
        env, oracle = CoopInsertionEnv(geometry=geometry), LatticeOracle()
        env.reset(seed=0)
        oracle.plan(env)
        began, lengths, detours = time.process_time(), [], []
        for seed in range(starts):
            env.reset(seed=seed)
            plan = oracle.plan(env)
            if plan.moves is not None:
                lengths.append(len(plan.moves))
                detours.append(len(plan.moves) - plan.detail["bound"])
        found[geometry] = {
            "seconds": time.process_time() - began,
            "feasible": len(lengths) / starts,
            "mean_moves": float(np.mean(lengths)),
            "mean_detour": float(np.mean(detours)),
        }
    return found


def _resident_mb() -> float | None:
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(s for s in status.read_text("utf-8").splitlines() if s.startswith("VmRSS"))
    return int(line.split()[1]) / 1e3


def measure_memory(steps: int) -> float | None:
    """Megabytes that the process grows by over so many batched steps; None off Linux."""
    loop = _batch_loop(CoopInsertionVecEnv(64, seed=0), steps // 2)
    loop()
    before = _resident_mb()
    loop()
    loop()
    after = _resident_mb()
    return None if before is None or after is None else after - before


def ratios(found: dict[str, Any]) -> dict[str, float]:
    """The measured figures that :data:`TARGETS` has a goal for."""
    us, area = found["step_us"], found["area_ms"]
    return {
        "batch_steps_per_second": 1e6 / us[BATCH],
        "batch_over_single": us[SINGLE] / us[BATCH],
        "single_step_us": us["single, without Gymnasium's wrappers"],
        "area_over_reference": area["numpy, batched SVD"] / area["coop_env.design"],
        "oracle_500_starts_s": 500.0
        * found["oracle"]["optimized"]["seconds"]
        / found["oracle"]["starts"],
    }


def report(found: dict[str, Any]) -> str:
    """The measurements as Markdown."""
    us = found["step_us"]
    lines = [
        "# Speed of the environment",
        "",
        f"Command: `{found['command']}`. {found['machine']['machine']['processor']}, one core, "
        f"load {found['load']:.1f}, commit {found['machine']['commit'][:10]}, "
        + ", ".join(f"{k} {v}" for k, v in found["machine"]["versions"].items())
        + ".",
        "",
        f"A step with its action masks; median of {found['rounds']} rounds of {found['steps']} "
        "steps in turns, CPU time.",
        "",
        "| | us a step | steps/s | ratio to the single loop |",
        "|---|---|---|---|",
        *(f"| {k} | {v:.2f} | {1e6 / v:,.0f} | {us[SINGLE] / v:.2f} |" for k, v in us.items()),
        "",
        "| figure | measured | goal | met |",
        "|---|---|---|---|",
    ]
    for name, value in ratios(found).items():
        goal = TARGETS[name]
        at_most = name in ("single_step_us", "oracle_500_starts_s")
        met = value <= goal if at_most else value >= goal
        sign = "at most" if at_most else "at least"
        lines.append(f"| {name} | {value:,.2f} | {sign} {goal:,.0f} | {'yes' if met else 'no'} |")
    lines += [
        "",
        "`batch_over_single` is low because the single step is fast: a batch saves the Python "
        f"around the kernel, and the kernel itself takes {us['kernel alone, batch of 64']:.2f} us "
        "of either.",
        "",
        "| exact optimum | feasible | mean moves | of these to avoid collisions | CPU s |",
        "|---|---|---|---|---|",
    ]
    for geometry in ("optimized", "initial"):
        row = found["oracle"][geometry]
        lines.append(
            f"| {geometry}, {found['oracle']['starts']} starts | {100 * row['feasible']:.1f} % "
            f"| {row['mean_moves']:.1f} | {row['mean_detour']:.3f} | {row['seconds']:.1f} |"
        )
    memory = found["memory_mb"]
    grown = "not measured here" if memory is None else f"{memory:+.1f} MB"
    lines += ["", f"Memory over {found['memory_steps']:,} batched steps: {grown}.", ""]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Measure, print, and write ``speed/env.json`` and ``.md`` below the results folder."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks speed env", description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--steps", type=int, default=12_800, help="steps per round and method")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--starts", type=int, default=500, help="starts for the exact optimum")
    parser.add_argument("--memory-steps", type=int, default=1_000_000)
    arguments = parser.parse_args(argv)
    steps, rounds = arguments.steps, arguments.rounds
    found: dict[str, Any] = {
        **provenance("env", argv),
        "steps": steps,
        "rounds": rounds,
        "memory_steps": arguments.memory_steps,
        "step_us": measured("steps", measure_steps, steps, rounds),
        "area_ms": measured("the workspace map", measure_area, rounds),
        "oracle": measured("the exact optimum", measure_oracle, arguments.starts),
        "memory_mb": measured("memory", measure_memory, arguments.memory_steps),
    }
    found["ratios"] = ratios(found)
    write(arguments.results, "env", found, report(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
