"""Many environments moved by one kernel call, as Gymnasium's ``VectorEnv``.

Each row of the batch belongs to a :class:`~coop_env.env.CoopInsertionEnv` that works on it in
place: resets, options, stages and attributes go through that object, only moves are made all at
once. :mod:`coop_env.vector.vec_env` is SB3's side.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium.error import NoAsyncCallError, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv, check_snapshot
from coop_env.errors import (
    ActionError,
    ArgumentError,
    ResetOptionError,
    StateError,
    check_flag,
    check_integer,
)
from coop_env.simulation import batch

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Step = tuple[NDArray[np.float32], Floats, Bools, Bools, dict[str, Any]]

_SHARED = ("packed", "transform", "states", "outcomes", "rows")


class CoopInsertionVectorEnv(SyncVectorEnv):
    """``num_envs`` environments in one batch, each bit-identical to a single one of its seed.

    Autoreset is ``SAME_STEP``: the step that ends an episode returns the next one's first
    observation and ``info``, and ``infos`` has the last ones in ``final_obs`` and ``final_info``,
    and ``final_action_mask`` (num_envs, actions), each with its ``_`` mask of the rows that ended.

    Pickled or copied it plays on as the original, a move that is taken but not made included.

    Args:
        num_envs: number of environments.
        max_episode_steps: Gymnasium's limit, which ``make_vec`` gives; the smaller of it and
            ``max_moves`` holds, as with ``gymnasium.make``. Here it decides the observed time and
            the cost of a failure, too; there ``max_moves`` does.
        env_class: the environments' class; None takes the attribute of that name. Of a ``reset``
            of its own the state and the observation count, not what it adds to ``info``.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Raises:
        ArgumentError: ``num_envs`` is no positive integer, a keyword is wrong, or the class moves
            in a way of its own, of which a batch would know nothing.
    """

    envs: list[Any]
    env_class: type[CoopInsertionEnv] = CoopInsertionEnv

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        env_class: type[CoopInsertionEnv] | None = None,
        **kwargs: Any,
    ) -> None:
        limit = lesser_limit(max_episode_steps, "max_moves", kwargs.get("max_moves"))
        if limit is not None:
            kwargs["max_moves"] = limit
        self.env_class = env_class or self.env_class
        for name in ("step", "action_masks"):
            if getattr(self.env_class, name) is not getattr(CoopInsertionEnv, name):
                raise ArgumentError(
                    f"{self.env_class.__name__} has a {name}() of its own, which a batch would "
                    "pass by: take Gymnasium's SyncVectorEnv or SB3's DummyVecEnv of single ones"
                )
        n = check_integer("num_envs", num_envs, 1)
        make = partial(self.env_class, **kwargs)
        super().__init__([make] * n, autoreset_mode=AutoresetMode.SAME_STEP)
        self.actions = np.zeros(n, np.int64)
        self.pending = False
        self._share_rows()

    def _share_rows(self) -> None:
        """Move what the environments hold into rows of one array each, and let them work there."""
        first, n = self.envs[0], self.num_envs
        self.packed, self.transform = first._packed, first._observation
        self.states = np.zeros(n, first._states.dtype)
        self.outcomes = np.zeros(n, first._outcomes.dtype)
        self.rows = np.zeros((n, self.transform.shape[1]), np.float32)
        for i, env in enumerate(self.envs):
            for name in ("states", "outcomes", "rows"):
                row = getattr(self, name)[i : i + 1]
                row[:] = getattr(env, f"_{name}")
                setattr(env, f"_{name}", row)
        self._started = False  # cached, as every step asks for it

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _SHARED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._share_rows()

    def __copy__(self) -> CoopInsertionVectorEnv:
        return copy.deepcopy(self)  # two batches cannot have the same environments' rows

    def _require_start(self) -> None:
        self._started = self._started or all(env._started for env in self.envs)
        if not self._started:
            raise ResetNeeded("call reset() first: there are no running episodes")

    def check_options(self, options: Any) -> list[Any]:
        """Reset options, one for each environment, from one for all or a list of them.

        Raises:
            ResetOptionError: an option is malformed or does not fit its environment's stage, or the
                list has another length.
        """
        n = self.num_envs
        if options is None or isinstance(options, Mapping):
            options = [options] * n
        if not isinstance(options, (list, tuple)) or len(options) != n:
            raise ResetOptionError(
                f"options = {options!r}: must be a mapping or a list of {n} of them"
            )
        for env, own in zip(self.envs, options, strict=True):
            env.check_options(own)
        return list(options)

    def start(self, seeds: Sequence[int | None], options: Sequence[Any]) -> list[dict[str, Any]]:
        """Start all episodes, one after another; the ``info`` of each.

        Raises:
            ResetOptionError: an option is malformed, before anything is reset, or names a state
                that cannot be taken: then those before it are reset, and no move is pending.
        """
        self.check_options(options)
        self.pending = False
        given = enumerate(zip(seeds, options, strict=True))
        return [self.begin(i, seed=seed, options=own) for i, (seed, own) in given]

    def begin(self, i: int, **given: Any) -> dict[str, Any]:
        """Start an episode of environment i; its ``info``."""
        self.rows[i], info = self.envs[i].reset(**given)
        return dict(info)

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
        self.start(seeds_of(seed, self.num_envs), self.check_options(options))
        return self.rows.copy(), batch.make_columns(self.outcomes)

    def take(self, actions: Any) -> None:
        """Take the actions (num_envs,) of the next :meth:`move`; ResetNeeded, ActionError."""
        self._require_start()
        self.actions[:] = self._checked(actions)
        self.pending = True

    def _checked(self, actions: Any) -> NDArray[Any]:
        return check_actions(actions, self.num_envs, int(self.envs[0].action_space.n))

    def move(self) -> NDArray[np.int64]:
        """Make the moves taken; returns the indices of ended episodes. NoAsyncCallError if none."""
        if not self.pending:
            self._require_start()
            raise NoAsyncCallError("step_wait() without step_async(): no actions", "step")
        self.pending = False
        self.env_class.step_batch(
            self.states, self.actions, self.packed, self.transform, self.outcomes, self.rows
        )
        if self.render_mode is not None:
            for env in self.envs:
                env._follow(env._tip())
        return np.flatnonzero(self.outcomes["terminated"] | self.outcomes["truncated"])

    def step(self, actions: NDArray[Any]) -> Step:
        """Move ``actions (num_envs,)``; environments whose episode ends are reset.

        Returns:
            Observations, rewards, terminated, truncated and infos, each with ``num_envs`` rows.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: the shape is wrong, or an entry is no integer of the action space.
        """
        self.take(actions)
        ended = self.move()
        names = ("reward", "terminated", "truncated")
        rewards, terminated, truncated = (self.outcomes[name].copy() for name in names)
        infos = self._restart(ended) if ended.size else {}
        infos.update(batch.make_columns(self.outcomes))
        return self.rows.copy(), rewards, terminated, truncated, infos

    def _restart(self, ended: NDArray[np.int64]) -> dict[str, Any]:
        """Start the next episodes of some environments; what the last ones ended with."""
        these = np.zeros(self.num_envs, bool)
        these[ended] = True
        final = batch.make_columns(self.outcomes, these)
        observations = np.full(self.num_envs, None, object)
        masks = self.action_masks() & these[:, None]
        for i in ended.tolist():
            observations[i] = self.rows[i].copy()
            self.begin(i)
        infos = {"final_obs": observations, "final_info": final, "final_action_mask": masks}
        return infos | {f"_{key}": these.copy() for key in infos}

    def action_masks(self) -> Bools:
        """Action masks of all environments, (num_envs, actions)."""
        self._require_start()
        return self.envs[0]._masks_of(self.states)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute (``stage``, say): one value for all, or a list with one for each."""
        if not isinstance(values, (list, tuple)):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ArgumentError(f"{len(values)} values for {self.num_envs} environments")
        set_attributes(self.envs, name, values)

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot of all environments and of the move taken, if one is."""
        return {
            "params": self.envs[0].get_state()["params"],
            "states": self.states.copy(),
            "observations": self.rows.copy(),
            "actions": self.actions.copy(),
            "pending": self.pending,
            "started": [env._started for env in self.envs],
            "stages": [env.stage for env in self.envs],
            "rngs": [env.np_random.bit_generator.state for env in self.envs],
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a snapshot of :meth:`get_state`.

        Raises:
            StateError: the snapshot is of another batch, or damaged; the batch is left as it was.
        """
        before = self.get_state()
        check_snapshot(snapshot, before)
        try:
            self._go_to(snapshot)
        except (TypeError, ValueError) as error:
            self._go_to(before)
            raise StateError(f"the snapshot cannot be taken: {error}") from error

    def _go_to(self, snapshot: Mapping[str, Any]) -> None:
        self.actions[:] = self._checked(snapshot["actions"])
        self.pending = check_flag("pending", snapshot["pending"])
        self._started = False
        keys = ("started", "stages", "rngs")
        if any(len(snapshot[key]) != self.num_envs for key in keys):
            raise StateError(f"{', '.join(keys)} must have {self.num_envs} entries each")
        for i, env in enumerate(self.envs):
            own = {"params": snapshot["params"], "started": snapshot["started"][i]}
            own |= {"stage": snapshot["stages"][i], "rng": snapshot["rngs"][i]}
            own |= {key: snapshot[key][i : i + 1] for key in ("states", "observations")}
            env.set_state(own)


def set_attributes(envs: Sequence[Any], name: str, values: Sequence[Any]) -> None:
    """Set an attribute, a value for each environment, of all or of none; ArgumentError."""
    done: list[tuple[Any, Any]] = []
    try:
        before = [getattr(env, name) for env in envs]  # some may be there twice
        for env, old, value in zip(envs, before, values, strict=True):
            setattr(env, name, value)
            done.append((env, old))
    except Exception as error:
        for env, old in done:
            setattr(env, name, old)
        if isinstance(error, AttributeError):
            raise ArgumentError(f"attribute {name!r} cannot be set: {error}") from error
        raise


def lesser_limit(max_episode_steps: Any, name: str, own: Any) -> Any:
    """The smaller of Gymnasium's limit (None and -1: none) and ``own``, if there is one."""
    if max_episode_steps is None or max_episode_steps == -1:
        return own
    most = check_integer("max_episode_steps", max_episode_steps, 1)
    return most if own is None else min(most, check_integer(name, own, 1))


def check_actions(actions: Any, n: int, n_actions: int) -> NDArray[Any]:
    """The actions of a batch as an array (n,) of integers from 0 to ``n_actions - 1``."""
    actions = np.asarray(actions)
    if actions.shape != (n,) or actions.dtype.kind not in "iu":
        raise ActionError(
            f"actions have shape {actions.shape} and type {actions.dtype}: must be {n} integers"
        )
    if actions.min() < 0 or actions.max() >= n_actions:
        raise ActionError(f"actions = {actions!r}: must lie within 0 to {n_actions - 1}")
    return actions


def check_seed(seed: Any) -> int | None:
    """A seed of numpy's generators, or None."""
    return None if seed is None else check_integer("seed", seed, 0, 2**63 - 1)


def seeds_of(seed: int | Sequence[int | None] | None, n: int) -> list[int | None]:
    """The seeds of n environments: ``seed + i``, entry i of a list, or None."""
    if isinstance(seed, Sequence):
        if len(seed) != n:
            raise ArgumentError(f"seed = {seed!r}: {len(seed)} seeds for {n} environments")
        return [check_seed(each) for each in seed]
    first = check_seed(seed)
    return [None if first is None else first + i for i in range(n)]
