"""Action masks as in sb3-contrib, and the masks and observations that autoreset would lose."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize

from sb3_rainbow.type_aliases import ObsArray

TERMINAL_MASK_KEY = "terminal_action_mask"
LOST_MASK_WARNING = (
    f"A truncated episode came without info[{TERMINAL_MASK_KEY!r}]: its target allows all actions. "
    "In a SubprocVecEnv, wrap each env in sb3_rainbow.TerminalActionMask"
)


class ActionMaskError(ValueError):
    """Action masks of a wrong shape or kind, or that allow nothing."""


# Attributes that every Gymnasium wrapper has itself
_OWN = {"env", "_action_space", "_observation_space", "_metadata", "_cached_spec"}


class TerminalActionMask(gym.Wrapper):
    """Put the mask of an episode's last state into ``info["terminal_action_mask"]``.

    A ``VecEnv`` resets an env at the end of its episode, after which ``action_masks()`` describes
    the next episode's first state; a truncated episode's target needs the mask of its last one.
    Rainbow wraps the envs of a ``DummyVecEnv`` by itself. In a ``SubprocVecEnv`` they live in other
    processes: wrap them there, ``make_vec_env(..., wrapper_class=TerminalActionMask)``. Everything
    else passes through; setting an attribute sets it on the layer below that has it.
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the env; where the episode was truncated, add the mask to ``info``."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        # No target looks at a terminated state's mask, and many envs have none to give there.
        if truncated and not terminated:
            mask = np.array(self.env.get_wrapper_attr("action_masks")(), dtype=bool)
            info = {**info, TERMINAL_MASK_KEY: mask}
        return obs, reward, terminated, truncated, info

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name in _OWN:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self.env.get_wrapper_attr(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("__") or name in _OWN:
            super().__setattr__(name, value)
        else:
            self.env.set_wrapper_attr(name, value)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """As Gymnasium's, among the layers below: this wrapper seems to have all that they have."""
        return self.env.set_wrapper_attr(name, value, force=force)


def has_masks(env: VecEnv) -> bool:
    """Whether an env gives masks, as far as it can be asked.

    A user's own ``VecEnv`` may know the attributes alone that SB3 asks for: of others it says None,
    or raises.
    """
    try:
        supported: bool = is_masking_supported(env)
        # a SubprocVecEnv, which knows them all, would send its envs along with their method
        if supported and type(env.unwrapped).has_attr is VecEnv.has_attr:
            return all(method is not None for method in env.get_attr("action_masks"))
        return supported
    except Exception:
        return False


def capture_terminal_masks(env: VecEnv) -> None:
    """Wrap the envs of a ``DummyVecEnv`` in :class:`TerminalActionMask` where they have masks."""
    inner = env.unwrapped
    while isinstance(env, VecEnvWrapper):
        if type(env).env_method is not VecEnvWrapper.env_method:
            return  # it may change the masks, those of a last state too
        env = env.venv
    if not isinstance(inner, DummyVecEnv) or not is_masking_supported(inner):
        return
    for i, env_of_row in enumerate(inner.envs):
        if type(env_of_row) is not TerminalActionMask:  # one further in misses outer changes
            inner.envs[i] = TerminalActionMask(env_of_row)


def as_action_masks(masks: ArrayLike, n_envs: int, n_actions: int) -> NDArray[np.bool_]:
    """Check masks and return them as booleans, ``(n_envs, n_actions)``.

    A mask of shape ``(1, n_actions)`` for each env is accepted, as in sb3-contrib.

    Raises:
        ActionMaskError: for another shape, for entries other than False and True (0 and 1), or for
            a row that allows no action.
    """
    given = np.asarray(masks)
    checked = given.astype(bool, copy=False)
    if given.dtype != np.bool_ and not np.array_equal(given, checked):
        raise ActionMaskError(
            "An action mask holds True or False (1 or 0) for each action, not "
            f"{given[given != checked].flat[0]}: is it a list of actions?"
        )
    if checked.shape == (n_envs, 1, n_actions):
        checked = checked[:, 0]
    if checked.shape != (n_envs, n_actions):
        raise ActionMaskError(
            f"Action masks must have shape {(n_envs, n_actions)} (envs, actions), "
            f"got {checked.shape}"
        )
    allowed = checked.any(axis=1)
    if not allowed.all():
        raise ActionMaskError(
            f"The action mask of env {int(np.argmin(allowed))} allows no action; at least one must "
            "be True (if nothing is valid, let action_masks() return all True)"
        )
    return checked


def with_terminal_observations(
    obs: ObsArray, dones: NDArray, infos: list[dict[str, Any]], normalizer: VecNormalize | None
) -> ObsArray:
    """A copy of unnormalized observations after the step, with those that episodes ended in.

    The normalizer undoes what it did to ``info["terminal_observation"]``.
    """
    result = {k: v.copy() for k, v in obs.items()} if isinstance(obs, dict) else obs.copy()
    parts: Any = result if isinstance(result, dict) else {None: result}
    for env in np.flatnonzero(dones):
        terminal = infos[env].get("terminal_observation")
        if terminal is None:
            continue
        if normalizer is not None:
            terminal = normalizer.unnormalize_obs(terminal)
        for key, part in parts.items():
            value = terminal if key is None else terminal[key]
            whole = part.dtype.kind in "biu"  # a normalizer's way there and back rounds
            part[env] = np.rint(np.asarray(value)) if whole else value
    return result


def with_terminal_masks(
    masks: NDArray[np.bool_], dones: NDArray, infos: list[dict[str, Any]]
) -> tuple[NDArray[np.bool_], bool]:
    """A copy of the masks ``(n_envs, n_actions)`` after the step, with those of the states that
    were truncated, and whether one of them is unknown.

    Raises:
        ActionMaskError: for a mask of another shape, or one that allows nothing.
    """
    masks = masks.copy()
    lost = False
    for env in np.flatnonzero(dones):
        # A terminated episode's target never looks at the mask: its state may allow nothing.
        masks[env] = True
        if infos[env].get("TimeLimit.truncated", False):
            mask = infos[env].get(TERMINAL_MASK_KEY)
            if mask is None:
                lost = True
                continue
            given = np.reshape(mask, (1, -1))
            if not given.any():
                raise ActionMaskError(
                    f"An episode of env {env} was truncated in a state whose action mask allows no "
                    "action, so its return cannot go on from there: report the state as "
                    "terminated, or let action_masks() return all True"
                )
            masks[env] = as_action_masks(given, 1, masks.shape[1])[0]
    return masks, lost
