"""How fast Rainbow is: beside DQN of SB3 and of SBX, and sb3-contrib's QR-DQN, on one core.

"Rainbow" is the default (compiled kernels for a perceptron on the CPU), beside what torch makes of
the same update. Three nets, 51 atoms, 12 observations, 12 actions, batch 64, a full replay buffer
of 1e6, one update per step of an env that costs next to nothing. SBX's DQN, which computes with
JAX, takes part where ``sbx-rl`` is installed; the package does not ask for it. The
methods take turns, so that whatever else the machine does falls on all of them; CPU seconds of the
process are reported beside wall seconds. On images: random frames, 4 x 84 x 84, batch 32.
"""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, source
from benchmarks.studies.speed.timing import (
    in_turns,
    learner,
    measure_updates,
    options,
    resident_mb,
)

N_INPUTS: Final = 12
N_ACTIONS: Final = 12
BATCH_SIZE: Final = 64
CAPACITY: Final = 1_000_000
EPISODE: Final = 100
REWARD: Final = 0.1
BASELINE: Final = "SB3 DQN"
QUANTILES: Final = "sb3-contrib QR-DQN"
JAX: Final = "SBX DQN"
#: parts that measure updates, and their hidden layers; the first has the paper's
NETS: Final = {"updates": [256, 128, 64], "updates_64": [64, 64], "updates_256": [256, 256]}
IMAGES: Final = (4, 84, 84)
# least ratio of the first to the baseline that the project asks for
TARGETS: Final = {"Rainbow": 1.5, "Rainbow, torch eager": 0.75}
IMAGE_TARGET: Final = 0.9
_KINDS: Final = ("learn_cpu", "learn_wall", "train_cpu")
_HEADER: Final = "method | per CPU second, steps included | ratio | per wall second | update alone"


class StubEnv(gym.Env[NDArray[Any], np.int64]):
    """A hundred random observations, episodes of as many steps: only the learner's time counts."""

    def __init__(self, shape: tuple[int, ...] = (N_INPUTS,)) -> None:
        rng = np.random.default_rng(0)
        if len(shape) > 1:
            self.observation_space: spaces.Box = spaces.Box(0, 255, shape, np.uint8)
            self._seen = rng.integers(0, 256, (EPISODE, *shape), np.uint8)
        else:
            self.observation_space = spaces.Box(0.0, 1.0, shape, np.float32)
            self._seen = rng.random((EPISODE, *shape), dtype=np.float32)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._time = 0

    def reset(self, **_: Any) -> tuple[NDArray[Any], dict[str, Any]]:
        """The first observation."""
        self._time = 0
        return self._seen[0], {}

    def step(self, action: np.int64) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """The next observation, the same reward always."""
        self._time += 1
        return self._seen[self._time % EPISODE], REWARD, False, self._time >= EPISODE, {}


def fill(buffer: Any) -> None:
    """Make a replay buffer full, without a million calls of ``add``."""
    capacity, rng = buffer.observations.shape[0], np.random.default_rng(0)
    buffer.observations[:, 0] = rng.random((capacity, N_INPUTS), dtype=np.float32)
    if hasattr(buffer, "next_observations"):
        buffer.next_observations[:, 0] = rng.random((capacity, N_INPUTS), dtype=np.float32)
    buffer.actions[:, 0, 0] = rng.integers(0, N_ACTIONS, capacity)
    buffer.rewards[:] = REWARD
    buffer.full = True
    if hasattr(buffer, "tree"):
        buffer.tree.set(np.arange(capacity), rng.uniform(0.5, 2.0, capacity))


def sbx_dqn() -> Any | None:
    """SBX's DQN, on one thread, or None where it is not installed."""
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    )
    try:
        return importlib.import_module("sbx").DQN
    except ImportError:
        return None


def make_models(
    capacity: int = CAPACITY, net_arch: Sequence[int] = NETS["updates"]
) -> dict[str, Any]:
    """The methods by name, trained for a moment, so that kernels are compiled, buffers full."""
    from sb3_contrib import QRDQN
    from stable_baselines3 import DQN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        **{"train_freq": 1, "gradient_steps": 1, "batch_size": BATCH_SIZE, "learning_starts": 50},
        **{"buffer_size": capacity, "device": "cpu", "seed": 0},
    }
    net = {"net_arch": list(net_arch)}
    variants: dict[str, dict[str, Any]] = {
        "Rainbow": {},
        "Rainbow, categorical": {"distributional": "categorical"},
        "Rainbow, torch eager": {"cpu_kernels": False},
    }
    quantiles = {**net, "n_quantiles": 51}
    models: dict[str, Any] = {
        BASELINE: DQN("MlpPolicy", StubEnv(), policy_kwargs=net, **settings),
        QUANTILES: QRDQN("MlpPolicy", StubEnv(), policy_kwargs=quantiles, **settings),
    }
    if (sbx := sbx_dqn()) is not None:
        models[JAX] = sbx("MlpPolicy", StubEnv(), policy_kwargs=net, **settings)
    for name, arguments in variants.items():
        models[name] = Rainbow("MlpPolicy", StubEnv(), policy_kwargs=net, **settings, **arguments)
    for model in models.values():
        fill(model.replay_buffer)
        model.learn(100)
    return models


def make_image_models() -> dict[str, Any]:
    """The same on images, with DQN's own convolutions."""
    from sb3_contrib import QRDQN
    from stable_baselines3 import DQN
    from stable_baselines3.common.torch_layers import NatureCNN

    from sb3_rainbow import Rainbow

    settings: dict[str, Any] = {
        **{"train_freq": 1, "gradient_steps": 1, "batch_size": 32, "learning_starts": 50},
        **{"buffer_size": 2_000, "device": "cpu", "seed": 0},
    }
    same, quantiles = {"features_extractor_class": NatureCNN}, {"n_quantiles": 51}
    models: dict[str, Any] = {
        BASELINE: DQN("CnnPolicy", StubEnv(IMAGES), **settings),
        QUANTILES: QRDQN("CnnPolicy", StubEnv(IMAGES), policy_kwargs=quantiles, **settings),
        "Rainbow": Rainbow("CnnPolicy", StubEnv(IMAGES), policy_kwargs=same, **settings),
        "Rainbow, by default two streams of 512": Rainbow("CnnPolicy", StubEnv(IMAGES), **settings),
    }
    for model in models.values():
        model.learn(150)
    return models


def make_buffer(**arguments: Any) -> Any:
    """Rainbow's replay buffer for 1e6 transitions, empty."""
    from sb3_rainbow import PrioritizedReplayBuffer

    env = StubEnv()
    both = env.observation_space, env.action_space
    return PrioritizedReplayBuffer(CAPACITY, *both, device="cpu", **arguments)


def measure_replay(rounds: int, n_calls: int = 2000) -> dict[str, float]:
    """Microseconds to draw 64 of 1e6 and set their priorities, alone and with the transitions."""
    buffer = make_buffer(n_steps=3)
    fill(buffer)
    losses = np.random.default_rng(0).uniform(0.5, 2.0, BATCH_SIZE)
    actions: dict[str, Callable[[], Any]] = {
        "sample_and_update_us": lambda: buffer.update_priorities(
            buffer.tree.sample(BATCH_SIZE), losses
        ),
        "sample_transitions_us": partial(buffer.sample, BATCH_SIZE),
    }
    return in_turns(actions, rounds, n_calls, unit=1e-6)


def measure_memory() -> float:
    """Megabytes that 1e6 transitions with masks occupy in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_buffer_mb).result()


def _buffer_mb(n_envs: int = 1000) -> float:
    obs, zeros = np.zeros((n_envs, N_INPUTS), np.float32), np.zeros(n_envs)
    masks = np.ones((n_envs, N_ACTIONS), bool)
    row: tuple[Any, ...] = (obs, obs, zeros, zeros, zeros, [{}] * n_envs, masks)
    make_buffer(n_envs=n_envs).add(*row)  # the kernels' memory is not the buffer's
    before = resident_mb()
    buffer = make_buffer(n_envs=n_envs)
    while not buffer.full:
        buffer.add(*row)
    return resident_mb() - before


class SpeedRainbow(Measured):
    """Updates per second, replay, memory."""

    name, file = "speed-rainbow", "speed/rainbow.json"
    options = options(steps=1000, rounds=5)

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        threadpool_limits(1)

    def measures(self) -> Mapping[str, Part]:
        steps, rounds = self.given.steps, self.given.rounds

        def updates(models: dict[str, Any], batch_size: int, n: int) -> dict[str, Any]:
            players = {name: learner(model, batch_size) for name, model in models.items()}
            return measure_updates(players, n, rounds)

        def of_net(net: list[int]) -> Part:
            return lambda _: updates(make_models(net_arch=net), BATCH_SIZE, steps)

        return {
            **{part: of_net(net) for part, net in NETS.items()},
            "images": lambda _: updates(make_image_models(), 32, max(1, steps // 10)),
            "replay": lambda _: measure_replay(rounds),
            "memory_mb": lambda _: measure_memory(),
        }

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        parts, asked = result["parts"], result["asked"]
        nets = {part: f" of {net}" for part, net in NETS.items() if part in parts}
        goals = [
            [f"{name}{where}", *_ratios(parts[part], name, whom), goal]
            for part, where, name, whom, goal in [
                *((part, net, name, BASELINE, f"{goal:g}")
                  for part, net in nets.items() for name, goal in TARGETS.items()),
                *((part, net, "Rainbow", JAX, f"{TARGETS['Rainbow']:g}")
                  for part, net in nets.items()),
                ("images", " on images", "Rainbow", BASELINE, f"{IMAGE_TARGET:g}"),
            ]
            if {name, whom} <= parts[part].keys()
        ]  # fmt: skip
        shown = [
            plain(f"Updates per second{net}", _HEADER, _rates(parts[part]))
            for part, net in nets.items()
        ]
        shown += [
            plain("Updates per second on images", _HEADER, _rates(parts["images"])),
            plain("Ratios", "of | to | per step | update alone | target", goals),
        ]
        if not any(JAX in parts[part] for part in nets):
            shown.append(f"{JAX} was not measured: `sbx-rl` was not installed.")
        replay = parts["replay"]
        return "\n\n".join([
            *shown,
            f"Drawing 64 of 1e6 and setting their priorities: {replay['sample_and_update_us']:.1f} "
            f"us; drawing with the transitions: {replay['sample_transitions_us']:.1f} us. Resident "
            f"memory of 1e6 transitions with 12-action masks: {parts['memory_mb']:.0f} MB.",
            source(result, f"; medians over {asked['rounds']} rounds of {asked['steps']} steps"),
        ])  # fmt: skip


def _ratios(rates: dict[str, dict[str, float]], name: str, whom: str) -> list[str]:
    """Whom a method is compared with, and the ratios of its rates to theirs."""
    kinds = ("learn_cpu", "train_cpu")
    return [whom, *(f"{rates[name][kind] / rates[whom][kind]:.2f}" for kind in kinds)]


def _rates(updates: dict[str, dict[str, float]]) -> Iterator[list[str]]:
    """Rows: method, its rate, the rate over the baseline's, more rates."""
    first, *more = _KINDS
    for name, rates in updates.items():
        ratio = rates[first] / updates[BASELINE][first]
        yield [name, f"{rates[first]:.0f}", f"{ratio:.2f}", *(f"{rates[k]:.0f}" for k in more)]
