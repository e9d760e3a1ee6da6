"""Training of one learning cell: resume if it was cut off, learn, keep going.

A run is checkpointed between two rounds of collection, where model, replay buffer, environments and
callbacks agree with one another, so that a resumed run goes on as if it had never stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

from benchmarks.methods.learners import ALGORITHMS, build_model, make_training_env
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder
from benchmarks.runs.checkpoint import RunCallback, Stateful, learn
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

    Returns:
        The trained model and what meta.json says of the training, or None if it was stopped.
    """
    track = preset.tracks[cell.track]
    env = make_training_env(preset, cell)
    curriculum = CurriculumCallback(track.curriculum, track.rows)
    curve = CurveRecorder(track, curriculum)

    def note() -> str:
        how = f"success {np.mean(curve.recent):.0%}" if curve.recent else "warming up"
        return f"{how}, stage {curriculum.stage}"

    envs: Any = env.venv
    kept: dict[str, Stateful] = {
        "env": envs,
        "monitor": _Monitor(env),
        "curriculum": curriculum,
        "curve": curve,
    }
    callback = RunCallback(
        folder, kept, preset.checkpoint_seconds, track.timesteps, stop_requested, note
    )
    logger = configure(str(folder.tensorboard), ["tensorboard"])
    with flush_denormals():  # for every method alike
        model = learn(
            callback,
            ALGORITHMS[cell.method],
            env,
            lambda: build_model(preset, cell, env, device),
            [curriculum, curve],
            logger,
            device,
        )
    if model is None:
        return None
    curve.flush()
    folder.write_rows("curve", curve.rows)
    return model, {**curve.summary(), **callback.summary(model)}


class _Monitor:
    """The episodes that a VecMonitor is in the midst of."""

    def __init__(self, env: VecMonitor) -> None:
        self.env = env

    def get_state(self) -> tuple[Any, ...]:
        return self.env.episode_returns, self.env.episode_lengths, self.env.episode_count

    def set_state(self, state: tuple[Any, ...]) -> None:
        self.env.episode_returns, self.env.episode_lengths, self.env.episode_count = state
