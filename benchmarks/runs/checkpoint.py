"""Checkpoints of a training run: exact, atomic, and set aside when they cannot be read."""

from __future__ import annotations

import errno
import os
import pickle
import random
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from benchmarks.errors import BenchmarkError
from benchmarks.runs import machine
from benchmarks.runs.callbacks import CurriculumCallback, CurveRecorder
from benchmarks.runs.store import BROKEN, RunFolder
from coop_env.vec_env import CoopInsertionVecEnv

Model = TypeVar("Model", bound=BaseAlgorithm)

PREFIX: Final = "step-"
PROGRESS_SECONDS: Final = 0.5
FULL_BYTES: Final = 1_000_000  # free room below which a failed write is put down to the disk
# of a network's storage, or of a machine that has too much to do
PASSING: Final = (
    *(errno.ESTALE, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN, errno.EACCES),
    *(errno.ENOMEM, errno.EMFILE, errno.ENFILE),
)


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
        self.set_aside: list[str] = []
        self.made_with = [{"from_step": 0, **_version()}]
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
        # before the first step there is nothing to lose, and a learner that resumes at step 0 would
        # reset its environments twice
        if self.num_timesteps and (self.stopped or now - self._saved >= self.seconds):
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
        """Write a checkpoint of the run."""
        model = self.model
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
            "set_aside": self.set_aside,
            "made_with": self.made_with,
            **self.times(),
        }
        write_checkpoint(self.folder.checkpoint, model, state)

    def restore(self, state: dict[str, Any], monitor: VecMonitor, timesteps: int) -> None:
        """Put everything but the model and its buffer back to a checkpoint.

        A state that lacks something, or is of another environment, is refused before any change.
        """
        env = monitor.venv
        assert isinstance(env, CoopInsertionVecEnv)
        rng, curriculum, curve = state["rng"], state["curriculum"], state["curve"]
        resumed_at, set_aside = state["resumed_at"], state["set_aside"]
        made_with = state.get("made_with", self.made_with)  # older checkpoints lack it
        times, episodes = (state["wall_seconds"], state["cpu_seconds"]), state["monitor"]
        env.set_state(state["env"])
        monitor.episode_returns, monitor.episode_lengths, monitor.episode_count = episodes
        self.curriculum.set_state(curriculum)
        self.curve.set_state(curve)
        self.rng = rng
        self.resumed_at = [*resumed_at, timesteps]
        self.set_aside = [*set_aside, *self.set_aside]
        if _version().items() <= made_with[-1].items():
            self.made_with = made_with
        else:  # the same settings, but perhaps not the same code: the run says so
            self.made_with = [*made_with, {"from_step": timesteps, **_version()}]
        self._wall, self._cpu = times


def _version() -> dict[str, Any]:
    """The code that this process runs."""
    made_with = machine.describe()
    return {"commit": made_with["commit"], "dirty": made_with["dirty"]}


def sync(path: Path) -> None:
    """Have a file or a folder's list of names on the disk, whatever befalls the machine next."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def checkpoints(root: Path) -> list[Path]:
    """Checkpoints under ``root``, oldest first."""
    return sorted(root.glob(f"{PREFIX}*"))


def write_checkpoint(root: Path, model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Write a checkpoint beside the last one, rename it into place, then drop the last one.

    Args:
        root: the run's folder of checkpoints.
        model: saved with its replay buffer if it has one.
        state: whatever else the run needs to go on; pickled.

    Raises:
        BenchmarkError: the disk is full; the last checkpoint stays.
    """
    final = root / f"{PREFIX}{model.num_timesteps:010d}"
    if final.is_dir():
        return  # the run resumed from it and went no further: it must not be deleted for its copy
    temporary = root / "saving"
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir(parents=True)
        model.save(temporary / "model.zip")
        if isinstance(model, OffPolicyAlgorithm):
            model.save_replay_buffer(temporary / "buffer.pkl")
        with (temporary / "state.pkl").open("wb") as stream:
            pickle.dump(state, stream)
        for path in temporary.iterdir():
            sync(path)
    except Exception as error:
        full = _is_full(root, error)
        shutil.rmtree(temporary, ignore_errors=True)
        if not full:
            raise
        kept = checkpoints(root)
        raise BenchmarkError(
            f"{root}: the disk is full, a checkpoint found no room; make room and give the same "
            f"command again: it goes on from {kept[-1].name if kept else 'the start'}"
        ) from error
    older = checkpoints(root)
    temporary.rename(final)
    sync(root)
    for path in older:
        shutil.rmtree(path, ignore_errors=True)


def _is_full(root: Path, error: Exception) -> bool:
    if isinstance(error, OSError):
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    # torch tells of a failed write without its cause
    return isinstance(error, RuntimeError) and shutil.disk_usage(root).free < FULL_BYTES


def _is_passing(error: Exception) -> bool:
    """Whether it speaks of the machine's state and not of the file."""
    if isinstance(error, OSError):
        return error.errno in PASSING
    return isinstance(error, torch.OutOfMemoryError)


def load_newest(
    folder: RunFolder,
    algorithm: type[BaseAlgorithm],
    env: VecMonitor,
    watch: Watch,
    device: str = "cpu",
) -> BaseAlgorithm | None:
    """The model of the newest readable checkpoint, with ``env`` and ``watch`` restored, or None."""

    def restore(model: BaseAlgorithm, state: dict[str, Any]) -> None:
        watch.restore(state, env, model.num_timesteps)

    return read_newest(folder.checkpoint, algorithm, env, restore, watch.set_aside, device)


def read_newest(
    root: Path,
    algorithm: type[Model],
    env: VecEnv,
    restore: Callable[[Model, dict[str, Any]], None],
    set_aside: list[str],
    device: str = "cpu",
) -> Model | None:
    """The model of the newest readable checkpoint below ``root``, or None.

    A checkpoint that is damaged is named in a warning and kept aside as ``broken-...``.

    Args:
        root: the run's folder of checkpoints.
        algorithm: the model's class.
        env: what the model goes on in.
        restore: puts the checkpoint's state back; what it raises counts as unreadable.
        set_aside: the names of checkpoints set aside are added to it.
        device: where the network is to live.

    Raises:
        BenchmarkError: a checkpoint cannot be read now, for a reason that is not the file's.
    """
    for path in reversed(checkpoints(root)):
        try:
            with (path / "state.pkl").open("rb") as stream:
                state = pickle.load(stream)
            model = algorithm.load(path / "model.zip", env=env, force_reset=False, device=device)
            if isinstance(model, OffPolicyAlgorithm):
                with (path / "buffer.pkl").open("rb") as stream:
                    model.load_replay_buffer(stream)
            restore(model, state)
        except Exception as error:
            if _is_passing(error):
                raise BenchmarkError(
                    f"{path} cannot be read now ({type(error).__name__}: {error}); it is kept, the "
                    "same command tries again"
                ) from error
            # whatever a damaged file makes of the loaders, the run must go on
            aside = path.with_name(f"{BROKEN}{path.name}")
            shutil.rmtree(aside, ignore_errors=True)
            path.rename(aside)
            set_aside.append(aside.name)
            warnings.warn(
                f"{path} cannot be read ({type(error).__name__}: {error}); it is kept as "
                f"{aside.name} and the run restarts",
                stacklevel=2,
            )
            continue
        return model
    return None


def rng_state(model: BaseAlgorithm) -> dict[str, Any]:
    """States of all generators that learning draws from, beside the environments' own."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002 - SB3 draws from numpy's global generator
        "torch": torch.get_rng_state(),
        # noisy layers draw on the device that they live on
        "cuda": torch.cuda.get_rng_state() if model.device.type == "cuda" else None,
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def restore_rng(state: dict[str, Any], model: Any) -> None:
    """Put the generators of :func:`rng_state` back."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    if state.get("cuda") is not None and model.device.type == "cuda":
        torch.cuda.set_rng_state(state["cuda"])
    model.action_space.np_random.bit_generator.state = state["action_space"]
