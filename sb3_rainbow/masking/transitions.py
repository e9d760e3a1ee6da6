"""What a step led to, before autoreset replaced it by the start of the next episode."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow.masking.conventions import TERMINAL_MASK_KEY, ActionMaskError, as_action_masks
from sb3_rainbow.type_aliases import ObsArray

LOST_MASK_WARNING = (
    f"A truncated episode came without info[{TERMINAL_MASK_KEY!r}]: its target allows all actions. "
    "In a SubprocVecEnv, wrap each env in sb3_rainbow.TerminalActionMask"
)


def with_terminal_observations(
    obs: ObsArray, dones: NDArray, infos: list[dict[str, Any]], normalizer: VecNormalize | None
) -> ObsArray:
    """Observations after the step, those of ended episodes from ``infos``; a copy.

    Args:
        obs: as the VecEnv returned them (unnormalized), ``(n_envs, ...)``, or a dict of such.
        dones: which episodes ended, ``(n_envs,)``.
        infos: hold ``"terminal_observation"``.
        normalizer: undoes its normalization of the terminal observations.
    """
    result = {k: v.copy() for k, v in obs.items()} if isinstance(obs, dict) else obs.copy()
    for env in np.flatnonzero(dones):
        terminal = infos[env].get("terminal_observation")
        if terminal is None:
            continue
        if normalizer is not None:
            terminal = normalizer.unnormalize_obs(terminal)
        if isinstance(result, dict):
            for key, part in result.items():
                part[env] = terminal[key]
        else:
            result[env] = terminal
    return result


def with_terminal_masks(
    masks: NDArray[np.bool_], dones: NDArray, infos: list[dict[str, Any]]
) -> tuple[NDArray[np.bool_], bool]:
    """Masks after the step, those of truncated episodes from ``infos``.

    Args:
        masks: of the current states, ``(n_envs, n_actions)``.
        dones: which episodes ended, ``(n_envs,)``.
        infos: hold ``"terminal_action_mask"``.

    Returns:
        a copy, and whether a truncated episode came without its mask.

    Raises:
        ActionMaskError: for a mask of another shape, or one that allows nothing.
    """
    if not dones.any():
        return masks, False
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
