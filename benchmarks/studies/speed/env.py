"""How fast the environment is: single and batched steps with their masks, and the exact optimum.

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
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, source
from benchmarks.studies.speed.timing import in_turns, options, seconds_of
from coop_env.env import CoopInsertionEnv
from coop_env.team.joint_env import CoopInsertionJointEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv

SINGLE: Final = "single, gymnasium.make, Python loop"
BARE: Final = "single, without Gymnasium's wrappers"
# rows of the optimum: geometry, and whether both robots move at once
OPTIMA: Final = {
    **{name: (name, False) for name in ("optimized", "initial")},
    **{f"{name}, both at once": (name, True) for name in ("optimized", "initial")},
}


def _single_loop(env: gym.Env[Any, Any], steps: int) -> Callable[[], None]:
    actions = np.random.default_rng(0).integers(12, size=steps)
    bare: Any = env.unwrapped
    env.reset(seed=0)

    def loop() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            bare.action_masks()
            if terminated or truncated:
                env.reset()

    return loop


def _batch_loop(env: Any, steps: int) -> Callable[[], None]:
    size = (max(1, steps // env.num_envs), env.num_envs)
    actions = np.random.default_rng(0).integers(12, size=size)
    env.reset()

    def loop() -> None:
        for row in actions:
            env.step(row)
            env.env_method("action_masks")

    return loop


def measure_steps(steps: int, rounds: int) -> dict[str, float]:
    """Microseconds a step, median over rounds in turns."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    batch = partial(CoopInsertionVecEnv, seed=0)
    loops = {
        SINGLE: _single_loop(gym.make("CoopInsertion-v0"), steps),
        BARE: _single_loop(CoopInsertionEnv(), steps),
        "SB3 DummyVecEnv of 64": _batch_loop(DummyVecEnv([CoopInsertionEnv] * 64), steps),
        **{f"batch of {n}": _batch_loop(batch(n), steps) for n in (1, 8, 64, 256)},
    }
    return in_turns(loops, rounds, unit=1e-6 * steps)


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
    result = [(len(p.moves), p.detail["bound"]) for p in plans if p.moves is not None]
    moves, bound = np.mean(result, axis=0)
    return {
        "seconds": seconds,
        "feasible": len(result) / starts,
        "mean_moves": float(moves),
        "mean_detour": float(moves - bound),
    }


class SpeedEnv(Measured):
    """Steps with their masks, and the exact optimum."""

    name, file = "speed-env", "speed/env.json"
    options = {  # noqa: RUF012
        **options(steps=12_800, rounds=9),
        "--starts": {"type": at_least(1), "default": 500, "help": "starts of the exact optimum"},
    }

    def measures(self) -> dict[str, Part]:
        given = self.given
        return {
            "steps": lambda _: measure_steps(given.steps, given.rounds),
            **{
                f"optimum, {name}": lambda _, what=what: measure_oracle(given.starts, *what)  # type: ignore[misc]
                for name, what in OPTIMA.items()
            },
        }

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        parts, asked = result["parts"], result["asked"]
        us, optimum = parts["steps"], []
        for name in (name for name in OPTIMA if f"optimum, {name}" in parts):
            row = parts[f"optimum, {name}"]
            moves = [f"{row['mean_moves']:.1f}", f"{row['mean_detour']:.3f}"]
            optimum.append(
                [name, f"{100 * row['feasible']:.1f} %", *moves, f"{row['seconds']:.1f}"]
            )
        steps = [[k, f"{v:.2f}", f"{1e6 / v:,.0f}", f"{us[SINGLE] / v:.2f}"] for k, v in us.items()]
        return "\n\n".join([
            plain(
                "A step with its action masks, CPU time",
                "method | us a step | steps/s | ratio to the single loop",
                steps,
            ),
            plain(
                f"Exact optimum over {asked['starts']} starts",
                "geometry | feasible | mean moves or ticks | of these to avoid collisions | CPU s",
                optimum,
            ),
            source(result, f"; medians over {asked['rounds']} rounds of {asked['steps']} steps"),
        ])  # fmt: skip
