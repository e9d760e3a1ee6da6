"""One learner on one task: the same training and the same tests for all three methods."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
import time
from collections.abc import Callable
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from sb3_contrib import QRDQN, CrossQ
from stable_baselines3 import DQN, PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.presets import as_dict
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.protocol.strict import build
from benchmarks.runs import policy_file
from benchmarks.runs.checkpoint import RunCallback, Stateful, learn
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic.features import extractor_of
from benchmarks.studies.classic.playing import evaluate, make_env, test
from benchmarks.studies.classic.presets import (
    CONTACT,
    DISCRETE,
    Guide,
    SuiteCell,
    SuitePreset,
    Task,
    algorithm_of,
    spelled_out,
)
from sb3_rainbow import Rainbow

CLASSES: Final[dict[str, type[BaseAlgorithm]]] = {
    "rainbow": Rainbow, "dqn": DQN, "qrdqn": QRDQN,
    "sac": SAC, "crossq": CrossQ, "td3": TD3, "ppo": PPO,
}  # fmt: skip
LINEAR: Final = "lin_"  # rl-baselines3-zoo's word for a rate that falls to 0


def class_of(task: Task, method: str) -> type[BaseAlgorithm]:
    """The algorithm of a method on a task.

    Raises:
        BenchmarkError: it learns from a script alone, and the task has none.
    """
    algorithm = algorithm_of(method)
    if task.guide is not None and algorithm != "ppo":  # which has no memory to fill
        from benchmarks.studies.robots.guided import GUIDED

        if algorithm in GUIDED:
            return GUIDED[algorithm]
    if algorithm not in CLASSES:
        raise BenchmarkError(f"{task.title}: {method} learns from a script: give the task a guide")
    return CLASSES[algorithm]


def build_model(task: Task, method: str, seed: int) -> BaseAlgorithm:
    """The learner, untrained, with its training environments.

    Raises:
        BenchmarkError: a setting is unknown to the method's constructor.
    """
    arguments = copy.deepcopy(task.arguments_of(method))  # SB3 writes into policy_kwargs
    guide = task.guide
    if guide is not None and (own := arguments.pop("guide", {})):
        guide = build(Guide, {**as_dict(guide), **own}, f"{task.title}: {method}: guide")
    algorithm = class_of(task, method)
    if issubclass(algorithm, Rainbow) and not task.bare:
        arguments = spelled_out(arguments)
    accepted = inspect.signature(algorithm).parameters
    for name in arguments:
        if name not in accepted:
            raise BenchmarkError(
                f"{task.title}: {method} has no argument '{name}'; known: {known(accepted)}"
            )
    rate = arguments.get("learning_rate")
    if isinstance(rate, str):
        if not rate.startswith(LINEAR):
            raise BenchmarkError(
                f"{task.title}: {method}: learning_rate: expected a number or {LINEAR}<number>, "
                f"found '{rate}' (YAML wants a point in it: 1.0e-3)"
            )
        arguments["learning_rate"] = LinearSchedule(float(rate.removeprefix(LINEAR)), 0.0, 1.0)
    if arguments.get("replay_buffer_class") == "HerReplayBuffer":
        arguments["replay_buffer_class"] = HerReplayBuffer
    if (noise := arguments.get("action_noise")) is not None:
        size = make_env(task, discrete=False).action_space.shape
        assert size is not None
        arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, noise))
    if task.policy == "CnnPolicy":
        kwargs = dict(arguments.get("policy_kwargs", {}))
        kwargs.setdefault("features_extractor_class", extractor_of(task.env))
        arguments["policy_kwargs"] = kwargs
    discrete = algorithm_of(method) in DISCRETE

    def make_one() -> gym.Env[Any, Any]:
        return Monitor(make_env(task, discrete, training=True))

    env = DummyVecEnv([make_one] * task.n_envs)
    model = algorithm(
        task.policy,
        env,
        seed=derive("learner", seed),
        device="cpu",
        **arguments,
    )
    if guide is not None:
        from benchmarks.studies.robots.guided import Guided

        if isinstance(model, Guided):
            model.follow(guide)
    return model


TENSORBOARD: Final = {
    "eval/mean_reward": "return_mean",
    "eval/mean_ep_length": "length_mean",
    "rollout/ep_rew_mean": "training_return",
}
"""SB3's names of what a run's curve has, and its columns."""


class Tester(BaseCallback):
    """Tests the policy every so many steps, between two rounds of training."""

    def __init__(self, task: Task, seed: int) -> None:
        super().__init__()
        self.task = task
        self.seeds = episode_seeds(seed, task.eval_episodes, "validate")
        self.rows: list[dict[str, float]] = []
        self.seconds = 0.0
        self._next = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self.test()
            every = self.task.eval_every
            self._next = self.num_timesteps - self.num_timesteps % every + every

    def test(self) -> None:
        """Add a row to the curve: the greedy policy on the run's validation episodes."""
        began = time.perf_counter()
        model = self.model
        played = np.array(evaluate(model, self.task, self.seeds))
        training = [float(episode["r"]) for episode in model.ep_info_buffer or []]
        row = {
            "timesteps": model.num_timesteps,
            "updates": model._n_updates,
            "return_mean": float(played[:, 0].mean()),
            "return_std": float(played[:, 0].std()),
            "length_mean": float(played[:, 1].mean()),
            "training_return": float(np.mean(training)) if training else math.nan,
        }
        self.rows.append(row)
        for name, column in TENSORBOARD.items():
            if math.isfinite(row[column]):
                self.logger.record(name, row[column])
        self.logger.dump(model.num_timesteps)
        self.seconds += time.perf_counter() - began

    def get_state(self) -> tuple[Any, ...]:
        return self.rows, self._next, self.seconds

    def set_state(self, state: tuple[Any, ...]) -> None:
        self.rows, self._next, self.seconds = state


class _Envs:
    """Training environments in the midst of their episodes; a world of Box2D cannot be kept."""

    def __init__(self, model: BaseAlgorithm) -> None:
        env = model.get_env()
        assert isinstance(env, DummyVecEnv)
        self.env = env

    def get_state(self) -> bytes | None:
        if any(isinstance(env.unwrapped, gym.utils.EzPickle) for env in self.env.envs):
            return None  # it would be made anew from its arguments
        try:
            return pickle.dumps(list(self.env.envs))
        except (TypeError, AttributeError, pickle.PicklingError):
            return None

    def set_state(self, state: bytes) -> None:
        self.env.envs = pickle.loads(state)


def run_learner(
    preset: SuitePreset,
    cell: SuiteCell,
    folder: RunFolder,
    stop_requested: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Train a cell, from its newest checkpoint if there is one, and test its last policy.

    Writes ``curve.csv`` (validation during training) and ``episodes.csv`` (the final test, on
    seeds that neither training nor validation uses). Returns what meta.json says of the training,
    or None if it was stopped.
    """
    task, seed = preset.tasks[cell.task], cell.number
    fresh = build_model(task, cell.method, seed)
    tester, envs = Tester(task, seed), _Envs(fresh)
    kept: dict[str, Stateful] = {"envs": envs, "curve": tester}

    def note() -> str:
        return f"return {tester.rows[-1]['return_mean']:.1f}"

    seconds = preset.checkpoint_seconds
    callback = RunCallback(folder, kept, seconds, task.timesteps, stop_requested, note)
    discrete = isinstance(fresh.action_space, spaces.Discrete)
    algorithm = class_of(task, cell.method)
    logger = configure(str(folder.tensorboard), ["tensorboard"])
    model = learn(callback, algorithm, envs.env, lambda: fresh, [tester], logger)
    if model is None:
        return None
    tester.model = model
    tester.test()
    folder.write_rows("curve", tester.rows)
    began = time.perf_counter()
    if task.env == CONTACT:  # another study plays it
        policy_file.reduce_to_acting(model)
        policy_file.save(model, folder.policy)
    test(model, preset, cell, folder)
    if task.env == CONTACT:
        from benchmarks.studies.robots.trials import on_tests

        folder.write_rows("contact", on_tests(model, make_env(task, discrete)))
    return {
        **callback.summary(model),
        "evaluation_seconds": tester.seconds,
        "test_seconds": time.perf_counter() - began,
        "updates": model._n_updates,
        "seeds": {
            "learner": derive("learner", seed),
            "first_validation_episode": tester.seeds[0],
            "first_test_episode": episode_seeds(seed, 1)[0],
        },
    }
