"""Saving and loading such that a run goes on exactly as if it had never stopped."""

import io
import os
import pathlib
import pickle
import warnings
import zipfile
from collections.abc import Iterable
from typing import Any, Self

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from sb3_rainbow.masking.masked_off_policy import MaskedOffPolicyAlgorithm
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.resume import checkpoint
from sb3_rainbow.settings import SettingsMismatchError
from sb3_rainbow.type_aliases import SaveFile

# In which a loaded replay buffer must agree with the model
_BUFFER_SETTINGS = ("observation_space", "action_space", "n_envs", "n_steps", "alpha")


def refuse_checkpoint(path: Any) -> None:
    """Raise ``ValueError`` for a checkpoint where the file of a model is meant."""
    if isinstance(path, str | pathlib.Path):
        for name in (path, f"{path}.zip"):  # SB3 adds the ending
            if checkpoint.is_checkpoint(name):
                raise ValueError(f"{name} is a checkpoint: use load_checkpoint()")


class ResumableAlgorithm(MaskedOffPolicyAlgorithm):
    """SB3's saving with the random generators, checks of what is loaded, and checkpoints."""

    # What save writes, and what the next learn that goes on starts from
    _rng_state: dict[str, Any] | None = None
    _rng_to_resume: dict[str, Any] | None = None

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        rng_state, self._rng_to_resume = self._rng_to_resume, None
        prepared = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, *args, **kwargs
        )
        if rng_state is not None and not reset_num_timesteps:
            checkpoint.set_rng_state(rng_state, self.action_space)
        return prepared

    def save(
        self,
        path: SaveFile,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """As SB3's ``save``, with the states of the random generators.

        They come back into force when a loaded model goes on learning
        (``learn(..., reset_num_timesteps=False)``), and not when it only predicts.
        """
        # A model that was loaded and has not learned since still stands where it was saved.
        self._rng_state = self._rng_to_resume or checkpoint.get_rng_state(self.action_space)
        try:
            super().save(path, exclude, include)
        finally:
            self._rng_state = None

    @classmethod
    def load(cls, path: SaveFile, *args: Any, **kwargs: Any) -> Self:
        """As SB3's ``load``; a ``seed`` in ``kwargs`` wins over the saved random generators."""
        refuse_checkpoint(path)
        model = super().load(path, *args, **kwargs)
        saved, model._rng_state = model._rng_state, None
        if kwargs.get("seed") is None:
            model._rng_to_resume = saved
        return model

    def set_random_seed(self, seed: int | None = None) -> None:
        """As SB3's ``set_random_seed``; wins over the random generators of a loaded model."""
        super().set_random_seed(seed)
        if seed is not None:
            self._rng_to_resume = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rng_to_resume"]

    def load_replay_buffer(self, path: SaveFile, truncate_last_traj: bool = True) -> None:
        """As SB3's ``load_replay_buffer``; the tree and all priorities come along.

        Raises:
            ValueError: if the buffer was filled with other settings; the present one stays.
        """
        present = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        if isinstance(present, PrioritizedReplayBuffer):
            for name in _BUFFER_SETTINGS:
                expected, given = getattr(present, name), getattr(loaded, name, None)
                if expected != given:
                    self.replay_buffer = present
                    where = path if isinstance(path, str | pathlib.Path) else "the checkpoint"
                    raise SettingsMismatchError(
                        f"The replay buffer in {where} was filled with {name}={given}, "
                        f"the model has {name}={expected}"
                    )

    def save_checkpoint(self, path: str | pathlib.Path) -> None:
        """Write all of the run into one file: model, optimizer, counters, random generators, replay
        buffer with tree and open n-step windows, the state of SB3's wrappers around the ``VecEnv``,
        and that of a ``VecEnv`` that offers ``get_state()`` itself. A ``DummyVecEnv`` of gym envs
        does not: the wrappers around those (``TimeLimit``, ``Monitor``) do not give theirs.

        Call it between rounds of training: outside ``learn``, or in a callback's
        ``_on_rollout_start``. In ``_on_step`` the current transition is not stored yet. The file
        appears whole or not at all.
        """
        target = pathlib.Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(target.name + ".tmp")
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            parameters = io.BytesIO()
            self.save(parameters)
            archive.writestr(checkpoint.MODEL, parameters.getvalue())
            with archive.open(checkpoint.REPLAY, "w", force_zip64=True) as member:
                pickle.dump(self.replay_buffer, member, protocol=pickle.HIGHEST_PROTOCOL)
            archive.writestr(checkpoint.ENV, pickle.dumps(checkpoint.env_state(self.get_env())))
        os.replace(partial, target)

    @classmethod
    def load_checkpoint(cls, path: str | pathlib.Path, env: GymEnv, **kwargs: Any) -> Self:
        """A model that goes on exactly where :meth:`save_checkpoint` left it.

        ::

            model = Rainbow.load_checkpoint(path, env)
            model.learn(total - model.num_timesteps, reset_num_timesteps=False)

        A ``VecEnv`` without ``get_state()`` and ``set_state()`` starts new episodes instead.

        Args:
            env: env as at saving time.
            kwargs: passed to ``load``; a ``seed`` starts all random generators anew, but for those
                in the state of the env.

        Raises:
            ValueError: if the file is no checkpoint, or was saved with other settings.
        """
        if os.path.exists(path) and not checkpoint.is_checkpoint(path):
            raise ValueError(
                f"{path} is no checkpoint of Rainbow; was it written by save()? Then use load()"
            )
        with zipfile.ZipFile(path) as archive:
            state = pickle.loads(archive.read(checkpoint.ENV))
            resumable = state["env"] is not None
            file = io.BytesIO(archive.read(checkpoint.MODEL))
            model = cls.load(file, env=env, force_reset=not resumable, **kwargs)
            with archive.open(checkpoint.REPLAY) as member, warnings.catch_warnings():
                # An env that is reset does not go on with the episode that was under way. SB3 warns
                # of that, and advises what only load_replay_buffer offers.
                warnings.filterwarnings("ignore", "The last trajectory in the replay buffer")
                buffer = io.BytesIO(member.read())
                model.load_replay_buffer(buffer, truncate_last_traj=not resumable)
        vec_env = model.get_env()
        assert vec_env is not None
        checkpoint.restore_env(vec_env, state)
        return model
