"""How fast Rainbow is: beside SB3's DQN in one process, on one core, in turns.

"Rainbow" is the default (compiled kernels for a perceptron on the CPU), beside what torch makes of
the same update, eager and compiled.

Net 256-128-64, 51 atoms, 12 observations, 12 actions, batch 64, a full replay buffer of 1e6, one
update per step of an env that costs next to nothing. The methods take turns, so that whatever else
the machine does falls on all of them; CPU seconds of the process are reported beside wall seconds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from benchmarks.speed_report import measured, provenance, write

N_INPUTS: Final = 12
N_ACTIONS: Final = 12
BATCH_SIZE: Final = 64
CAPACITY: Final = 1_000_000


class StubEnv(gym.Env[np.ndarray, np.int64]):
    """Random observations, episodes of 100 steps: only the learner's time counts."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0.0, 1.0, (N_INPUTS,), np.float32)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._rng = np.random.default_rng(0)
        self._time = 0

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """A random observation."""
        self._time = 0
        return self._rng.random(N_INPUTS, dtype=np.float32), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """A random observation, the same reward always."""
        self._time += 1
        obs = self._rng.random(N_INPUTS, dtype=np.float32)
        return obs, 0.1, False, self._time >= 100, {}


def _fill(buffer: Any, seed: int = 0) -> None:
    """Make a replay buffer full, without a million calls of ``add``."""
    rng = np.random.default_rng(seed)
    buffer.observations[:] = rng.random(buffer.observations.shape, dtype=np.float32)
    if hasattr(buffer, "next_observations"):
        buffer.next_observations[:] = rng.random(buffer.observations.shape, dtype=np.float32)
    buffer.actions[:] = rng.integers(0, N_ACTIONS, buffer.actions.shape)
    buffer.rewards[:] = 0.1
    buffer.full = True
    if hasattr(buffer, "tree"):
        buffer.tree.set(np.arange(CAPACITY), rng.uniform(0.5, 2.0, CAPACITY))


def make_models(with_compiled: bool, capacity: int = CAPACITY) -> dict[str, Any]:
    """The methods by name, trained for a moment (compiled where they compile), buffers full."""
    from stable_baselines3 import DQN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        "train_freq": 1,
        "gradient_steps": 1,
        "batch_size": BATCH_SIZE,
        "learning_starts": 50,
        "buffer_size": capacity,
        "policy_kwargs": {"net_arch": [256, 128, 64]},
        "device": "cpu",
        "seed": 0,
    }
    models: dict[str, Any] = {
        "SB3 DQN": DQN("MlpPolicy", StubEnv(), **settings),
        "Rainbow": Rainbow("MlpPolicy", StubEnv(), **settings),
    }
    if with_compiled:
        models["Rainbow, torch eager"] = Rainbow(
            "MlpPolicy", StubEnv(), cpu_kernels=False, **settings
        )
        models["Rainbow, torch.compile"] = Rainbow(
            "MlpPolicy", StubEnv(), cpu_kernels=False, compile=True, **settings
        )
    for model in models.values():
        if capacity == CAPACITY:
            _fill(model.replay_buffer)
        model.learn(100)
    return models


def _seconds(action: Callable[[], Any]) -> tuple[float, float]:
    """CPU and wall seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    action()
    return time.process_time() - cpu, time.perf_counter() - wall


def _train(model: Any, n_updates: int) -> None:
    for _ in range(n_updates):
        model.train(1, BATCH_SIZE)


def measure_updates(models: dict[str, Any], n_steps: int, rounds: int) -> dict[str, dict[str, Any]]:
    """Updates per second of ``learn``, and of ``train`` alone: medians over rounds in turns."""
    kinds = ("learn_cpu", "learn_wall", "train_cpu")
    rates: dict[str, dict[str, list[float]]] = {
        name: {kind: [] for kind in kinds} for name in models
    }
    for _ in range(rounds):
        for name, model in models.items():
            cpu, wall = _seconds(partial(model.learn, n_steps, reset_num_timesteps=False))
            rates[name]["learn_cpu"].append(n_steps / cpu)
            rates[name]["learn_wall"].append(n_steps / wall)
            cpu, _ = _seconds(partial(_train, model, n_steps))
            rates[name]["train_cpu"].append(n_steps / cpu)
    return {
        name: {kind: statistics.median(values) for kind, values in found.items()}
        for name, found in rates.items()
    }


def measure_replay(rounds: int, n_calls: int = 2000) -> dict[str, float]:
    """Microseconds to draw 64 of 1e6 and set their priorities, alone and with the transitions."""
    from sb3_rainbow import PrioritizedReplayBuffer

    env = StubEnv()
    buffer = PrioritizedReplayBuffer(
        CAPACITY, env.observation_space, env.action_space, device="cpu", n_steps=3
    )
    _fill(buffer)
    losses = np.random.default_rng(0).uniform(0.5, 2.0, BATCH_SIZE)

    def priorities() -> None:
        for _ in range(n_calls):
            buffer.update_priorities(buffer.tree.sample(BATCH_SIZE), losses)

    def transitions() -> None:
        for _ in range(n_calls):
            buffer.sample(BATCH_SIZE)

    priorities()
    transitions()
    return {
        "sample_and_update_us": 1e6
        * statistics.median(_seconds(priorities)[0] / n_calls for _ in range(rounds)),
        "sample_transitions_us": 1e6
        * statistics.median(_seconds(transitions)[0] / n_calls for _ in range(rounds)),
    }


_RESIDENT = """
import numpy as np
from benchmarks.speed_rainbow import CAPACITY, StubEnv, _fill
from sb3_rainbow import PrioritizedReplayBuffer
env = StubEnv()
def resident():
    lines = open("/proc/self/status").read().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1e3
n = 1000
def make():
    buffer = PrioritizedReplayBuffer(CAPACITY, env.observation_space, env.action_space, n_envs=n)
    obs, zeros, masks = np.zeros((n, 12), np.float32), np.zeros(n), np.ones((n, 12), bool)
    for i in range(CAPACITY // n):
        buffer.add(obs, obs, zeros, zeros, zeros, [{}] * n, masks)
    return buffer
before = resident()
buffer = make()
assert buffer.full
print(resident() - before)
"""


def measure_memory() -> float | None:
    """Megabytes that 1e6 transitions with masks occupy in a fresh process; None off Linux."""
    if not Path("/proc/self/status").exists():
        return None
    done = subprocess.run(
        [sys.executable, "-c", _RESIDENT], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def report(found: dict[str, Any]) -> str:
    """The measurements as Markdown."""
    baseline = found["updates"]["SB3 DQN"]
    lines = [
        "# Speed of Rainbow",
        "",
        f"Command: `{found['command']}`. {found['machine']['machine']['processor']}, one core, "
        f"load {found['load']:.1f}, commit {found['machine']['commit'][:10]}, "
        + ", ".join(f"{k} {v}" for k, v in found["machine"]["versions"].items())
        + ".",
        "",
        "Updates per second: median of "
        f"{found['rounds']} rounds of {found['steps']} steps, the methods in turns.",
        "",
        "| method | per CPU second, one env step each | ratio | per wall second | update alone |",
        "|---|---|---|---|---|",
    ]
    for name, rates in found["updates"].items():
        ratio = rates["learn_cpu"] / baseline["learn_cpu"]
        lines.append(
            f"| {name} | {rates['learn_cpu']:.0f} | {ratio:.2f} | {rates['learn_wall']:.0f} "
            f"| {rates['train_cpu']:.0f} |"
        )
    replay, memory = found["replay"], found["memory_mb"]
    lines += [
        "",
        f"Drawing 64 of 1e6 and setting their priorities: {replay['sample_and_update_us']:.1f} us; "
        f"drawing with the transitions: {replay['sample_transitions_us']:.1f} us.",
        "",
        "Resident memory of 1e6 transitions of 12 floats with 12-action masks: "
        + ("not measured here." if memory is None else f"{memory:.0f} MB."),
        "",
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Measure, print, and write ``speed/rainbow.json`` and ``.md`` below the results folder."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks speed rainbow", description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--steps", type=int, default=1000, help="steps per round and method")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true", help="only the default path")
    arguments = parser.parse_args(argv)
    if os.environ.get("OMP_NUM_THREADS") != "1":
        # The BLAS libraries count their threads when they are loaded, which is too late now.
        command = [sys.executable, "-m", "benchmarks.speed_rainbow", *(argv or [])]
        return subprocess.call(command, env={**os.environ, "OMP_NUM_THREADS": "1"})

    import torch as th

    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        models = make_models(not arguments.no_compile)
        updates = measured("updates", measure_updates, models, arguments.steps, arguments.rounds)
    finally:
        th.set_num_threads(threads)
    found = {
        **provenance("rainbow", argv),
        "rounds": arguments.rounds,
        "steps": arguments.steps,
        "updates": updates,
        "replay": measured("replay", measure_replay, arguments.rounds),
        "memory_mb": measured("memory", measure_memory),
    }
    write(arguments.results, "rainbow", found, report(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
