"""The batched environment: n environments moved by one kernel call, as SB3's ``VecEnv``.

Each row of the batch belongs to a :class:`~coop_env.env.CoopInsertionEnv` that works on it in
place; ``reset``, options, stages and attributes go through that object, so that there is no second
copy of any rule. Only the moves are made all at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Wrapper
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
)

from coop_env.compilation import report_compilation
from coop_env.env import CoopInsertionEnv, check_snapshot
from coop_env.errors import ActionError, ArgumentError
from coop_env.simulation import batch, state
from coop_env.simulation.task import N_ACTIONS

StepReturn = tuple[
    NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]
]


class CoopInsertionVecEnv(VecEnv):
    """``n_envs`` environments in one batch, each bit-identical to a single one of its seed.

    An episode that ends is restarted at once; its last info then carries ``terminal_observation``,
    ``terminal_action_mask`` (the mask of the terminal state) and ``TimeLimit.truncated``.

    Args:
        n_envs: number of environments.
        seed: environment i gets ``seed + i`` at the first reset; None draws one.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Raises:
        ArgumentError: ``n_envs`` is no positive integer, or a keyword is wrong.
    """

    def __init__(self, n_envs: int, seed: int | None = None, **kwargs: Any) -> None:
        if isinstance(n_envs, bool) or not isinstance(n_envs, (int, np.integer)) or n_envs < 1:
            raise ArgumentError(f"n_envs = {n_envs!r}: must be an integer of at least 1")
        self.envs = [CoopInsertionEnv(**kwargs) for _ in range(n_envs)]
        first = self.envs[0]
        self.render_mode = first.render_mode
        self.metadata = first.metadata
        self._params, self._observation = (first.params, first._knobs), first._observation
        self._packed = first._packed
        self._states = np.zeros(n_envs, state.STATE)
        self._outcomes = np.zeros(n_envs, state.OUTCOME)
        self._rows = np.zeros((n_envs, self._observation.shape[1]), np.float32)
        self._actions = np.zeros(n_envs, np.int64)
        for i, env in enumerate(self.envs):
            row = slice(i, i + 1)
            env._attach(self._states[row], self._outcomes[row], self._rows[row])
        super().__init__(int(n_envs), first.observation_space, first.action_space)
        if seed is not None:
            self.seed(seed)

    def reset(self) -> NDArray[np.float32]:
        """Reset every environment, with the seeds and options set since the last reset."""
        for i, env in enumerate(self.envs):
            _, self.reset_infos[i] = env.reset(
                seed=self._seeds[i], options=self._options[i] or None
            )
        self._reset_seeds()
        self._reset_options()
        return self._rows.copy()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions (n_envs,) of the next :meth:`step_wait`.

        Raises:
            ActionError: the shape is wrong, or an entry is no integer 0 to 11.
        """
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise ActionError(
                f"actions have shape {actions.shape} and type {actions.dtype}: "
                f"must be {self.num_envs} integers"
            )
        if actions.min() < 0 or actions.max() >= N_ACTIONS:
            raise ActionError(f"actions = {actions!r}: must lie within 0 to {N_ACTIONS - 1}")
        self._actions[:] = actions

    def step(self, actions: NDArray[Any]) -> StepReturn:
        """Move ``actions (n_envs,)``: observations, rewards, dones, infos."""
        self.step_async(actions)
        return self.step_wait()

    def step_wait(self) -> StepReturn:
        """Move all environments; those whose episode ends are reset."""
        batch.step_batch(
            self._states, self._actions, self._packed, self._observation, self._outcomes, self._rows
        )
        report_compilation()
        outcomes = self._outcomes
        rewards = outcomes["reward"].astype(np.float32)
        dones = outcomes["terminated"] | outcomes["truncated"]
        infos = batch.make_infos(outcomes)
        for i in np.flatnonzero(dones).tolist():
            self._restart(i, infos[i], bool(outcomes["truncated"][i]))
        return self._rows.copy(), rewards, dones, infos

    def _restart(self, i: int, info: dict[str, Any], truncated: bool) -> None:
        info["TimeLimit.truncated"] = truncated
        info["terminal_observation"] = self._rows[i].copy()
        info["terminal_action_mask"] = self._states["mask"][i].astype(bool)
        _, self.reset_infos[i] = self.envs[i].reset()

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all environments, (n_envs, 12)."""
        return self._states["mask"].astype(bool)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the environments; see :class:`~coop_env.env.CoopInsertionEnv`."""
        if method_name == "action_masks" and indices is None and self.envs[0]._started:
            return list(self.action_masks())
        return [getattr(env, method_name)(*args, **kwargs) for env in self._targets(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each environment."""
        return [getattr(env, attr_name) for env in self._targets(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute (``stage``, say) of the environments.

        Raises:
            ArgumentError: the environments have no such attribute to set.
        """
        for env in self._targets(indices):
            try:
                getattr(env, attr_name)
                setattr(env, attr_name, value)
            except AttributeError as error:
                raise ArgumentError(f"attribute {attr_name!r} cannot be set: {error}") from error

    def _targets(self, indices: VecEnvIndices) -> list[CoopInsertionEnv]:
        return [self.envs[i] for i in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """False for each: the environments of a batch bear no wrappers."""
        return [False for _ in self._targets(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A frame of each environment, None without ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            return [None for _ in self.envs]
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Close all windows."""
        for env in self.envs:
            env.close()

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot of all environments, to resume from."""
        return {
            "params": self._params,
            "states": self._states.copy(),
            "envs": [env.get_state() for env in self.envs],
            "seeds": list(self._seeds),
            "options": list(self._options),
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a snapshot of :meth:`get_state`; the observations are written anew.

        Raises:
            StateError: the snapshot is of another batch: other arguments, another ``n_envs``.
        """
        check_snapshot(snapshot, self.get_state())
        for env, own in zip(self.envs, snapshot["envs"], strict=True):
            env.set_state(own)
        self._seeds = list(snapshot["seeds"])
        self._options = list(snapshot["options"])
