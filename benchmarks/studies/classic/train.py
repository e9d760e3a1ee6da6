"""Runs of the public tasks: a learner is trained and tested, a control is tested alike."""

import math
import pickle
import time
from collections.abc import Sequence
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import model_policy
from benchmarks.methods.learners import build_on, class_on
from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import CONTACT, SuitePreset, Task
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs import policy_file
from benchmarks.runs.callbacks import Recorder
from benchmarks.runs.cell import ProgressReporter
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.store import RunFolder
from benchmarks.runs.training import learn
from benchmarks.studies.classic.controls import Act, at_random, held, scripted
from benchmarks.studies.classic.envs import make
from benchmarks.studies.classic.features import extractor_of
from benchmarks.studies.robots.trials import on_tests

IN_MOVES: Final = "coop_env:CoopInsertionContactDiscrete-v0"  # for who cannot act continuously
PARALLEL: Final = 50  # episodes that a test plays side by side
#: SB3's names of what a run's curve has, and its columns
TENSORBOARD: Final = {
    "eval/mean_reward": "return_mean",
    "eval/mean_ep_length": "length_mean",
    "rollout/ep_rew_mean": "training_return",
}


def make_env(task: Task, discrete: bool = True, training: bool = False) -> gym.Env[Any, Any]:
    """One environment of a task, to be tested in or to learn in."""
    name = IN_MOVES if discrete and task.env == CONTACT else task.env
    return make(name, training, **task.env_kwargs)


def evaluate(
    act: Act, task: Task, seeds: Sequence[int], discrete: bool = True
) -> list[tuple[float, int]]:
    """Return and length of a policy's episodes, one for each ``reset(seed=...)``.

    ``discrete``: choose one of n actions, not increments, where the task has both kinds.
    """
    if len(seeds) > PARALLEL:
        some = evaluate(act, task, seeds[:PARALLEL], discrete)
        return some + evaluate(act, task, seeds[PARALLEL:], discrete)
    playing = [make_env(task, discrete) for _ in seeds]
    masked = playing[0].has_wrapper_attr("action_masks")
    observations = [env.reset(seed=seed)[0] for env, seed in zip(playing, seeds, strict=True)]
    returns, lengths = [0.0] * len(seeds), [0] * len(seeds)
    active = list(range(len(seeds)))
    while active:
        batch = _stack([observations[i] for i in active])
        masks: Any = None
        if masked:
            masks = np.stack([playing[i].get_wrapper_attr("action_masks")() for i in active])
        for i, action in zip(active.copy(), act(batch, masks), strict=True):
            observations[i], reward, terminated, truncated, _ = playing[i].step(action)
            returns[i] += float(reward)
            lengths[i] += 1
            if terminated or truncated:
                active.remove(i)
    for env in playing:
        env.close()
    return list(zip(returns, lengths, strict=True))


def _stack(observations: Sequence[Any]) -> Any:
    """Observations of several environments as a batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(observations)


def test(act: Act, preset: SuitePreset, cell: Cell, folder: RunFolder, discrete: bool) -> None:
    """The final test, whose episodes depend on the cell's seed alone; writes ``episodes.csv``."""
    seeds = episode_seeds(cell.seed, preset.final_episodes)
    played = evaluate(act, preset.tasks[cell.track], seeds, discrete)
    rows = [
        {"episode": number, "seed": seed, "return": total, "length": length}
        for number, (seed, (total, length)) in enumerate(zip(seeds, played, strict=True))
    ]
    folder.write_rows("episodes", rows)


def build_model(task: Task, method: str, seed: int) -> BaseAlgorithm:
    """The learner, untrained, with its training environments; errors as of ``build_on``."""
    discrete = LEARNERS[algorithm_of(method)].discrete

    def make_one() -> gym.Env[Any, Any]:
        return Monitor(make_env(task, discrete, training=True))

    images = task.policy == "CnnPolicy"
    network = {"features_extractor_class": extractor_of(task.env)} if images else {}
    model = build_on(task, method, seed, DummyVecEnv([make_one] * task.n_envs), network)
    if not isinstance(model.get_env(), DummyVecEnv):  # SB3 has turned the images
        raise BenchmarkError(
            f"{task.env}: its images have their channels last; wrap it so that they come first"
        )
    return model


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
    """Training environments in the middle of their episodes; Box2D's cannot be stored."""

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

    Writes ``curve.csv`` (validation) and ``episodes.csv`` (the final test). Returns what meta.json
    says of the training, or None if it was stopped.
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


def run_control(
    preset: SuitePreset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: StopRequested = lambda: False,
) -> dict[str, Any]:
    """Test a control on a learner's test episodes; writes ``episodes.csv``.

    The held action is the best one on a learner's validation episodes.
    """
    task, seed = preset.tasks[cell.track], cell.seed
    report = ProgressReporter(folder, stop_requested)
    env: Any = make_env(task)
    n = int(env.action_space.n)
    env.close()
    about: dict[str, Any] = {}
    if cell.method == "random":
        control = at_random(n, derive("noise", seed))
    elif cell.method == "held":
        validation = episode_seeds(seed, task.eval_episodes, "validate")
        totals = []
        for action in range(n):
            played = evaluate(held(action), task, validation)
            totals.append(sum(total for total, _ in played))
            report(0.5 * (action + 1) / n, f"action {action}")
        about["action"] = int(np.argmax(totals))
        control = held(about["action"])
    else:
        control = scripted(task.env)
    report(0.5, "test")
    test(control, preset, cell, folder, discrete=True)
    return {**about, "seeds": {"first_test_episode": episode_seeds(seed, 1)[0]}}
