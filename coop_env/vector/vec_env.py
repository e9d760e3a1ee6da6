"""The batched environment as SB3's ``VecEnv``: :mod:`coop_env.vector.vector_env` moves it."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from gymnasium import Wrapper, spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from coop_env.env import CoopInsertionEnv, check_snapshot
from coop_env.errors import StateError, check_integer
from coop_env.simulation import batch
from coop_env.vector import vector_env

Rows = NDArray[np.float32]
Infos = list[dict[str, Any]]


class CoopInsertionVecEnv(VecEnv):
    """``n_envs`` environments in one batch, each bit-identical to a single one of its seed.

    An episode that ends is restarted at once; its last info then carries ``terminal_observation``,
    ``terminal_action_mask`` (the mask of the terminal state) and ``TimeLimit.truncated``. Pickled
    or copied, the batch plays on as the original would.

    Args:
        n_envs: number of environments.
        seed: environment i gets ``seed + i`` at the first reset; None draws one.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Attributes:
        env_class: the environments' class.
        rows_each: rows of each environment, one for each of its agents.

    Raises:
        ArgumentError: ``n_envs`` is no positive integer, or a keyword is wrong.
    """

    env_class: ClassVar[type[CoopInsertionEnv]] = CoopInsertionEnv
    rows_each: ClassVar[int] = 1

    def __init__(self, n_envs: int, seed: int | None = None, **kwargs: Any) -> None:
        n = check_integer("n_envs", n_envs, 1)
        self._vector = vector_env.CoopInsertionVectorEnv(n, env_class=self.env_class, **kwargs)
        super().__init__(n * self.rows_each, *self._make_spaces())
        self.metadata = self.envs[0].metadata  # a recorder asks for the frames a second
        if seed is not None:
            self.seed(seed)

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def _make_spaces(self) -> tuple[spaces.Box, spaces.Discrete]:
        """Spaces of a row's observation and action."""
        return self.envs[0].observation_space, self.envs[0].action_space

    @property
    def envs(self) -> list[Any]:
        """The environments that work on the batch's rows."""
        return self._vector.envs

    def _observed(self, rows: Rows) -> Rows:
        """The agents' observations (n * rows_each, size) from the environments' (n, fields)."""
        return rows.copy()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds of the next reset: environment i gets ``seed + i``; None draws one."""
        seeds = list(super().seed(vector_env.check_seed(seed)))
        self._seeds = self._spread(seeds[: len(self.envs)])
        return self._seeds

    def _spread(self, each: Sequence[Any]) -> list[Any]:
        """A list with an entry per row, from one per environment."""
        return [own for own in each for _ in range(self.rows_each)]

    def set_options(self, options: Any = None) -> None:
        """Options of the next reset: a mapping for all, or a list, one for each environment.

        Raises:
            ResetOptionError: one is malformed or cannot be taken; those set before are kept.
        """
        given = [own or {} for own in self._vector.check_options(options)]
        super().set_options(self._spread(given))

    def reset(self) -> Rows:
        """Reset every environment, with the seeds and options set since the last reset."""
        k = self.rows_each
        infos = self._vector.start(self._seeds[::k], self._options[::k])
        self.reset_infos = [dict(info) for info in self._spread(infos)]
        self._reset_seeds()
        self._reset_options()
        return self._observed(self._vector.rows)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions (num_envs,) of the next :meth:`step_wait`.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: the shape is wrong, or an entry is no integer of the action space.
        """
        self._vector.take(actions)

    def step_wait(self) -> tuple[Rows, Rows, NDArray[np.bool_], Infos]:
        """Move all environments; those whose episode ends are reset.

        Raises:
            NoAsyncCallError: there was no :meth:`step_async` since the last call.
        """
        ended = self._vector.move()
        outcomes, k = self._vector.outcomes, self.rows_each
        rewards = outcomes["reward"].astype(np.float32)
        infos = batch.make_infos(outcomes)
        if k > 1:  # a dictionary for each row: SB3's wrappers write into them
            infos = [dict(info) for info in self._spread(infos)]
        dones = np.zeros(len(self.envs), bool)
        dones[ended] = True
        for i in ended.tolist():
            rows = slice(k * i, k * (i + 1))
            last = self._observed(self._vector.rows[i : i + 1])
            masks = self.envs[i].action_masks().reshape(k, -1)
            for info, observation, mask in zip(infos[rows], last, masks, strict=True):
                info["TimeLimit.truncated"] = bool(outcomes["truncated"][i])
                info["terminal_observation"] = observation
                info["terminal_action_mask"] = mask
            first = self._vector.begin(i)
            self.reset_infos[rows] = [dict(first) for _ in range(k)]
        return self._observed(self._vector.rows), rewards.repeat(k), dones.repeat(k), infos

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all rows, (num_envs, actions)."""
        return self._vector.action_masks().reshape(self.num_envs, -1)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the rows' environments; ``action_masks`` gives each row its own."""
        if method_name == "action_masks":
            masks = self.action_masks()
            return list(masks if indices is None else masks[list(self._get_indices(indices))])
        return [getattr(env, method_name)(*args, **kwargs) for env in self._targets(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each row's environment."""
        return [getattr(env, attr_name) for env in self._targets(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute (``stage``, say) of the rows' environments, of all or of none."""
        targets = self._targets(indices)
        vector_env.set_attributes(targets, attr_name, [value] * len(targets))

    def _targets(self, indices: VecEnvIndices) -> list[Any]:
        return [self.envs[i // self.rows_each] for i in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """False for each: the environments of a batch bear no wrappers."""
        return [False] * len(self._targets(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A frame of each environment, None without ``render_mode="rgb_array"``."""
        if self.render_mode != "rgb_array":
            return [None for _ in self.envs]
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Nothing is open that needs closing."""

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot of all environments, to resume from."""
        k = self.rows_each
        return {
            **self._vector.get_state(),
            "seeds": list(self._seeds[::k]),
            "options": list(self._options[::k]),
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> Rows:
        """Return to a snapshot of :meth:`get_state`.

        Returns:
            The observations (num_envs, size) of those states, with the noise they had. An SB3
            algorithm that is to go on from here must take them for its ``_last_obs``.

        Raises:
            StateError: the snapshot is of another batch, or damaged; the batch is left as it was.
        """
        check_snapshot(snapshot, self.get_state())
        rest = dict(snapshot)
        seeds, options, n = rest.pop("seeds"), rest.pop("options"), len(self.envs)
        try:
            seeds = vector_env.seeds_of(list(seeds), n)
        except (TypeError, ValueError) as error:
            raise StateError(f"the snapshot's seeds are damaged: {error}") from error
        fit = isinstance(options, list) and len(options) == n
        if not (fit and all(isinstance(own, Mapping) for own in options)):
            raise StateError(f"the snapshot's options = {options!r}: must be {n} mappings")
        self._vector.set_state(rest)
        self._seeds, self._options = self._spread(seeds), self._spread(options)
        return self._observed(self._vector.rows)
