"""The batched environment as SB3's ``VecEnv``; :mod:`coop_env.vector.env_batch` moves it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import Wrapper
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
)

from coop_env.env import CoopInsertionEnv, check_snapshot
from coop_env.simulation import batch
from coop_env.vector.env_batch import EnvBatch, check_seed

StepReturn = tuple[
    NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]
]


class CoopInsertionVecEnv(VecEnv):
    """``n_envs`` environments in one batch, each bit-identical to a single one of its seed.

    An episode that ends is restarted at once; its last info then carries ``terminal_observation``,
    ``terminal_action_mask`` (the mask of the terminal state) and ``TimeLimit.truncated``. Pickled
    or deep-copied, the batch plays on as the original would.

    Args:
        n_envs: number of environments.
        seed: environment i gets ``seed + i`` at the first reset; None draws one.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Raises:
        ArgumentError: ``n_envs`` is no positive integer, or a keyword is wrong.
    """

    env_class: ClassVar[type[CoopInsertionEnv]] = CoopInsertionEnv

    def __init__(self, n_envs: int, seed: int | None = None, **kwargs: Any) -> None:
        self._batch = EnvBatch(n_envs, self.env_class, **kwargs)
        first = self.envs[0]
        self.render_mode = first.render_mode
        self.metadata = first.metadata
        super().__init__(int(n_envs), first.observation_space, first.action_space)
        if seed is not None:
            self.seed(seed)

    @property
    def envs(self) -> list[CoopInsertionEnv]:
        """The environments that work on the batch's rows."""
        return self._batch.envs

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds of the next reset: environment i gets ``seed + i``; None draws one.

        Raises:
            ArgumentError: the seed is no integer, or negative.
        """
        return super().seed(check_seed(seed))

    def set_options(self, options: Any = None) -> None:
        """Reset options of the next reset: one mapping for all, or a list with one for each.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken; the
                options set before are kept.
        """
        super().set_options([own or {} for own in self._batch.check_options(options)])

    def reset(self) -> NDArray[np.float32]:
        """Reset every environment, with the seeds and options set since the last reset."""
        self._batch.reset(self._seeds, self._options)
        self.reset_infos = batch.make_infos(self._batch.outcomes)
        self._reset_seeds()
        self._reset_options()
        return self._batch.rows.copy()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions (n_envs,) of the next :meth:`step_wait`.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: the shape is wrong, or an entry is no integer of the action space.
        """
        self._batch.take(actions)

    def step(self, actions: NDArray[Any]) -> StepReturn:
        """Move ``actions (n_envs,)``: observations, rewards, dones, infos."""
        self.step_async(actions)
        return self.step_wait()

    def step_wait(self) -> StepReturn:
        """Move all environments; those whose episode ends are reset.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            NoAsyncCallError: there was no :meth:`step_async` since the last call.
        """
        ended = self._batch.move()
        outcomes = self._batch.outcomes
        rewards = outcomes["reward"].astype(np.float32)
        infos = batch.make_infos(outcomes)
        dones = np.zeros(self.num_envs, bool)
        dones[ended] = True
        for i in ended.tolist():
            self._restart(i, infos[i], bool(outcomes["truncated"][i]))
        return self._batch.rows.copy(), rewards, dones, infos

    def _restart(self, i: int, info: dict[str, Any], truncated: bool) -> None:
        info["TimeLimit.truncated"] = truncated
        info["terminal_observation"] = self._batch.rows[i].copy()
        info["terminal_action_mask"] = self.envs[i].action_masks()
        _, self.reset_infos[i] = self.envs[i].reset()

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all environments, (n_envs, actions)."""
        return self._batch.action_masks()

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the environments; see :class:`~coop_env.env.CoopInsertionEnv`."""
        if method_name == "action_masks" and indices is None:
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
            self._batch.set_attr(env, attr_name, value)

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
        return self._batch.render()

    def close(self) -> None:
        """Nothing is open that needs closing."""

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot of all environments, to resume from."""
        own = {"seeds": list(self._seeds), "options": list(self._options)}
        return {**self._batch.get_state(), **own}

    def set_state(self, snapshot: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return to a snapshot of :meth:`get_state`.

        Returns:
            The observations (n_envs, size) of those states, with the noise they had. An SB3
            algorithm that is to go on from here must take them for its ``_last_obs``.

        Raises:
            StateError: the snapshot is of another batch: other arguments, another ``n_envs``.
        """
        check_snapshot(snapshot, self.get_state())
        own = {"seeds", "options"}
        self._batch.set_state({key: snapshot[key] for key in snapshot if key not in own})
        self._seeds = list(snapshot["seeds"])
        self._options = list(snapshot["options"])
        return self._batch.rows.copy()
