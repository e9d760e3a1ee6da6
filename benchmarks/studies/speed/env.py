"""How fast the environment is: single and batched steps, the design map, the optimum, memory.

One core, in turns, so that whatever else the machine does falls on all of them. A round's time is
CPU time of the process; the figure is the median round. Actions are random and drawn beforehand;
every step is followed by the action masks, as a masked learner needs them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import gymnasium as gym
import numpy as np

from benchmarks.errors import at_least
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.studies.design.reference import workspace_map
from benchmarks.studies.speed import report
from benchmarks.studies.speed.setting import seconds_of
from coop_env import design
from coop_env.env import CoopInsertionEnv
from coop_env.geometry import OPTIMIZED
from coop_env.simulation import batch as kernels
from coop_env.simulation.joint import N_CHOICES, N_JOINT
from coop_env.team.agents import AGENTS
from coop_env.team.joint_env import CoopInsertionJointEnv
from coop_env.team.vec_env import CoopInsertionJointVecEnv, CoopInsertionTeamVecEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv
from coop_env.vector.vector_env import CoopInsertionVectorEnv

SINGLE: Final = "single, gymnasium.make, Python loop"
BARE: Final = "single, without Gymnasium's wrappers"
BATCH: Final = "batch of 64"
JOINT: Final = "both robots at once, one agent, batch of 64: a tick"
TEAM: Final = "both robots at once, two agents, batch of 64: a tick"
KERNEL: Final = "kernel alone, batch of 64"
OUR_MAP: Final = "coop_env.design"
NUMPY_MAP: Final = "numpy, batched SVD"
# figure: whether the goal is the most or the least that it should be, and the goal
TARGETS: Final = {
    "batch_steps_per_second": ("at least", 300_000.0),
    "batch_over_single": ("at least", 20.0),
    "joint_over_batch": ("at least", 0.5),
    "team_over_batch": ("at least", 0.5),
    "single_step_us": ("at most", 20.0),
    "area_over_reference": ("at least", 5.0),
    "oracle_500_starts_s": ("at most", 60.0),
}
# rows of the optimum: geometry, and whether both robots move at once
OPTIMA: Final = {
    **{name: (name, False) for name in ("optimized", "initial")},
    **{f"{name}, both at once": (name, True) for name in ("optimized", "initial")},
}
EVERY_OPTION: Final[dict[str, Any]] = {
    "observation": "markov",
    "reward": "progress",
    "sim_to_real": "randomized",
}


def _single_loop(env: gym.Env[Any, Any], steps: int) -> Callable[[], None]:
    actions = _drawn(1, steps)[:, 0]
    bare: Any = env.unwrapped
    env.reset(seed=0)

    def loop() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            bare.action_masks()
            if terminated or truncated:
                env.reset()

    return loop


def _batch_loop(env: Any, steps: int, choices: int = 12, agents: int = 1) -> Callable[[], None]:
    """So many moves, or ticks of ``agents``; each choice is one of ``choices``."""
    actions = _drawn(env.num_envs, steps * agents, choices)
    env.reset()

    def loop() -> None:
        for row in actions:
            env.step(row)
            env.env_method("action_masks")

    return loop


def _kernel_loop(env: CoopInsertionVectorEnv, steps: int) -> Callable[[], None]:
    """The step kernel on a batch without resets and infos: moves to and fro from the start."""
    actions = _drawn(env.num_envs, steps)
    actions[1::2] = actions[: len(actions[1::2]) * 2 : 2] ^ 1
    env.reset(seed=0)
    arguments = env.packed, env.transform, env.outcomes, env.rows

    def loop() -> None:
        for row in actions:
            kernels.step_batch(env.states, row, *arguments)

    return loop


def _drawn(n_envs: int, steps: int, choices: int = 12) -> np.ndarray:
    return np.random.default_rng(0).integers(choices, size=(max(1, steps // n_envs), n_envs))


def measure_steps(steps: int, rounds: int) -> dict[str, float]:
    """Microseconds a step, median over rounds in turns."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    batch = partial(CoopInsertionVecEnv, seed=0)
    loops = {
        SINGLE: _single_loop(gym.make("CoopInsertion-v0"), steps),
        BARE: _single_loop(CoopInsertionEnv(), steps),
        "SB3 DummyVecEnv of 64": _batch_loop(DummyVecEnv([CoopInsertionEnv] * 64), steps),
        **{f"batch of {n}": _batch_loop(batch(n), steps) for n in (1, 8, 64, 256)},
        "batch of 64, every option": _batch_loop(batch(64, **EVERY_OPTION), steps),
        JOINT: _batch_loop(CoopInsertionJointVecEnv(64, seed=0), steps, N_JOINT),
        TEAM: _batch_loop(CoopInsertionTeamVecEnv(64, seed=0), steps, N_CHOICES, len(AGENTS)),
        KERNEL: _kernel_loop(CoopInsertionVectorEnv(64), steps),
    }
    return report.in_turns(loops, rounds, unit=1e-6 * steps)


def measure_area(rounds: int) -> dict[str, float]:
    """Milliseconds for one map of the workspace A_w, ours and the batched-SVD numpy reference."""
    maps: dict[str, Callable[[], Any]] = {
        OUR_MAP: partial(design.workspace_area, OPTIMIZED),
        NUMPY_MAP: partial(workspace_map, OPTIMIZED),
    }
    return report.in_turns(maps, rounds, unit=1e-3)


def measure_oracle(starts: int, geometry: str, at_once: bool = False) -> dict[str, float]:
    """CPU seconds, feasible share and mean length of the exact optimum over the first seeds."""
    kind = CoopInsertionJointEnv if at_once else CoopInsertionEnv
    env, oracle = kind(geometry=geometry), LatticeOracle(at_once=at_once)
    plans = []

    def plan() -> None:
        for seed in range(starts):
            env.reset(seed=seed)
            plans.append(oracle.plan(env))

    env.reset(seed=0)
    oracle.plan(env)  # its kernels compile
    seconds = seconds_of(plan).cpu
    found = [(len(p.moves), p.detail["bound"]) for p in plans if p.moves is not None]
    moves, bound = np.mean(found, axis=0)
    return {
        "seconds": seconds,
        "feasible": len(found) / starts,
        "mean_moves": float(moves),
        "mean_detour": float(moves - bound),
    }


def measure_memory(steps: int) -> float:
    """Megabytes that the process grows by over so many batched steps."""
    loop = _batch_loop(CoopInsertionVecEnv(64, seed=0), steps // 2)
    loop()
    before = report.resident_mb()
    loop()
    loop()
    return report.resident_mb() - before


def ratios(found: dict[str, Any]) -> dict[str, float]:
    """The measured figures that :data:`TARGETS` has a goal for."""
    us, area, oracle = found["step_us"], found["area_ms"], found["oracle"]
    return {
        "batch_steps_per_second": 1e6 / us[BATCH],
        "batch_over_single": us[SINGLE] / us[BATCH],
        "joint_over_batch": us[BATCH] / us[JOINT],
        "team_over_batch": us[BATCH] / us[TEAM],
        "single_step_us": us[BARE],
        "area_over_reference": area[NUMPY_MAP] / area[OUR_MAP],
        "oracle_500_starts_s": 500.0 * oracle["optimized"]["seconds"] / oracle["starts"],
    }


def tell(found: dict[str, Any]) -> str:
    """The measurements as Markdown."""
    us, oracle = found["step_us"], found["oracle"]
    goals = []
    for name, value in found["ratios"].items():
        sign, goal = TARGETS[name]
        met = value <= goal if sign == "at most" else value >= goal
        goals.append([name, f"{value:,.2f}", f"{sign} {goal:,.10g}", "yes" if met else "no"])
    optimum = []
    for name, row in ((name, oracle[name]) for name in OPTIMA):
        head = [name, f"{100 * row['feasible']:.1f} %"]
        moves = [f"{row['mean_moves']:.1f}", f"{row['mean_detour']:.3f}"]
        optimum.append([*head, *moves, f"{row['seconds']:.1f}"])
    return report.page(
        "Speed of the environment",
        found,
        "one core",
        report.table(
            "A step with its action masks, CPU time",
            "method | us a step | steps/s | ratio to the single loop",
            ([k, f"{v:.2f}", f"{1e6 / v:,.0f}", f"{us[SINGLE] / v:.2f}"] for k, v in us.items()),
        ),
        report.table("Goals", "figure | measured | goal | met", goals),
        "`batch_over_single` is low because the single step is fast: a batch saves the Python "
        f"around the kernel, and the kernel itself takes {us[KERNEL]:.2f} us of either.",
        report.table(
            f"Exact optimum over {oracle['starts']} starts",
            "geometry | feasible | mean moves or ticks | of these to avoid collisions | CPU s",
            optimum,
        ),
        f"Memory over {found['memory_steps']:,} batched steps: {found['memory_mb']:+.1f} MB.",
    )


def main(argv: list[str]) -> int:
    """Measure, print, and write ``speed/env.json`` and ``.md`` below the results folder."""
    words = report.parser("env", __doc__, steps=12_800, rounds=9)
    words.add_argument(
        "--starts", type=at_least(1), default=500, help="starts for the exact optimum"
    )
    words.add_argument("--memory-steps", type=at_least(1), default=1_000_000)
    given = words.parse_args(argv)
    measured, starts = report.measured, given.starts
    found = report.provenance("env", argv, given) | {
        "memory_steps": given.memory_steps,
        "step_us": measured("steps", measure_steps, given.steps, given.rounds),
        "area_ms": measured("the workspace map", measure_area, given.rounds),
        "oracle": {"starts": starts}
        | {
            name: measured(f"optimum, {name}", measure_oracle, starts, *what)
            for name, what in OPTIMA.items()
        },
        "memory_mb": measured("memory", measure_memory, given.memory_steps),
    }
    found["ratios"] = ratios(found)
    report.write(given.results, "env", found, tell(found))
    return 0
