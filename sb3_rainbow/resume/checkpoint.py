"""What a checkpoint holds of the env and of the random generators, and the names of its parts."""

import os
import random
import warnings
import zipfile
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
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
    """Names of an archive's members; empty for a file that is no archive."""
    if not zipfile.is_zipfile(path):
        return set()
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def is_checkpoint(path: str | os.PathLike[str]) -> bool:
    """Whether ``Rainbow.save_checkpoint`` wrote a file."""
    return members(path) == {MODEL, REPLAY, ENV}


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """States of all global random generators and of the model's action space, for the warm-up."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": th.get_rng_state(),
        # asking a GPU that nothing was drawn on would start it, which a forked process cannot
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """Put the generators back to a state of :func:`get_rng_state`."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(state["torch"])
    if state.get("cuda") and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    action_space.np_random.bit_generator.state = state["action_space"]


def _state_of(env: VecEnv) -> list[str]:
    """Names of the attributes that hold the state of one of SB3's wrappers, none of others."""
    states = (names for kind, names in _WRAPPER_STATE.items() if isinstance(env, kind))
    return [name for names in states for name in names]


def env_state(env: VecEnv | None) -> dict[str, Any]:
    """State of the innermost env, None where it gives none, and of SB3's wrappers around it."""
    state: dict[str, Any] = {"env": None, "wrappers": []}
    if env is not None and hasattr(env.unwrapped, "get_state"):
        state["env"] = env.unwrapped.get_state()
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


def restore_env(env: VecEnv, state: dict[str, Any]) -> None:
    """Put a state of :func:`env_state` back.

    Raises:
        ValueError: if the env is not wrapped as it was, or cannot take a state.
    """
    outermost = env
    for wrapper in state["wrappers"]:
        if not isinstance(env, VecEnvWrapper) or not set(wrapper) <= set(_state_of(env)):
            raise ValueError(
                f"The checkpoint holds {', '.join(wrapper) or 'nothing'} of a wrapper, but "
                f"{type(env).__name__} stands in its place: wrap the env as at saving time"
            )
        for name, value in wrapper.items():
            setattr(env, name, value)
        env = env.venv
    while isinstance(env, VecEnvWrapper):
        if _state_of(env):
            raise ValueError(
                f"The checkpoint holds nothing of {type(env).__name__}, which was not there when "
                "it was saved: wrap the env as at saving time"
            )
        env = env.venv
    if state["env"] is None:
        return
    inner = outermost.unwrapped
    if not hasattr(inner, "set_state"):
        raise ValueError(
            f"The checkpoint holds the state of its env, which {type(inner).__name__} cannot take "
            "(no set_state): pass an env of the class it was trained on"
        )
    inner.set_state(state["env"])
