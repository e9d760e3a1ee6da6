"""Checkpoints of a training run: exact, atomic, and set aside when they cannot be read."""

from __future__ import annotations

import pickle
import random
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecMonitor

from benchmarks.callbacks import CurriculumCallback, CurveRecorder
from benchmarks.store import RunFolder
from coop_env.vec_env import CoopInsertionVecEnv

PREFIX: Final = "step-"
PROGRESS_SECONDS: Final = 0.5


class Watch(BaseCallback):
    """Saves checkpoints, tells the harness how far the run is, and stops it when asked.

    Args:
        folder: the run's folder.
        curriculum: saved with the model.
        curve: saved with the model.
        seconds: wall-clock time between two checkpoints.
        timesteps: the run's length, for its progress.
        stop_requested: asked before each round of collection.
    """

    def __init__(
        self,
        folder: RunFolder,
        curriculum: CurriculumCallback,
        curve: CurveRecorder,
        seconds: float,
        timesteps: int,
        stop_requested: Callable[[], bool],
    ) -> None:
        super().__init__()
        self.folder = folder
        self.curriculum, self.curve = curriculum, curve
        self.seconds, self.timesteps = seconds, timesteps
        self.stop_requested = stop_requested
        self.stopped = False
        self.rng: dict[str, Any] | None = None
        self.resumed_at: list[int] = []
        self._wall, self._cpu = 0.0, 0.0  # of earlier processes
        self._began = (time.perf_counter(), time.process_time())
        self._saved = self._told = time.perf_counter()

    def _on_training_start(self) -> None:
        if self.rng is not None:
            restore_rng(self.rng, self.model)
            self.rng = None

    def _on_rollout_start(self) -> None:
        # the one point of the loop where model, buffer and environments agree
        now = time.perf_counter()
        if now - self._told >= PROGRESS_SECONDS:
            self._told = now
            share = self.num_timesteps / self.timesteps
            recent = self.curve.recent
            note = f"success {np.mean(recent):.0%}" if recent else "warming up"
            self.folder.write_progress(share, f"{note}, stage {self.curriculum.stage}")
        if self.stop_requested():
            self.stopped = True
        if self.stopped or now - self._saved >= self.seconds:
            self.save()
            self._saved = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.stopped

    def times(self) -> dict[str, float]:
        """Wall and CPU seconds of the training, over all its processes."""
        return {
            "wall_seconds": self._wall + time.perf_counter() - self._began[0],
            "cpu_seconds": self._cpu + time.process_time() - self._began[1],
        }

    def save(self) -> None:
        """Write a checkpoint beside the last one, rename it into place, then drop the last one."""
        model = self.model
        assert isinstance(model, OffPolicyAlgorithm)
        root = self.folder.checkpoint
        temporary = root / "saving"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        model.save(temporary / "model.zip")
        model.save_replay_buffer(temporary / "buffer.pkl")
        monitor = self.training_env
        assert isinstance(monitor, VecMonitor)
        env = monitor.venv
        assert isinstance(env, CoopInsertionVecEnv)
        state = {
            "env": env.get_state(),
            "monitor": (monitor.episode_returns, monitor.episode_lengths, monitor.episode_count),
            "curriculum": self.curriculum.get_state(),
            "curve": self.curve.get_state(),
            "rng": rng_state(model),
            "resumed_at": self.resumed_at,
            **self.times(),
        }
        with (temporary / "state.pkl").open("wb") as stream:
            pickle.dump(state, stream)
        final = root / f"{PREFIX}{self.num_timesteps:010d}"
        shutil.rmtree(final, ignore_errors=True)
        older = checkpoints(root)
        temporary.rename(final)
        for path in older:
            shutil.rmtree(path, ignore_errors=True)

    def restore(self, state: dict[str, Any], monitor: VecMonitor, timesteps: int) -> None:
        """Put everything but the model and its buffer back to a checkpoint."""
        env = monitor.venv
        assert isinstance(env, CoopInsertionVecEnv)
        env.set_state(state["env"])
        monitor.episode_returns, monitor.episode_lengths, monitor.episode_count = state["monitor"]
        self.curriculum.set_state(state["curriculum"])
        self.curve.set_state(state["curve"])
        self.rng = state["rng"]
        self.resumed_at = [*state["resumed_at"], timesteps]
        self._wall, self._cpu = state["wall_seconds"], state["cpu_seconds"]


def checkpoints(root: Path) -> list[Path]:
    """Checkpoints under ``root``, oldest first."""
    return sorted(root.glob(f"{PREFIX}*"))


def load_newest(
    folder: RunFolder, algorithm: type[OffPolicyAlgorithm], env: VecMonitor, watch: Watch
) -> OffPolicyAlgorithm | None:
    """The model of the newest readable checkpoint, with ``env`` and ``watch`` restored, or None.

    A checkpoint that cannot be read is named in a warning and kept aside as ``broken-...``.
    """
    for path in reversed(checkpoints(folder.checkpoint)):
        try:
            with (path / "state.pkl").open("rb") as stream:
                state = pickle.load(stream)
            model = algorithm.load(path / "model.zip", env=env, force_reset=False, device="cpu")
            with (path / "buffer.pkl").open("rb") as stream:
                model.load_replay_buffer(stream)
        except Exception as error:
            # whatever a damaged file makes of the loaders, the run must go on
            aside = path.with_name(f"broken-{path.name}")
            shutil.rmtree(aside, ignore_errors=True)
            path.rename(aside)
            warnings.warn(
                f"{path} cannot be read ({type(error).__name__}: {error}); it is kept as "
                f"{aside.name} and the run restarts",
                stacklevel=2,
            )
            continue
        watch.restore(state, env, model.num_timesteps)
        return model
    return None


def rng_state(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """States of all generators that learning draws from, beside the environments' own."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002 - SB3 draws from numpy's global generator
        "torch": torch.get_rng_state(),
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def restore_rng(state: dict[str, Any], model: Any) -> None:
    """Put the generators of :func:`rng_state` back."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    model.action_space.np_random.bit_generator.state = state["action_space"]
