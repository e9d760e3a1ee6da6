"""How fast the environment is, and how fast Rainbow is.

`speed-env`: single and batched steps with their action masks, and the exact optimum.

`speed-rainbow`: beside DQN of SB3, of SBX where ``sbx-rl`` is installed, and sb3-contrib's QR-DQN.
"Rainbow" is the default (compiled kernels for a perceptron on the CPU); beside it stands the same
update in plain torch. Three nets, 51 atoms, batch 64, a full replay buffer of 1e6, one update per
step of an env that costs next to nothing. On images: random frames, 4 x 84 x 84, batch 32.

All take turns on one core, so that other load falls on all alike; a figure is the process's CPU
time in the median round.
"""

import argparse
import importlib
import math
import os
import statistics
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv
from threadpoolctl import threadpool_limits

from benchmarks.methods.oracle import LatticeOracle
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Option, Part, Tick, count, source
from coop_env.env import CoopInsertionEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv
from sb3_rainbow import Rainbow

Name = TypeVar("Name", bound=Hashable)

SINGLE: Final = "single, gymnasium.make, Python loop"
OPTIMA: Final = ("optimized", "initial")  # geometries on which the optimum is measured
N_INPUTS: Final = 12
N_ACTIONS: Final = 12
BATCH_SIZE: Final = 64
CAPACITY: Final = 1_000_000
EPISODE: Final = 100
REWARD: Final = 0.1
BASELINE: Final = "SB3 DQN"
JAX: Final = "SBX DQN"
#: parts that measure updates, and their hidden layers; the first has the paper's
NETS: Final = {"updates": [256, 128, 64], "updates_64": [64, 64], "updates_256": [256, 256]}
IMAGES: Final = (4, 84, 84)
# least ratio of the first to the baseline that the project asks for
TARGETS: Final = {"Rainbow": 1.5, "Rainbow, torch eager": 0.75}
IMAGE_TARGET: Final = 0.9
#: rates of updates with the steps of the env between them, and alone
KINDS: Final = ("learn_cpu", "train_cpu")


def seconds_of(action: Callable[[], Any]) -> float:
    """CPU seconds of a call."""
    began = time.process_time()
    action()
    return time.process_time() - began


def in_turns(actions: Mapping[Name, Callable[[], Any]], rounds: int) -> dict[Name, float]:
    """CPU seconds of each call: medians over rounds in turns; the first round is not counted."""
    times: dict[Name, list[float]] = {name: [] for name in actions}
    for _ in range(rounds + 1):
        for name, action in actions.items():
            times[name].append(seconds_of(action))
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def stepping(env: Any, actions: Iterable[Any], masks: bool = False) -> Callable[[], None]:
    """A loop over ``actions``; with ``masks`` the action masks are read after each step."""
    single = not hasattr(env, "num_envs")
    env.reset(**{"seed": 0} if single else {})
    look: Callable[[], Any] = bool
    if masks:
        look = env.unwrapped.action_masks if single else partial(env.env_method, "action_masks")

    def loop() -> None:
        for action in actions:
            _, _, *over, _ = env.step(action)
            look()
            if single and any(over):
                env.reset()

    return loop


def options(steps: int, rounds: int) -> dict[str, Option]:
    """How long each measurement takes."""
    return {
        "--steps": count(steps, "steps per round and method"),
        "--rounds": count(rounds, "rounds, of which the median"),
    }


def measure_steps(steps: int, rounds: int, _: Tick) -> dict[str, float]:
    """Microseconds a step, median over rounds in turns."""
    envs: dict[str, Any] = {
        SINGLE: gym.make("CoopInsertion-v0"),
        "single, without Gymnasium's wrappers": CoopInsertionEnv(),
        "SB3 DummyVecEnv of 64": DummyVecEnv([CoopInsertionEnv] * 64),
        **{f"batch of {n}": CoopInsertionVecEnv(n, seed=0) for n in (1, 8, 64, 256)},
    }
    loops, made = {}, {}
    for name, env in envs.items():
        width = [env.num_envs] if hasattr(env, "num_envs") else []
        size = (max(1, steps // math.prod(width)), *width)
        actions = np.random.default_rng(0).integers(N_ACTIONS, size=size)
        loops[name], made[name] = stepping(env, actions, masks=True), actions.size
    return {name: 1e6 * each / made[name] for name, each in in_turns(loops, rounds).items()}


def measure_oracle(starts: int, geometry: str, _: Tick) -> dict[str, float]:
    """CPU seconds, feasible share and mean length of the exact optimum over the first seeds."""
    env, oracle, plans = CoopInsertionEnv(geometry=geometry), LatticeOracle(), []

    def plan() -> None:
        for seed in range(starts):
            env.reset(seed=seed)
            plans.append(oracle.plan(env))

    env.reset(seed=0)
    oracle.plan(env)  # its kernels compile
    seconds = seconds_of(plan)
    lengths = [len(plan.moves) for plan in plans if plan.moves is not None]
    feasible, mean = len(lengths) / starts, float(np.mean(lengths))
    return {"seconds": seconds, "feasible": feasible, "mean_moves": mean}


class SpeedEnv(Measured):
    """Steps with their masks, and the exact optimum."""

    name, file = "speed-env", "speed/env.json"
    options = {  # noqa: RUF012
        **options(steps=12_800, rounds=9),
        "--starts": count(500, "starts of the exact optimum"),
    }

    def measures(self) -> dict[str, Part]:
        given = self.given
        return {
            "steps": partial(measure_steps, given.steps, given.rounds),
            **{f"optimum, {name}": partial(measure_oracle, given.starts, name) for name in OPTIMA},
        }

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        us = result["parts"]["steps"]
        rows = [[k, f"{v:.2f}", f"{1e6 / v:,.0f}", f"{us[SINGLE] / v:.2f}"] for k, v in us.items()]
        head = "method | us a step | steps/s | ratio to the single loop"
        steps = plain("A step with its action masks, CPU time", head, rows)
        rows = []
        for name in OPTIMA:
            row = result["parts"][f"optimum, {name}"]
            shown = [f"{100 * row['feasible']:.1f} %", f"{row['mean_moves']:.1f}"]
            rows.append([name, *shown, f"{row['seconds']:.1f}"])
        head = "geometry | feasible | mean moves or ticks | CPU s"
        optimum = plain(f"Exact optimum over {result['asked']['starts']} starts", head, rows)
        return "\n\n".join([steps, optimum, _source(result)])


def _source(result: dict[str, Any]) -> str:
    asked = result["asked"]
    return source(result, f"; medians over {asked['rounds']} rounds of {asked['steps']} steps")


class StubEnv(gym.Env[NDArray[Any], np.int64]):
    """A hundred random observations, one episode, repeated: only the learner's time counts."""

    def __init__(self, shape: tuple[int, ...] = (N_INPUTS,)) -> None:
        rng, shown = np.random.default_rng(0), (EPISODE, *shape)
        if len(shape) > 1:
            self.observation_space: spaces.Box = spaces.Box(0, 255, shape, np.uint8)
            self._seen = rng.integers(0, 256, shown, np.uint8)
        else:
            self.observation_space = spaces.Box(0.0, 1.0, shape, np.float32)
            self._seen = rng.random(shown, dtype=np.float32)
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
    for name in ("observations", "next_observations"):
        if hasattr(buffer, name):
            getattr(buffer, name)[:, 0] = rng.random((capacity, N_INPUTS), dtype=np.float32)
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


def make_models(net_arch: Sequence[int] | None, capacity: int = CAPACITY) -> dict[str, Any]:
    """The methods by name, trained briefly, so that kernels are compiled; buffers are full.

    Without layers they learn from images, with DQN's own convolutions and buffers not filled.
    """
    images = net_arch is None
    net: dict[str, Any] = {} if net_arch is None else {"net_arch": list(net_arch)}
    ours: dict[str, Any] = {"features_extractor_class": NatureCNN} if images else net
    variants: dict[str, dict[str, Any]] = {
        "Rainbow": {},
        "Rainbow, categorical": {"distributional": "categorical"},
        "Rainbow, torch eager": {"cpu_kernels": False},
    }
    if images:
        variants = {"Rainbow": {}, "Rainbow, by default two streams of 512": {"policy_kwargs": {}}}
    policy, shape = ("CnnPolicy", IMAGES) if images else ("MlpPolicy", (N_INPUTS,))
    settings: dict[str, Any] = {
        **{"train_freq": 1, "gradient_steps": 1, "learning_starts": 50, "device": "cpu", "seed": 0},
        "batch_size": 32 if images else BATCH_SIZE,
        "buffer_size": 2_000 if images else capacity,
    }

    def make(kind: Any, **arguments: Any) -> Any:
        model = kind(policy, StubEnv(shape), **{**settings, **arguments})
        if not images:
            fill(model.replay_buffer)
        return model.learn(60)

    sbx = None if images else sbx_dqn()
    return {
        BASELINE: make(DQN, policy_kwargs=net),
        "sb3-contrib QR-DQN": make(QRDQN, policy_kwargs={**net, "n_quantiles": 51}),
        **({} if sbx is None else {JAX: make(sbx, policy_kwargs=net)}),
        **{name: make(Rainbow, **{"policy_kwargs": ours, **v}) for name, v in variants.items()},
    }


def measure_updates(
    models: Mapping[str, Any], n_updates: int, rounds: int
) -> dict[str, dict[str, float]]:
    """Updates per CPU second of ``learn``, and of ``train`` alone: medians over rounds in turns."""

    def learn(model: Any) -> None:
        model.learn(n_updates * model.n_envs, reset_num_timesteps=False)

    def train(model: Any) -> None:
        for _ in range(n_updates):
            model.train(1, model.batch_size)

    acts = dict(zip(KINDS, (learn, train), strict=True))
    seconds = in_turns(
        {(name, kind): partial(acts[kind], models[name]) for name in models for kind in KINDS},
        rounds,
    )
    return {name: {kind: n_updates / seconds[name, kind] for kind in KINDS} for name in models}


class SpeedRainbow(Measured):
    """Updates per second."""

    name, file = "speed-rainbow", "speed/rainbow.json"
    options = options(steps=1000, rounds=5)

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        threadpool_limits(1)

    def measures(self) -> Mapping[str, Part]:
        steps, rounds = self.given.steps, self.given.rounds

        def updates(net: Sequence[int] | None, _: Tick) -> dict[str, Any]:
            n_updates = max(1, steps // 10) if net is None else steps
            return measure_updates(make_models(net), n_updates, rounds)

        return {
            **{part: partial(updates, net) for part, net in NETS.items()},
            "images": partial(updates, None),
        }

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        parts = result["parts"]
        nets = {part: f" of {net}" for part, net in NETS.items() if part in parts}
        pairs = [(net, name, BASELINE, goal) for net in nets for name, goal in TARGETS.items()]
        pairs += [(net, "Rainbow", JAX, TARGETS["Rainbow"]) for net in nets]
        pairs += [("images", "Rainbow", BASELINE, IMAGE_TARGET)]
        where = {**nets, "images": " on images"}
        goals = [
            [f"{name}{where[part]}", whom, *_ratios(parts[part], name, whom), f"{goal:g}"]
            for part, name, whom, goal in pairs
            if {name, whom} <= parts[part].keys()
        ]
        head = "method | steps included | ratio | update alone"
        shown = [plain(f"Updates per CPU second{where[k]}", head, _rates(parts[k])) for k in where]
        shown.append(plain("Ratios", "of | to | per step | update alone | target", goals))
        if not any(JAX in parts[part] for part in nets):
            shown.append(f"{JAX} was not measured: `sbx-rl` was not installed.")
        return "\n\n".join([*shown, _source(result)])


def _ratios(rates: dict[str, dict[str, float]], name: str, whom: str) -> list[str]:
    return [f"{rates[name][kind] / rates[whom][kind]:.2f}" for kind in KINDS]


def _rates(updates: dict[str, dict[str, float]]) -> Iterator[list[str]]:
    """Rows: method, its rate, the rate over the baseline's, the rate of updates alone."""
    for name, rates in updates.items():
        ratio = _ratios(updates, name, BASELINE)[0]
        yield [name, f"{rates['learn_cpu']:.0f}", ratio, f"{rates['train_cpu']:.0f}"]
