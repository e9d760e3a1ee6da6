"""How fast Rainbow is: beside SB3's DQN and sb3-contrib's QR-DQN, on one core, in turns.

"Rainbow" is the default (compiled kernels for a perceptron on the CPU), beside what torch makes of
the same update, eager and compiled.

Net 256-128-64, 51 atoms, 12 observations, 12 actions, batch 64, a full replay buffer of 1e6, one
update per step of an env that costs next to nothing. The methods take turns, so that whatever else
the machine does falls on all of them; CPU seconds of the process are reported beside wall seconds.
With `--device cuda`: the same on the GPU, eager and compiled, at several batch sizes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, Final

import numpy as np

from benchmarks.errors import BenchmarkError
from benchmarks.studies.speed import images, report
from benchmarks.studies.speed import setting as at
from benchmarks.studies.speed.setting import (
    BATCH_SIZE,
    CAPACITY,
    StubEnv,
    measure_updates,
    ours,
)

BASELINE: Final = images.BASELINE
CUDA_BATCH_SIZES: Final = (32, 256, 2048)
# Least ratio of the first to the second that the project asks for
TARGETS: Final = {
    ("Rainbow", BASELINE): 1.5,
    ("Rainbow, torch eager", BASELINE): 0.75,
    ("Rainbow, torch.compile", BASELINE): 1.1,
}

_KINDS: Final = ("learn_cpu", "learn_wall", "train_cpu")
_HEADER: Final = "method | per CPU second, steps included | ratio | per wall second | update alone"


def fill(buffer: Any) -> None:
    """Make a replay buffer full, without a million calls of ``add``."""
    capacity = buffer.observations.shape[0]
    contents = at.random_contents(capacity)
    buffer.observations[:, 0] = contents["obs"]
    if hasattr(buffer, "next_observations"):
        buffer.next_observations[:, 0] = contents["next_obs"]
    buffer.actions[:, 0, 0] = contents["action"]
    buffer.rewards[:] = at.REWARD
    buffer.full = True
    if hasattr(buffer, "tree"):
        buffer.tree.set(np.arange(capacity), contents["priority"])


def make_models(
    with_compiled: bool, capacity: int, batch_size: int = BATCH_SIZE, device: str = "cpu"
) -> dict[str, Any]:
    """The methods by name, trained for a moment (compiled where they compile), buffers full."""
    from sb3_contrib import QRDQN
    from stable_baselines3 import DQN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        "train_freq": 1,
        "gradient_steps": 1,
        "batch_size": batch_size,
        "learning_starts": 50,
        "buffer_size": capacity,
        "policy_kwargs": {"net_arch": list(at.NET_ARCH)},
        "device": device,
        "seed": 0,
    }
    variants: dict[str, dict[str, Any]] = {
        "Rainbow": {},
        "Rainbow, categorical": {"distributional": "categorical"},
    }
    if with_compiled:
        if device == "cpu":
            variants["Rainbow, torch eager"] = {"cpu_kernels": False}
        variants["Rainbow, torch.compile"] = {"cpu_kernels": False, "compile": True}
    models: dict[str, Any] = {BASELINE: DQN("MlpPolicy", StubEnv(), **settings)}
    quantiles = {**settings["policy_kwargs"], "n_quantiles": 51}
    models[images.QUANTILES] = QRDQN(
        "MlpPolicy", StubEnv(), **{**settings, "policy_kwargs": quantiles}
    )
    for name, arguments in variants.items():
        models[name] = Rainbow("MlpPolicy", StubEnv(), **settings, **arguments)
    for model in models.values():
        fill(model.replay_buffer)
        model.learn(100)
    return models


def make_buffer(**arguments: Any) -> Any:
    """Rainbow's replay buffer for 1e6 transitions, empty."""
    from sb3_rainbow import PrioritizedReplayBuffer

    env = StubEnv()
    spaces = env.observation_space, env.action_space
    return PrioritizedReplayBuffer(CAPACITY, *spaces, device="cpu", **arguments)


def measure_replay(rounds: int, n_calls: int = 2000) -> dict[str, float]:
    """Microseconds to draw 64 of 1e6 and set their priorities, alone and with the transitions."""
    buffer = make_buffer(n_steps=3)
    fill(buffer)
    losses = np.random.default_rng(0).uniform(0.5, 2.0, BATCH_SIZE)

    def priorities() -> None:
        buffer.update_priorities(buffer.tree.sample(BATCH_SIZE), losses)

    actions: dict[str, Callable[[], Any]] = {
        "sample_and_update_us": priorities,
        "sample_transitions_us": partial(buffer.sample, BATCH_SIZE),
    }
    return report.in_turns(actions, rounds, n_calls, unit=1e-6)


def measure_memory() -> float:
    """Megabytes that 1e6 transitions with masks occupy in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_buffer_mb).result()


def _buffer_mb(n_envs: int = 1000) -> float:
    obs, zeros = np.zeros((n_envs, at.N_INPUTS), np.float32), np.zeros(n_envs)
    masks = np.ones((n_envs, at.N_ACTIONS), bool)
    row: tuple[Any, ...] = (obs, obs, zeros, zeros, zeros, [{}] * n_envs, masks)
    make_buffer(n_envs=n_envs).add(*row)  # the kernels' memory is not the buffer's
    before = report.resident_mb()
    buffer = make_buffer(n_envs=n_envs)
    while not buffer.full:
        buffer.add(*row)
    return report.resident_mb() - before


def tell(found: dict[str, Any]) -> str:
    """The measurements on the CPU as Markdown."""
    updates, replay = found["updates"], found["replay"]
    of_images = [
        f"On images, {images.SETTINGS[setting]}:\n\n"
        + report.table("Updates per second", _HEADER, _rates(rates, *_KINDS))
        for setting, rates in found["images"].items()
    ]
    goals = []
    compared = [(updates, "", pair, goal) for pair, goal in TARGETS.items()] + [
        (found["images"].get(setting, {}), f" on {setting}", ("Rainbow", BASELINE), goal)
        for setting, goal in images.TARGETS.items()
    ]
    for rates, where, (one, other), goal in compared:
        if one in rates and other in rates:
            ratios = (rates[one][k] / rates[other][k] for k in ("learn_cpu", "train_cpu"))
            goals.append([one + where, other, *(f"{r:.2f}" for r in ratios), f"{goal:g}"])
    shown = _rates(updates, *_KINDS)
    texts = [
        report.table("Updates per second", _HEADER, shown),
        report.table("Ratios", "of | to | per step | update alone | target", goals),
        *of_images,
    ]
    texts += [
        f"Drawing 64 of 1e6 and setting their priorities: {replay['sample_and_update_us']:.1f} us; "
        f"drawing with the transitions: {replay['sample_transitions_us']:.1f} us.",
        "Resident memory of 1e6 transitions of 12 floats with 12-action masks: "
        f"{found['memory_mb']:.0f} MB.",
    ]
    return report.page("Speed of Rainbow", found, "one core", *texts)


def tell_cuda(found: dict[str, Any]) -> str:
    """The measurements on a GPU as Markdown."""
    rows = [
        [batch_size, *row]
        for batch_size, updates in found["updates"].items()
        for row in _rates(updates, "learn_wall", "train_wall")
    ]
    header = "batch | method | per second, one env step each | ratio | update alone"
    updates = report.table("Updates per second", header, rows)
    return report.page("Speed of Rainbow on a GPU", found, found["gpu"], updates)


def _rates(updates: dict[str, dict[str, float]], kind: str, *more: str) -> Iterator[list[str]]:
    """Rows: method, its rate, the rate over the baseline's, more rates."""
    for name, rates in updates.items():
        ratio = rates[kind] / updates[BASELINE][kind]
        yield [name, f"{rates[kind]:.0f}", f"{ratio:.2f}", *(f"{rates[k]:.0f}" for k in more)]


def measure_cpu(arguments: argparse.Namespace, capacity: int = CAPACITY) -> dict[str, Any]:
    """All that is measured on the CPU."""
    measured, size = report.measured, (arguments.steps, arguments.rounds)
    models = make_models(not arguments.no_compile, capacity)
    contestants = {name: ours(model, BATCH_SIZE) for name, model in models.items()}
    return {
        "updates": measured("updates", measure_updates, contestants, *size),
        "replay": measured("replay", measure_replay, size[1]),
        "memory_mb": measured("memory", measure_memory),
        "images": measured("images", images.measure, *size),
    }


def measure_cuda(
    arguments: argparse.Namespace, capacity: int = CAPACITY, device: str = "cuda"
) -> dict[str, Any]:
    """Updates per second on the GPU at several batch sizes."""
    import torch as th

    updates = {}
    for batch_size in CUDA_BATCH_SIZES:
        models = make_models(not arguments.no_compile, capacity, batch_size, device)
        contestants = {name: ours(model, batch_size) for name, model in models.items()}
        updates[str(batch_size)] = measure_updates(contestants, arguments.steps, arguments.rounds)
    gpu = th.cuda.get_device_name() if device == "cuda" else device
    return {"updates": updates, "gpu": gpu}


def main(argv: list[str]) -> int:
    """Measure, print, and write ``speed/rainbow.json`` and ``.md`` below the results folder."""
    words = report.parser("rainbow", __doc__, steps=1000, rounds=5)
    words.add_argument("--no-compile", action="store_true", help="only the default path")
    words.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    arguments = words.parse_args(argv)
    if os.environ.get("OMP_NUM_THREADS") != "1":
        # The BLAS libraries count their threads when they are loaded, which is too late now.
        command = [sys.executable, "-m", "benchmarks", "speed", "rainbow", *argv]
        return subprocess.call(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    import torch as th

    on_cpu = arguments.device == "cpu"
    if not (on_cpu or th.cuda.is_available()):
        raise BenchmarkError("--device cuda: torch finds no CUDA device here; use --device cpu")
    found = report.provenance("rainbow", argv, arguments)
    found |= measure_cpu(arguments) if on_cpu else measure_cuda(arguments)
    text = tell(found) if on_cpu else tell_cuda(found)
    report.write(arguments.results, "rainbow" if on_cpu else "rainbow_cuda", found, text)
    return 0
