"""The batched environment as Gymnasium's ``VectorEnv``, what ``gymnasium.make_vec`` makes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError, check_integer
from coop_env.simulation import batch
from coop_env.vector.env_batch import EnvBatch, seeds_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Step = tuple[NDArray[np.float32], Floats, Bools, Bools, dict[str, Any]]


class CoopInsertionVectorEnv(VectorEnv[Any, Any, Any]):
    """``num_envs`` environments in one batch, each bit-identical to a single one of its seed.

    Autoreset is ``SAME_STEP``: the step that ends an episode returns the next one's first
    observation and ``info``, and ``infos`` has the last ones in ``final_obs`` and ``final_info``,
    and ``final_action_mask`` (num_envs, actions), each with its ``_`` mask of the rows that ended.

    Args:
        num_envs: number of environments.
        max_episode_steps: Gymnasium's limit, which ``make_vec`` gives; the smaller of it and
            ``max_moves`` holds, as with ``gymnasium.make``.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Raises:
        ArgumentError: ``num_envs`` is no positive integer, or a keyword is wrong.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        **CoopInsertionEnv.metadata,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    env_class: ClassVar[type[CoopInsertionEnv]] = CoopInsertionEnv

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = None, **kwargs: Any
    ) -> None:
        if max_episode_steps is not None:
            limit = check_integer("max_episode_steps", max_episode_steps, 1)
            moves = check_integer("max_moves", kwargs.get("max_moves", limit), 1)
            kwargs["max_moves"] = min(moves, limit)
        self._batch = EnvBatch(num_envs, self.env_class, **kwargs)
        first = self.envs[0]
        self.num_envs = int(num_envs)
        self.render_mode = first.render_mode
        self.metadata = {**type(self).metadata, "render_fps": first.metadata["render_fps"]}
        self.single_observation_space = first.observation_space
        self.single_action_space = first.action_space
        self.observation_space = batch_space(first.observation_space, self.num_envs)
        self.action_space = batch_space(first.action_space, self.num_envs)

    @property
    def envs(self) -> list[CoopInsertionEnv]:
        """The environments that work on the batch's rows."""
        return self._batch.envs

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all episodes.

        Args:
            seed: environment i gets ``seed + i``, or entry i of a list; None draws them.
            options: as for the single environment, for each of them.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken.
            ArgumentError: a seed is no integer, is negative, or the list has another length.
        """
        given = self._batch.check_options(options)
        seeds = seeds_of(seed, self.num_envs)
        if seed is not None and not isinstance(seed, Sequence):
            super().reset(seed=seeds[0])
        self._batch.reset(seeds, given)
        return self._batch.rows.copy(), batch.make_columns(self._batch.outcomes)

    def step(self, actions: NDArray[Any]) -> Step:
        """Move ``actions (num_envs,)``; environments whose episode ends are reset.

        Returns:
            Observations, rewards, terminated, truncated and infos, each with ``num_envs`` rows.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: the shape is wrong, or an entry is no integer of the action space.
        """
        self._batch.take(actions)
        ended = self._batch.move()
        outcomes = self._batch.outcomes
        rewards = outcomes["reward"].copy()
        terminated, truncated = outcomes["terminated"].copy(), outcomes["truncated"].copy()
        infos = self._restart(ended) if ended.size else {}
        infos.update(batch.make_columns(outcomes))
        return self._batch.rows.copy(), rewards, terminated, truncated, infos

    def _restart(self, ended: NDArray[np.int64]) -> dict[str, Any]:
        """Start the next episodes of the environments given; what the last ones ended with."""
        these = np.zeros(self.num_envs, bool)
        these[ended] = True
        final = np.zeros_like(self._batch.outcomes)
        final[ended] = self._batch.outcomes[ended]
        observations = np.full(self.num_envs, None, object)
        masks = self._batch.action_masks() & these[:, None]
        for i in ended.tolist():
            observations[i] = self._batch.rows[i].copy()
            self.envs[i].reset()
        infos = {
            "final_obs": observations,
            "final_info": batch.make_columns(final, these),
            "final_action_mask": masks,
        }
        return infos | {f"_{key}": these.copy() for key in infos}

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all environments, (num_envs, actions)."""
        return self._batch.action_masks()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment; an attribute is returned as it is."""
        found = [getattr(env, name) for env in self.envs]
        return tuple(each(*args, **kwargs) if callable(each) else each for each in found)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of each environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute (``stage``, say): one value for all, or a list with one for each.

        Raises:
            ArgumentError: the environments have no such attribute, or the list another length.
        """
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ArgumentError(f"{len(values)} values for {self.num_envs} environments")
        for env, value in zip(self.envs, values, strict=True):
            self._batch.set_attr(env, name, value)

    def render(self) -> tuple[Any, ...] | None:
        """A frame of each environment, as ``render_mode`` says."""
        return tuple(self._batch.render())
