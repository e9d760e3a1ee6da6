"""Everything a training run needs to go on exactly where it was cut off, in one file."""

import io
import os
import pathlib
import pickle
import warnings
import zipfile
from typing import Any, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

from sb3_rainbow.masking.conventions import innermost_vec_env

SelfAlgorithm = TypeVar("SelfAlgorithm", bound=OffPolicyAlgorithm)

_MODEL, _REPLAY, _ENV = "model.zip", "replay_buffer.pkl", "env.pkl"
# What SB3's wrappers keep between two steps, in their subclasses too, and those that keep nothing
_WRAPPER_STATE: dict[type[VecEnvWrapper], tuple[str, ...]] = {
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
    VecFrameStack: ("stacked_obs",),
}
_STATELESS = (VecCheckNan, VecExtractDictObs, VecTransposeImage, VecVideoRecorder)


def save_checkpoint(model: OffPolicyAlgorithm, path: str | pathlib.Path) -> None:
    """Write model, optimizer, random generators, replay buffer and env into one file.

    The file appears whole or not at all. See :meth:`sb3_rainbow.Rainbow.save_checkpoint`.
    """
    target = pathlib.Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + ".tmp")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        parameters = io.BytesIO()
        model.save(parameters)
        archive.writestr(_MODEL, parameters.getvalue())
        with archive.open(_REPLAY, "w", force_zip64=True) as member:
            pickle.dump(model.replay_buffer, member, protocol=pickle.HIGHEST_PROTOCOL)
        archive.writestr(_ENV, pickle.dumps(_env_state(model.get_env())))
    os.replace(partial, target)


def is_checkpoint(path: str | pathlib.Path) -> bool:
    """Whether :func:`save_checkpoint` wrote a file."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist()) == {_MODEL, _REPLAY, _ENV}


def load_checkpoint(
    cls: type[SelfAlgorithm], path: str | pathlib.Path, env: GymEnv, **kwargs: Any
) -> SelfAlgorithm:
    """A model that goes on where :func:`save_checkpoint` left it.

    See :meth:`sb3_rainbow.Rainbow.load_checkpoint`.

    Raises:
        ValueError: if the file is no checkpoint, or was saved with other settings.
    """
    try:
        archive = zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path} is no checkpoint of Rainbow: {error}") from error
    with archive:
        if set(archive.namelist()) != {_MODEL, _REPLAY, _ENV}:
            raise ValueError(
                f"{path} is no checkpoint of Rainbow; was it written by save()? Then use load()"
            )
        env_state = pickle.loads(archive.read(_ENV))
        resumable = env_state["env"] is not None
        model = cls.load(
            io.BytesIO(archive.read(_MODEL)), env=env, force_reset=not resumable, **kwargs
        )
        with archive.open(_REPLAY) as member, warnings.catch_warnings():
            # An env that is reset does not go on with the episode that was under way. SB3 warns of
            # that, and advises what only load_replay_buffer offers.
            warnings.filterwarnings("ignore", "The last trajectory in the replay buffer")
            model.load_replay_buffer(io.BytesIO(member.read()), truncate_last_traj=not resumable)
    vec_env = model.get_env()
    assert vec_env is not None
    _restore_wrappers(vec_env, env_state["wrappers"])
    if resumable:
        _restore_env(vec_env, env_state["env"])
    return model


def _env_state(env: VecEnv | None) -> dict[str, Any]:
    """State of the innermost env, None where it gives none, and of SB3's wrappers around it."""
    state: dict[str, Any] = {"env": None, "wrappers": []}
    if env is None:
        return state
    inner = innermost_vec_env(env)
    if hasattr(inner, "get_state"):
        state["env"] = inner.get_state()
    while isinstance(env, VecEnvWrapper):
        names = _state_of(env)
        if not names and not isinstance(env, _STATELESS) and state["env"] is not None:
            warnings.warn(
                f"The checkpoint holds nothing of the wrapper {type(env).__name__}: if it keeps a "
                "state between steps, a resumed run will differ from one that never stopped; save "
                "that state beside the checkpoint",
                stacklevel=4,
            )
        # Some appear with the first reset only.
        state["wrappers"].append({name: vars(env)[name] for name in names if name in vars(env)})
        env = env.venv
    return state


def _state_of(env: VecEnv) -> list[str]:
    """Names of the attributes that hold the state of one of SB3's wrappers, none of others."""
    states = (names for kind, names in _WRAPPER_STATE.items() if isinstance(env, kind))
    return [name for names in states for name in names]


def _restore_wrappers(env: VecEnv, states: list[dict[str, Any]]) -> None:
    for state in states:
        if not isinstance(env, VecEnvWrapper) or not set(state) <= set(_state_of(env)):
            raise ValueError(
                f"The checkpoint holds {', '.join(state) or 'nothing'} of a wrapper, but "
                f"{type(env).__name__} stands in its place: wrap the env as at saving time"
            )
        for name, value in state.items():
            setattr(env, name, value)
        env = env.venv


def _restore_env(env: VecEnv, state: Any) -> None:
    inner = innermost_vec_env(env)
    if not hasattr(inner, "set_state"):
        raise ValueError(
            f"The checkpoint holds the state of its env, which {type(inner).__name__} cannot take "
            "(no set_state): pass an env of the class it was trained on"
        )
    inner.set_state(state)
