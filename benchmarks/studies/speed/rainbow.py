"""How fast Rainbow is: beside SB3's DQN and other libraries' Rainbows, on one core, in turns.

"Rainbow" is the default (compiled kernels for a perceptron on the CPU), beside what torch makes of
the same update, eager and compiled; tianshou and AgileRL run in an environment of their own, which
`make rivals` builds.

Net 256-128-64, 51 atoms, 12 observations, 12 actions, batch 64, a full replay buffer of 1e6, one
update per step of an env that costs next to nothing. The methods take turns, so that whatever else
the machine does falls on all of them; CPU seconds of the process are reported beside wall seconds.
With `--device cuda`: SB3's DQN and Rainbow on the GPU, eager and compiled, at several batch sizes.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.errors import BenchmarkError
from benchmarks.studies.speed.contest import RIVALS, RIVALS_PYTHON, Ours, Rival, measure_updates
from benchmarks.studies.speed.parts import measure_parts
from benchmarks.studies.speed.report import measured, provenance, write
from benchmarks.studies.speed.setting import (
    BATCH_SIZE,
    CAPACITY,
    NET_ARCH,
    REWARD,
    Contestant,
    StubEnv,
    random_contents,
    seconds_of,
)

BASELINE: Final = "SB3 DQN"
CUDA_BATCH_SIZES: Final = (64, 512, 4096)
# Least ratio of the first to the second that the project asks for
TARGETS: Final = {
    ("Rainbow", BASELINE): 1.1,
    ("Rainbow, torch eager", BASELINE): 0.75,
    ("Rainbow, torch.compile", BASELINE): 1.1,
    **{("Rainbow", rival): 4.0 for rival in RIVALS},
}


def fill(buffer: Any) -> None:
    """Make a replay buffer full, without a million calls of ``add``."""
    capacity = buffer.observations.shape[0]
    contents = random_contents(capacity)
    buffer.observations[:, 0] = contents["obs"]
    if hasattr(buffer, "next_observations"):
        buffer.next_observations[:, 0] = contents["next_obs"]
    buffer.actions[:, 0, 0] = contents["action"]
    buffer.rewards[:] = REWARD
    buffer.full = True
    if hasattr(buffer, "tree"):
        buffer.tree.set(np.arange(capacity), contents["priority"])


def make_models(
    with_compiled: bool,
    capacity: int = CAPACITY,
    batch_size: int = BATCH_SIZE,
    device: str = "cpu",
) -> dict[str, Any]:
    """The methods by name, trained for a moment (compiled where they compile), buffers full."""
    from stable_baselines3 import DQN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        "train_freq": 1,
        "gradient_steps": 1,
        "batch_size": batch_size,
        "learning_starts": 50,
        "buffer_size": capacity,
        "policy_kwargs": {"net_arch": list(NET_ARCH)},
        "device": device,
        "seed": 0,
    }
    variants: dict[str, dict[str, Any]] = {"Rainbow": {}}
    if with_compiled:
        if device == "cpu":
            variants["Rainbow, torch eager"] = {"cpu_kernels": False}
        variants["Rainbow, torch.compile"] = {"cpu_kernels": False, "compile": True}
    models: dict[str, Any] = {BASELINE: DQN("MlpPolicy", StubEnv(), **settings)}
    for name, arguments in variants.items():
        models[name] = Rainbow("MlpPolicy", StubEnv(), **settings, **arguments)
    for model in models.values():
        fill(model.replay_buffer)
        model.learn(100)
    return models


def measure_replay(rounds: int, n_calls: int = 2000) -> dict[str, float]:
    """Microseconds to draw 64 of 1e6 and set their priorities, alone and with the transitions."""
    from sb3_rainbow import PrioritizedReplayBuffer

    env = StubEnv()
    buffer = PrioritizedReplayBuffer(
        CAPACITY, env.observation_space, env.action_space, device="cpu", n_steps=3
    )
    fill(buffer)
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
        * statistics.median(seconds_of(priorities).cpu / n_calls for _ in range(rounds)),
        "sample_transitions_us": 1e6
        * statistics.median(seconds_of(transitions).cpu / n_calls for _ in range(rounds)),
    }


_RESIDENT = """
import numpy as np
from benchmarks.studies.speed.setting import CAPACITY, StubEnv
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
    """The measurements on the CPU as Markdown."""
    updates = found["updates"]
    lines = [
        *_heading("# Speed of Rainbow", found, "one core"),
        "| method | per CPU second, one env step each | ratio | per wall second | update alone |",
        "|---|---|---|---|---|",
    ]
    for name, rates in updates.items():
        ratio = rates["learn_cpu"] / updates[BASELINE]["learn_cpu"]
        lines.append(
            f"| {name} | {rates['learn_cpu']:.0f} | {ratio:.2f} | {rates['learn_wall']:.0f} "
            f"| {rates['train_cpu']:.0f} |"
        )
    lines += ["", "| of | to | per step | update alone | target |", "|---|---|---|---|---|"]
    for (first, second), target in TARGETS.items():
        if first in updates and second in updates:
            step, alone = (
                updates[first][kind] / updates[second][kind] for kind in ("learn_cpu", "train_cpu")
            )
            lines.append(f"| {first} | {second} | {step:.2f} | {alone:.2f} | {target:g} |")
    for name, rival in found["rivals"].items():
        lines += [
            "",
            f"{name} {rival['version']}: {rival['net']}, {rival['parameters']} parameters.",
        ]
    if found["parts"]:
        lines += ["", *_parts_table(found["parts"])]
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


def _parts_table(parts: dict[str, dict[str, float]]) -> list[str]:
    names = list(dict.fromkeys(part for found in parts.values() for part in found))
    return [
        "One update in torch, microseconds of a core; parts timed one by one, in warm caches:",
        "",
        "| part | " + " | ".join(parts) + " |",
        "|---|" + "---|" * len(parts),
        *(
            f"| {name} | "
            + " | ".join(f"{found[name]:.0f}" if name in found else "" for found in parts.values())
            + " |"
            for name in names
        ),
    ]


def report_cuda(found: dict[str, Any]) -> str:
    """The measurements on a GPU as Markdown."""
    lines = [
        *_heading("# Speed of Rainbow on a GPU", found, found["gpu"]),
        "| batch | method | per second, one env step each | ratio | update alone |",
        "|---|---|---|---|---|",
    ]
    for batch_size, updates in found["updates"].items():
        for name, rates in updates.items():
            ratio = rates["learn_wall"] / updates[BASELINE]["learn_wall"]
            lines.append(
                f"| {batch_size} | {name} | {rates['learn_wall']:.0f} | {ratio:.2f} "
                f"| {rates['train_wall']:.0f} |"
            )
    return "\n".join([*lines, ""])


def _heading(title: str, found: dict[str, Any], where: str) -> list[str]:
    return [
        title,
        "",
        f"Command: `{found['command']}`. {found['machine']['machine']['processor']}, {where}, "
        f"load {found['load']:.1f}, commit {found['machine']['commit'][:10]}, "
        + ", ".join(f"{k} {v}" for k, v in found["machine"]["versions"].items())
        + ".",
        "",
        "Updates per second: median of "
        f"{found['rounds']} rounds of {found['steps']} steps, the methods in turns.",
        "",
    ]


def measure_cpu(arguments: argparse.Namespace, capacity: int = CAPACITY) -> dict[str, Any]:
    """All that is measured on the CPU."""
    import torch as th

    threads = th.get_num_threads()
    th.set_num_threads(1)
    rivals: dict[str, Rival] = {}
    try:
        with contextlib.ExitStack() as stack:
            if arguments.rivals.exists():
                for name in RIVALS:
                    rival = measured(f"{name} starts", Rival, name, capacity, arguments.rivals)
                    rivals[name] = stack.enter_context(rival)
            else:
                print(
                    f"{' and '.join(RIVALS)} are not measured: no {arguments.rivals}; "
                    "install them with: make rivals",
                    file=sys.stderr,
                )
            models = make_models(not arguments.no_compile, capacity)
            contestants: dict[str, Contestant] = {
                **{name: Ours(model, BATCH_SIZE) for name, model in models.items()},
                **rivals,
            }
            updates = measure_updates(contestants, arguments.steps, arguments.rounds)
            in_torch = {name: model for name, model in models.items() if "torch" in name}
            parts = (
                measured("parts", measure_parts, models[BASELINE], in_torch, arguments.rounds)
                if in_torch
                else {}
            )
    finally:
        th.set_num_threads(threads)
    return {
        "updates": updates,
        "parts": parts,
        "rivals": {
            name: {"version": r.version, "net": r.net, "parameters": r.parameters}
            for name, r in rivals.items()
        },
        "replay": measured("replay", measure_replay, arguments.rounds),
        "memory_mb": measured("memory", measure_memory),
    }


def measure_cuda(
    arguments: argparse.Namespace, capacity: int = CAPACITY, device: str = "cuda"
) -> dict[str, Any]:
    """Updates per second on the GPU at several batch sizes."""
    import torch as th

    updates = {}
    for batch_size in CUDA_BATCH_SIZES:
        models = make_models(not arguments.no_compile, capacity, batch_size, device)
        contestants = {name: Ours(model, batch_size) for name, model in models.items()}
        updates[str(batch_size)] = measure_updates(contestants, arguments.steps, arguments.rounds)
    return {
        "updates": updates,
        "gpu": th.cuda.get_device_name() if device == "cuda" else device,
    }


def main(argv: list[str] | None = None) -> int:
    """Measure, print, and write ``speed/rainbow.json`` and ``.md`` below the results folder."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks speed rainbow", description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--steps", type=int, default=1000, help="steps per round and method")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--no-compile", action="store_true", help="only the default path")
    parser.add_argument(
        "--rivals", type=Path, default=RIVALS_PYTHON, help="interpreter with tianshou and AgileRL"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    arguments = parser.parse_args(argv)
    if os.environ.get("OMP_NUM_THREADS") != "1":
        # The BLAS libraries count their threads when they are loaded, which is too late now.
        command = [sys.executable, "-m", "benchmarks.studies.speed.rainbow", *(argv or [])]
        return subprocess.call(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    found = {
        **provenance("rainbow", argv),
        "rounds": arguments.rounds,
        "steps": arguments.steps,
    }
    if arguments.device == "cpu":
        found.update(measure_cpu(arguments))
        write(arguments.results, "rainbow", found, report(found))
        return 0
    import torch as th

    if not th.cuda.is_available():
        raise BenchmarkError("--device cuda: torch finds no CUDA device here; use --device cpu")
    found.update(measure_cuda(arguments))
    write(arguments.results, "rainbow_cuda", found, report_cuda(found))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
