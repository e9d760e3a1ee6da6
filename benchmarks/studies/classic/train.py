"""One learner on one task: the same training and the same tests for all three methods."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs.checkpoint import read_newest, restore_rng, rng_state, write_checkpoint
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic import envs
from benchmarks.studies.classic.features import SmallCnn
from benchmarks.studies.classic.plan import Cell
from benchmarks.studies.classic.presets import Preset, Task
from sb3_rainbow import Rainbow

ALGORITHMS: Final[dict[str, type[OffPolicyAlgorithm]]] = {
    "rainbow": Rainbow,
    "dqn": DQN,
    "qrdqn": QRDQN,
}
LINEAR: Final = "lin_"  # rl-baselines3-zoo's word for a rate that falls to 0
PARALLEL: Final = 50  # episodes that a test plays side by side


def make_env(task: Task) -> gym.Env[Any, Any]:
    """One environment of a task."""
    return envs.make(task.env, **task.env_kwargs)


def build_model(task: Task, method: str, seed: int) -> OffPolicyAlgorithm:
    """The learner, untrained, with its training environments.

    Raises:
        BenchmarkError: a setting is unknown to the method's constructor.
    """
    arguments = copy.deepcopy(task.methods[method])  # SB3 writes into policy_kwargs
    algorithm = ALGORITHMS[method]
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
    if task.policy == "CnnPolicy":
        kwargs = dict(arguments.get("policy_kwargs", {}))
        kwargs.setdefault("features_extractor_class", SmallCnn)
        arguments["policy_kwargs"] = kwargs
    env = DummyVecEnv([lambda: Monitor(make_env(task)) for _ in range(task.n_envs)])
    return algorithm(
        task.policy,
        env,
        seed=derive("learner", seed),
        device="cpu",
        **arguments,
    )


def evaluate(
    model: OffPolicyAlgorithm, task: Task, seeds: Sequence[int]
) -> list[tuple[float, int]]:
    """Play one episode per seed with the greedy policy; draws from no generator of the training.

    Args:
        model: acts with ``deterministic=True``, under the env's masks if it knows masks.
        task: whose environments to play in.
        seeds: ``reset(seed=...)`` of each episode.

    Returns:
        Return and length of each episode, in the order of ``seeds``.
    """
    results: list[tuple[float, int]] = []
    for first in range(0, len(seeds), PARALLEL):
        results += _play(model, task, seeds[first : first + PARALLEL])
    return results


def _play(model: OffPolicyAlgorithm, task: Task, seeds: Sequence[int]) -> list[tuple[float, int]]:
    playing = [make_env(task) for _ in seeds]
    masked = isinstance(model, Rainbow) and playing[0].has_wrapper_attr("action_masks")
    observations = [env.reset(seed=seed)[0] for env, seed in zip(playing, seeds, strict=True)]
    returns, lengths = [0.0] * len(seeds), [0] * len(seeds)
    active = list(range(len(seeds)))
    while active:
        batch = np.stack([observations[i] for i in active])
        masks: dict[str, Any] = {}
        if masked:
            allowed = [playing[i].get_wrapper_attr("action_masks")() for i in active]
            masks["action_masks"] = np.stack(allowed)
        actions, _ = model.predict(batch, deterministic=True, **masks)
        still = []
        for i, action in zip(active, actions, strict=True):
            observations[i], reward, terminated, truncated, _ = playing[i].step(action)
            returns[i] += float(reward)
            lengths[i] += 1
            if not (terminated or truncated):
                still.append(i)
        active = still
    for env in playing:
        env.close()
    return list(zip(returns, lengths, strict=True))


class Watch(BaseCallback):
    """Tests the policy every so many steps, saves checkpoints, and stops when it is asked to.

    All of it happens between two rounds of training, where model, replay buffer and environments
    agree with one another.

    Args:
        folder: the run's folder.
        task: what is learned.
        seed: the run's seed, of which the test episodes' seeds are derived.
        checkpoint_seconds: wall-clock time between two checkpoints.
        stop_requested: asked before each round.
    """

    def __init__(
        self,
        folder: RunFolder,
        task: Task,
        seed: int,
        checkpoint_seconds: float,
        stop_requested: Callable[[], bool],
    ) -> None:
        super().__init__()
        self.folder, self.task = folder, task
        self.seeds = episode_seeds(seed, task.eval_episodes, "validate")
        self.checkpoint_seconds = checkpoint_seconds
        self.stop_requested = stop_requested
        self.stopped = False
        self.rows: list[dict[str, object]] = []
        self.resumed_at: list[int] = []
        self.set_aside: list[str] = []
        self.evaluation_seconds = 0.0
        self._rng: dict[str, Any] | None = None
        self._next = 0
        self._wall, self._cpu = 0.0, 0.0  # of earlier processes
        self._began = time.perf_counter(), time.process_time()
        self._saved = time.perf_counter()

    def _on_training_start(self) -> None:
        if self._rng is not None:
            restore_rng(self._rng, self.model)
            self._rng = None

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self.test()
            self._next = self.num_timesteps - self.num_timesteps % self.task.eval_every
            self._next += self.task.eval_every
            share = self.num_timesteps / self.task.timesteps
            self.folder.write_progress(share, f"return {self.rows[-1]['return_mean']:.1f}")
        if self.stop_requested():
            self.stopped = True
        late = time.perf_counter() - self._saved >= self.checkpoint_seconds
        if self.stopped or late:
            self.save()
            self._saved = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.stopped

    def test(self) -> None:
        """Add a row to the curve: the greedy policy on the run's validation episodes."""
        began = time.perf_counter()
        model = self.model
        assert isinstance(model, OffPolicyAlgorithm)
        played = np.array(evaluate(model, self.task, self.seeds))
        training = [float(episode["r"]) for episode in model.ep_info_buffer or []]
        self.rows.append({
            "timesteps": model.num_timesteps,
            "updates": model._n_updates,
            "return_mean": float(played[:, 0].mean()),
            "return_std": float(played[:, 0].std()),
            "length_mean": float(played[:, 1].mean()),
            "training_return": float(np.mean(training)) if training else math.nan,
        })  # fmt: skip
        self.evaluation_seconds += time.perf_counter() - began

    def times(self) -> dict[str, float]:
        """Wall and CPU seconds, over all processes of the run; tests included."""
        return {
            "wall_seconds": self._wall + time.perf_counter() - self._began[0],
            "cpu_seconds": self._cpu + time.process_time() - self._began[1],
            "evaluation_seconds": self.evaluation_seconds,
        }

    def save(self) -> None:
        """Write a checkpoint of the run."""
        model = self.model
        assert isinstance(model, OffPolicyAlgorithm)
        env = self.training_env
        assert isinstance(env, DummyVecEnv)
        state = {
            "envs": _pickled(list(env.envs)),
            "rows": self.rows,
            "next": self._next,
            "rng": rng_state(model),
            "resumed_at": self.resumed_at,
            "set_aside": self.set_aside,
            "times": self.times(),
        }
        write_checkpoint(self.folder.checkpoint, model, state)

    def restore(self, model: OffPolicyAlgorithm, state: dict[str, Any]) -> None:
        """Put everything but the model and its buffer back to a checkpoint."""
        env = model.get_env()
        assert isinstance(env, DummyVecEnv)
        rows, times, following = state["rows"], state["times"], state["next"]
        if state["envs"] is None:
            model._last_obs = None  # the episode cannot go on: learn() begins a new one
        else:
            env.envs = pickle.loads(state["envs"])
        self.rows, self._next, self._rng = rows, following, state["rng"]
        self.resumed_at = [*state["resumed_at"], model.num_timesteps]
        self.set_aside += state["set_aside"]
        self._wall, self._cpu = times["wall_seconds"], times["cpu_seconds"]
        self.evaluation_seconds = times["evaluation_seconds"]


def _pickled(running: list[gym.Env[Any, Any]]) -> bytes | None:
    """Environments with their state, or None if they cannot be kept, as a world of Box2D."""
    if any(isinstance(env.unwrapped, gym.utils.EzPickle) for env in running):
        return None  # it would be made anew from its arguments
    try:
        return pickle.dumps(running)
    except (TypeError, AttributeError, pickle.PicklingError):
        return None


def run_learner(
    preset: Preset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Train a cell, from its newest checkpoint if there is one, and test its last policy.

    Writes ``curve.csv`` (validation during training) and ``episodes.csv`` (the final test, on
    seeds that neither training nor validation uses).

    Args:
        preset: the experiment.
        cell: a learning cell of it.
        folder: the run's.
        stop_requested: asked between rounds; True saves a checkpoint and ends the call.

    Returns:
        What meta.json says of the training, or None if it was stopped.
    """
    torch.set_num_threads(1)
    task, seed = preset.tasks[cell.task], cell.number
    model = build_model(task, cell.method, seed)
    watch = Watch(folder, task, seed, preset.checkpoint_seconds, stop_requested)
    env = model.get_env()
    assert env is not None
    resumed = read_newest(
        folder.checkpoint, ALGORITHMS[cell.method], env, watch.restore, watch.set_aside
    )
    model = model if resumed is None else resumed
    model.set_logger(configure(None, []))
    remaining = task.timesteps - model.num_timesteps
    if remaining > 0:
        model.learn(
            remaining,
            callback=watch,
            log_interval=10**9,
            reset_num_timesteps=model.num_timesteps == 0,
        )
    if watch.stopped:
        return None
    watch.model = model
    watch.test()
    folder.write_rows("curve", watch.rows)
    began = time.perf_counter()
    seeds = episode_seeds(seed, preset.final_episodes, "test")
    played = evaluate(model, task, seeds)
    folder.write_rows(
        "episodes",
        [
            {"episode": i, "seed": episode_seed, "return": total, "length": length}
            for i, (episode_seed, (total, length)) in enumerate(zip(seeds, played, strict=True))
        ],
    )
    return {
        **watch.times(),
        "test_seconds": time.perf_counter() - began,
        "timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "resumed_at": watch.resumed_at,
        "set_aside": watch.set_aside,
        "seeds": {
            "learner": derive("learner", seed),
            "first_validation_episode": watch.seeds[0],
            "first_test_episode": seeds[0],
        },
    }
