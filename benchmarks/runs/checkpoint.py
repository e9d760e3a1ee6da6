"""Checkpoints of a training run: exact, atomic, and set aside when they cannot be read."""

import errno
import pickle
import shutil
import time
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.seeding import derive
from benchmarks.runs import machine
from benchmarks.runs.store import BROKEN, RunFolder, sync
from sb3_rainbow.resume.checkpoint import get_rng_state, set_rng_state

Model = TypeVar("Model", bound=BaseAlgorithm)

PREFIX: Final = "step-"
FULL_BYTES: Final = 1_000_000  # less free room than this explains a failed write
# errors of a network's storage, or of an overloaded machine
PASSING: Final = (
    *(errno.ESTALE, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN, errno.EACCES),
    *(errno.ENOMEM, errno.EMFILE, errno.ENFILE),
)


class Stateful(Protocol):
    """A part of a run beside its model; a state of None means that its episodes begin anew."""

    @abstractmethod
    def get_state(self) -> Any: ...

    @abstractmethod
    def set_state(self, state: Any, /) -> Any: ...


class RunCallback(BaseCallback):
    """Saves checkpoints, reports progress to the harness, and stops the run when asked.

    Args:
        kept: what is saved with the model, by name; put back in this order.
        seconds: wall-clock time between two checkpoints.
        timesteps: the run's length.
        note: returns a short text on the training's progress.
    """

    def __init__(
        self,
        folder: RunFolder,
        kept: Mapping[str, Stateful],
        seconds: float,
        timesteps: int,
        stop_requested: Callable[[], bool],
        note: Callable[[], str],
    ) -> None:
        super().__init__()
        self.folder, self.kept = folder, kept
        self.seconds, self.timesteps = seconds, timesteps
        self.stop_requested, self.note = stop_requested, note
        self.stopped = False
        self.rng: dict[str, Any] | None = None
        self.set_aside: list[str] = []
        self._past: dict[str, Any] = {  # of earlier processes
            "wall_seconds": 0.0, "cpu_seconds": 0.0, "resumed_at": [],
            "made_with": [{"from_step": 0, **_version()}],
        }  # fmt: skip
        self._began = (time.perf_counter(), time.process_time())
        self._saved = time.perf_counter()

    def _on_training_start(self) -> None:
        if self.rng is not None:
            set_rng_state(self.rng, self.model.action_space)
            self.rng = None

    def _on_rollout_start(self) -> None:
        # the one point of the loop where model, buffer and environments agree
        self.folder.report(self.num_timesteps / self.timesteps, self.note)
        if self.stop_requested():
            self.stopped = True
        # before the first step there is nothing to lose, and a learner that resumes at step 0 would
        # reset its environments twice
        due = time.perf_counter() - self._saved >= self.seconds
        if self.num_timesteps and (self.stopped or due):
            self.save()
            self._saved = time.perf_counter()

    def _on_step(self) -> bool:
        return not self.stopped

    def history(self) -> dict[str, Any]:
        """Wall and CPU seconds over all processes of the run, and the steps where it resumed."""
        return {
            **self._past,
            "wall_seconds": self._past["wall_seconds"] + time.perf_counter() - self._began[0],
            "cpu_seconds": self._past["cpu_seconds"] + time.process_time() - self._began[1],
            "set_aside": self.set_aside,
        }

    def save(self) -> None:
        """Write a checkpoint of the run."""
        state = {name: part.get_state() for name, part in self.kept.items()}
        state |= {"rng": get_rng_state(self.model.action_space), **self.history()}
        write_checkpoint(self.folder.checkpoint, self.model, state)

    def restore(self, state: dict[str, Any], model: BaseAlgorithm) -> None:
        """Put back all but model and buffer; a state that lacks something changes nothing."""
        rng, parts = state["rng"], [(part, state[name]) for name, part in self.kept.items()]
        past, set_aside = {name: state[name] for name in self._past}, state["set_aside"]
        for part, saved in parts:
            if saved is None:
                model._last_obs = None  # has learn() reset the environments, not as at the start
                assert model.env is not None
                model.env.seed(derive("train", model.seed or 0, model.num_timesteps))
            else:
                part.set_state(saved)
        if not _version().items() <= past["made_with"][-1].items():
            # the same settings, but perhaps not the same code: the run says so
            past["made_with"] += [{"from_step": model.num_timesteps, **_version()}]
        past["resumed_at"] += [model.num_timesteps]
        self.rng, self._past, self.set_aside = rng, past, [*set_aside, *self.set_aside]


def _version() -> dict[str, Any]:
    """The code that this process runs."""
    made_with = machine.describe()
    return {"commit": made_with["commit"], "dirty": made_with["dirty"]}


def checkpoints(root: Path) -> list[Path]:
    """Checkpoints under ``root``, oldest first."""
    return sorted(root.glob(f"{PREFIX}*"))


def write_checkpoint(root: Path, model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Write model, replay buffer and ``state`` beside the last checkpoint, then drop that one.

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
    """Whether an error is due to the machine's state and not to the file."""
    if isinstance(error, OSError):
        return error.errno in PASSING
    return isinstance(error, (MemoryError, torch.OutOfMemoryError))


def load_newest(
    callback: RunCallback, algorithm: type[Model], env: VecEnv, device: str
) -> Model | None:
    """The model of the newest sound checkpoint, with what the callback keeps restored, or None.

    A damaged one is named in a warning and kept aside as ``broken-...``.

    Raises:
        BenchmarkError: a checkpoint cannot be read now, for a reason that is not the file's.
    """
    for path in reversed(checkpoints(callback.folder.checkpoint)):
        try:
            with (path / "state.pkl").open("rb") as stream:
                state = pickle.load(stream)
            model = algorithm.load(path / "model.zip", env=env, force_reset=False, device=device)
            if isinstance(model, OffPolicyAlgorithm):
                with (path / "buffer.pkl").open("rb") as stream:
                    model.load_replay_buffer(stream)
            callback.restore(state, model)
            return model
        except Exception as error:
            if _is_passing(error):
                raise BenchmarkError(
                    f"{path} cannot be read now ({type(error).__name__}: {error}); it is kept, the "
                    "same command tries again"
                ) from error
            # whatever a loader raises on a damaged file, the run must go on
            aside = path.with_name(f"{BROKEN}{path.name}")
            shutil.rmtree(aside, ignore_errors=True)
            path.rename(aside)
            callback.set_aside.append(aside.name)
            warnings.warn(
                f"{path} cannot be read ({type(error).__name__}: {error}); it is kept as "
                f"{aside.name} and the run restarts",
                stacklevel=2,
            )
    return None
