"""Training of one learning cell: resume if it was cut off, learn, keep going.

A run is checkpointed between two rounds of collection, where model, replay buffer, environments and
callbacks agree with one another, so that a resumed run goes on as if it had never stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import configure

from benchmarks.methods.learners import ALGORITHMS, build_model, make_training_env
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder
from benchmarks.runs.checkpoint import Watch, load_newest
from benchmarks.runs.store import RunFolder
from sb3_rainbow.learner.denormals import flush_denormals


def train(
    preset: Preset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: Callable[[], bool] = lambda: False,
    device: str = "cpu",
) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
    """Train a cell, from its newest checkpoint if there is one.

    Args:
        preset: the experiment.
        cell: a learning cell of it.
        folder: where checkpoints, the curve and TensorBoard's events go.
        stop_requested: asked between rounds; True saves a checkpoint and ends the call.
        device: where the network lives: cpu or cuda.

    Returns:
        The trained model and what meta.json says of the training, or None if it was stopped.
    """
    torch.set_num_threads(1)
    track = preset.tracks[cell.track]
    env = make_training_env(preset, cell)
    curriculum = CurriculumCallback(track.curriculum)
    curve = CurveRecorder(track, curriculum)
    watch = Watch(
        folder, curriculum, curve, preset.checkpoint_seconds, track.timesteps, stop_requested
    )
    model = load_newest(folder, ALGORITHMS[cell.method], env, watch, device)
    if model is None:
        model = build_model(preset, cell, env, device)
    model.set_logger(configure(str(folder.tensorboard), ["tensorboard"]))
    remaining = track.timesteps - model.num_timesteps
    if remaining > 0:
        with flush_denormals():  # for every method alike
            model.learn(
                remaining,
                callback=CallbackList([curriculum, curve, watch]),
                log_interval=10**9,  # the curve recorder writes, at even intervals of steps
                reset_num_timesteps=model.num_timesteps == 0,
            )
    if watch.stopped:
        return None
    curve.flush()
    folder.write_rows("curve", curve.rows)
    return model, {
        **curve.summary(),
        **watch.times(),
        "resumed_at": watch.resumed_at,
        "set_aside": watch.set_aside,
        "made_with": watch.made_with,
        "device": str(model.device),
        "timesteps": model.num_timesteps,
    }
