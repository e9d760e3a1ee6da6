"""Training of one learning cell, resumed if it was cut off.

A run is checkpointed between two rounds of collection, where model, replay buffer, environments and
callbacks agree with one another, so that a resumed run goes on as if it had never stopped.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from benchmarks.errors import BenchmarkError
from benchmarks.methods.learners import build_model, class_of, make_training_env
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder, Recorder
from benchmarks.runs.checkpoint import RunCallback, Stateful, load_newest
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.store import RunFolder
from sb3_rainbow.learner.learner import flush_denormals


def learn(
    folder: RunFolder,
    algorithm: type[BaseAlgorithm],
    build: Callable[[], BaseAlgorithm],
    env: VecEnv,
    kept: Mapping[str, Stateful],
    recorder: Recorder,
    *,
    timesteps: int,
    seconds: float,
    stop_requested: StopRequested,
    callbacks: Sequence[BaseCallback] = (),
    device: str = "cpu",
) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
    """Train a model, from its newest checkpoint or as ``build`` makes it; writes ``curve.csv``.

    Args:
        folder: of the run.
        algorithm: loads a checkpoint.
        build: makes the untrained model.
        env: its training environments.
        kept: what else a checkpoint holds, by name, put back in this order; the recorder is last.
        recorder: makes the rows of the curve.
        timesteps: the run's length.
        seconds: wall-clock time between two checkpoints.
        stop_requested: asked between two rounds of collection.
        callbacks: before the recorder.
        device: cpu or cuda, of a model that is loaded.

    Returns:
        The trained model and what meta.json says of the training, or None if it was stopped.
    """
    torch.set_num_threads(1)
    parts = {**kept, "curve": recorder}
    callback = RunCallback(folder, parts, seconds, timesteps, stop_requested, recorder.note)
    model = load_newest(callback, algorithm, env, device) or build()
    model.set_logger(configure(str(folder.tensorboard), ["tensorboard"]))
    remaining = timesteps - model.num_timesteps
    if remaining > 0:
        model.learn(
            remaining,
            callback=CallbackList([*callbacks, recorder, callback]),
            log_interval=10**9,  # the callbacks write, at even intervals of steps
            reset_num_timesteps=model.num_timesteps == 0,
        )
    if callback.stopped:
        return None
    if model.num_timesteps < timesteps:
        raise BenchmarkError(
            f"{algorithm.__name__}.learn() returned at step {model.num_timesteps} of {timesteps}"
        )
    recorder.model, recorder.num_timesteps = model, model.num_timesteps  # if nothing was left to do
    recorder.finish()
    folder.write_rows("curve", recorder.rows)
    about = {"device": str(model.device), "timesteps": model.num_timesteps}
    return model, {**recorder.summary(), **callback.history(), **about}


def train(
    preset: Preset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: StopRequested = lambda: False,
    device: str = "cpu",
) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
    """:func:`learn` a cell of the insertion task."""
    track = preset.tracks[cell.track]
    env = make_training_env(preset, cell)
    curriculum = CurriculumCallback(track.curriculum, track.rows)
    envs: Any = env.venv
    with flush_denormals():  # for all methods alike
        return learn(
            folder,
            class_of(cell.method),
            lambda: build_model(preset, cell, env, device),
            env,
            {"env": envs, "monitor": _Monitor(env), "curriculum": curriculum},
            CurveRecorder(track, curriculum),
            timesteps=track.timesteps,
            seconds=preset.checkpoint_seconds,
            stop_requested=stop_requested,
            callbacks=[curriculum],
            device=device,
        )


class _Monitor:
    """The running episodes of a VecMonitor."""

    def __init__(self, env: VecMonitor) -> None:
        self.env = env

    def get_state(self) -> tuple[Any, ...]:
        return self.env.episode_returns, self.env.episode_lengths, self.env.episode_count

    def set_state(self, state: tuple[Any, ...]) -> None:
        self.env.episode_returns, self.env.episode_lengths, self.env.episode_count = state
