"""One learner on one public task: the same training and the same tests for all methods."""

from __future__ import annotations

import math
import pickle
import time
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.evaluation.evaluate import model_policy
from benchmarks.methods.learners import build_on, class_on
from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import CONTACT, SuitePreset, Task
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs import policy_file
from benchmarks.runs.callbacks import Recorder
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.store import RunFolder
from benchmarks.runs.training import learn
from benchmarks.studies.classic.features import extractor_of
from benchmarks.studies.classic.playing import evaluate, make_env, test
from benchmarks.studies.robots.trials import on_tests

TENSORBOARD: Final = {
    "eval/mean_reward": "return_mean",
    "eval/mean_ep_length": "length_mean",
    "rollout/ep_rew_mean": "training_return",
}
"""SB3's names of what a run's curve has, and its columns."""


def build_model(task: Task, method: str, seed: int) -> BaseAlgorithm:
    """The learner, untrained, with its training environments; errors as of ``build_on``."""
    discrete = LEARNERS[algorithm_of(method)].discrete

    def make_one() -> gym.Env[Any, Any]:
        return Monitor(make_env(task, discrete, training=True))

    images = task.policy == "CnnPolicy"
    network = {"features_extractor_class": extractor_of(task.env)} if images else {}
    return build_on(task, method, seed, DummyVecEnv([make_one] * task.n_envs), network)


class Tester(Recorder):
    """Tests the policy every so many steps, between two rounds of training."""

    def __init__(self, task: Task, seed: int) -> None:
        super().__init__()
        self.task, self.seed = task, seed
        self.seeds = episode_seeds(seed, task.eval_episodes, "validate")
        self.seconds = 0.0
        self._next = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self.finish()
            every = self.task.eval_every
            self._next = self.num_timesteps - self.num_timesteps % every + every

    def note(self) -> str:
        return f"return {self.rows[-1]['return_mean']:.1f}"

    def finish(self) -> None:
        """Add a row to the curve: the greedy policy on the run's validation episodes."""
        began = time.perf_counter()
        model = self.model
        discrete = isinstance(model.action_space, spaces.Discrete)
        played = np.array(evaluate(model_policy(model), self.task, self.seeds, discrete))
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

    def summary(self) -> dict[str, Any]:
        return {
            "evaluation_seconds": self.seconds,
            "updates": self.model._n_updates,
            "seeds": {
                "learner": derive("learner", self.seed),
                "first_validation_episode": self.seeds[0],
                "first_test_episode": episode_seeds(self.seed, 1)[0],
            },
        }

    def get_state(self) -> tuple[Any, ...]:
        return self.rows, self._next, self.seconds

    def set_state(self, state: tuple[Any, ...]) -> None:
        self.rows, self._next, self.seconds = state


class _Envs:
    """Training environments in the midst of their episodes; a world of Box2D cannot be kept."""

    def __init__(self, env: DummyVecEnv) -> None:
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
    cell: Cell,
    folder: RunFolder,
    stop_requested: StopRequested = lambda: False,
) -> dict[str, Any] | None:
    """Train a cell, from its newest checkpoint if there is one, and test its last policy.

    Writes ``curve.csv`` (validation during training) and ``episodes.csv`` (the final test, on
    seeds that neither training nor validation uses). Returns what meta.json says of the training,
    or None if it was stopped.
    """
    task = preset.tasks[cell.track]
    fresh = build_model(task, cell.method, cell.seed)
    env = fresh.get_env()
    assert isinstance(env, DummyVecEnv)
    trained = learn(
        folder,
        class_on(task, cell.method),
        lambda: fresh,
        env,
        {"envs": _Envs(env)},
        Tester(task, cell.seed),
        timesteps=task.timesteps,
        seconds=preset.checkpoint_seconds,
        stop_requested=stop_requested,
    )
    if trained is None:
        return None
    model, summary = trained
    began = time.perf_counter()
    if task.env == CONTACT:  # another study plays it
        policy_file.reduce_to_acting(model)
        policy_file.save(model, folder.policy)
    discrete = isinstance(model.action_space, spaces.Discrete)
    test(model_policy(model), preset, cell, folder, discrete)
    if task.env == CONTACT:
        folder.write_rows("contact", on_tests(model, make_env(task, discrete)))
    return {**summary, "test_seconds": time.perf_counter() - began}
