"""What a checkpoint holds of the env, and the names of its parts."""

import os
import warnings
import zipfile
from typing import Any

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

MODEL, REPLAY, ENV = "model.zip", "replay_buffer.pkl", "env.pkl"
# What SB3's wrappers keep between two steps, in their subclasses too, and those that keep nothing
_WRAPPER_STATE: dict[type[VecEnvWrapper], tuple[str, ...]] = {
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
    VecFrameStack: ("stacked_obs",),
}
_STATELESS = (VecCheckNan, VecExtractDictObs, VecTransposeImage, VecVideoRecorder)


def members(path: str | os.PathLike[str]) -> set[str]:
    """Names of what an archive holds; none of what is no archive."""
    if not zipfile.is_zipfile(path):
        return set()
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def is_checkpoint(path: str | os.PathLike[str]) -> bool:
    """Whether ``Rainbow.save_checkpoint`` wrote a file."""
    return members(path) == {MODEL, REPLAY, ENV}


def env_state(env: VecEnv | None) -> dict[str, Any]:
    """State of the innermost env, None where it gives none, and of SB3's wrappers around it."""
    state: dict[str, Any] = {"env": None, "wrappers": []}
    if env is None:
        return state
    inner = env.unwrapped
    if hasattr(inner, "get_state"):
        state["env"] = inner.get_state()
    while isinstance(env, VecEnvWrapper):
        names = _state_of(env)
        if not names and not isinstance(env, _STATELESS) and state["env"] is not None:
            warnings.warn(
                f"The checkpoint holds nothing of the wrapper {type(env).__name__}: if it keeps a "
                "state between steps, a resumed run will differ from one that never stopped; save "
                "that state beside the checkpoint",
                stacklevel=3,
            )
        # Some appear with the first reset only.
        state["wrappers"].append({name: vars(env)[name] for name in names if name in vars(env)})
        env = env.venv
    return state


def _state_of(env: VecEnv) -> list[str]:
    """Names of the attributes that hold the state of one of SB3's wrappers, none of others."""
    states = (names for kind, names in _WRAPPER_STATE.items() if isinstance(env, kind))
    return [name for names in states for name in names]


def restore_wrappers(env: VecEnv, states: list[dict[str, Any]]) -> None:
    """Put the state of the wrappers back, outermost first."""
    for state in states:
        if not isinstance(env, VecEnvWrapper) or not set(state) <= set(_state_of(env)):
            raise ValueError(
                f"The checkpoint holds {', '.join(state) or 'nothing'} of a wrapper, but "
                f"{type(env).__name__} stands in its place: wrap the env as at saving time"
            )
        for name, value in state.items():
            setattr(env, name, value)
        env = env.venv
    while isinstance(env, VecEnvWrapper):
        if _state_of(env):
            raise ValueError(
                f"The checkpoint holds nothing of {type(env).__name__}, which was not there when "
                "it was saved: wrap the env as at saving time"
            )
        env = env.venv


def restore_env(env: VecEnv, state: Any) -> None:
    inner = env.unwrapped
    if not hasattr(inner, "set_state"):
        raise ValueError(
            f"The checkpoint holds the state of its env, which {type(inner).__name__} cannot take "
            "(no set_state): pass an env of the class it was trained on"
        )
    inner.set_state(state)
