"""n environments moved by one kernel call: the state and the stepping of both vector forms.

Each row of the batch belongs to a :class:`~coop_env.env.CoopInsertionEnv` that works on it in
place; ``reset``, options, stages and attributes go through that object, so that there is no second
copy of any rule. Only the moves are made all at once.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import NoAsyncCallError, ResetNeeded
from numpy.typing import NDArray

from coop_env.compilation import report_compilation
from coop_env.env import CoopInsertionEnv, check_snapshot
from coop_env.errors import ActionError, ArgumentError, ResetOptionError, check_integer

Seeds = Sequence[int | None]
LARGEST_SEED = 2**63 - 1


class EnvBatch:
    """The environments of a batch and the arrays that their rows lie in.

    Pickled or copied it plays on as the original: states, observations, random generators, stages
    and a move that is taken but not made.

    Args:
        n_envs: number of environments.
        kind: their class, :class:`~coop_env.env.CoopInsertionEnv` or one of its own.
        kwargs: as for that class.

    Raises:
        ArgumentError: ``n_envs`` is no positive integer, a keyword is wrong, or the class moves or
            resets in a way of its own, of which a batch would know nothing.
    """

    def __init__(
        self, n_envs: int, kind: type[CoopInsertionEnv] = CoopInsertionEnv, **kwargs: Any
    ) -> None:
        for name in ("reset", "step", "action_masks"):
            if getattr(kind, name) is not getattr(CoopInsertionEnv, name):
                raise ArgumentError(
                    f"{kind.__name__} has a {name}() of its own, which a batch would pass by: "
                    "take Gymnasium's SyncVectorEnv or SB3's DummyVecEnv of single ones"
                )
        self.envs = [kind(**kwargs) for _ in range(check_integer("n_envs", n_envs, 1))]
        self.actions = np.zeros(n_envs, np.int64)
        self.pending = False
        self._share_rows()

    def _share_rows(self) -> None:
        """Move what the environments hold into rows of one array each, and let them work there."""
        first, n = self.envs[0], len(self.envs)
        self.packed, self.observation = first._packed, first._observation
        self.states = np.zeros(n, first._states.dtype)
        self.outcomes = np.zeros(n, first._outcomes.dtype)
        self.rows = np.zeros((n, self.observation.shape[1]), np.float32)
        for i, env in enumerate(self.envs):
            row = slice(i, i + 1)
            env._attach(self.states[row], self.outcomes[row], self.rows[row])
        self._started = False

    def __getstate__(self) -> dict[str, Any]:
        return {"envs": self.envs, "actions": self.actions, "pending": self.pending}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._share_rows()

    def __copy__(self) -> EnvBatch:
        return copy.deepcopy(self)  # two batches cannot have the same environments' rows

    @property
    def started(self) -> bool:
        """Whether every environment was reset."""
        self._started = self._started or all(env._started for env in self.envs)
        return self._started

    def _require_start(self) -> None:
        if not self.started:
            raise ResetNeeded("call reset() first: there are no running episodes")

    def check_options(self, options: Any) -> list[Any]:
        """One reset option for each environment, from one for all or a list of them.

        Raises:
            ResetOptionError: an option is malformed or does not fit its environment's stage, or the
                list has another length.
        """
        n = len(self.envs)
        if options is None or isinstance(options, Mapping):
            options = [options] * n
        if not isinstance(options, (list, tuple)) or len(options) != n:
            raise ResetOptionError(
                f"options = {options!r}: must be a mapping or a list of {n} of them"
            )
        for env, own in zip(self.envs, options, strict=True):
            env.check_options(own)
        return list(options)

    def reset(self, seeds: Seeds, options: Sequence[Any]) -> None:
        """Start all episodes; all options are checked before the first environment is touched.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken.
        """
        starts = [env.check_options(own) for env, own in zip(self.envs, options, strict=True)]
        drawn = [
            env._draw(start, seed)
            for env, start, seed in zip(self.envs, starts, seeds, strict=True)
        ]
        for env, states in zip(self.envs, drawn, strict=True):
            env._begin(states)
        self.pending = False

    def take(self, actions: Any) -> None:
        """Take the actions (n,) of the next :meth:`move`.

        Raises:
            ResetNeeded: an environment was never reset.
            ActionError: the shape is wrong, or an entry is no integer of the action space.
        """
        self._require_start()
        n_actions = int(self.envs[0].action_space.n)
        self.actions[:] = check_actions(actions, self.actions.size, n_actions)
        self.pending = True

    def move(self) -> NDArray[np.int64]:
        """Make the moves taken; the indices of the episodes that end with them.

        Raises:
            ResetNeeded: an environment was never reset.
            NoAsyncCallError: no actions were taken since the last move.
        """
        if not self.pending:
            self._require_start()
            raise NoAsyncCallError("step_wait() without step_async(): no actions", "step")
        self.pending = False
        self.envs[0].step_batch(
            self.states, self.actions, self.packed, self.observation, self.outcomes, self.rows
        )
        report_compilation()
        if self.envs[0].render_mode is not None:
            for env in self.envs:
                env._follow(env._tip())
        return np.flatnonzero(self.outcomes["terminated"] | self.outcomes["truncated"])

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all environments, (n, actions).

        Raises:
            ResetNeeded: an environment was never reset.
        """
        self._require_start()
        return self.envs[0]._masks_of(self.states)

    def set_attr(self, env: CoopInsertionEnv, name: str, value: Any) -> None:
        """Set an attribute (``stage``, say) of one of the environments.

        Raises:
            ArgumentError: the environments have no such attribute to set.
        """
        try:
            getattr(env, name)
            setattr(env, name, value)
        except AttributeError as error:
            raise ArgumentError(f"attribute {name!r} cannot be set: {error}") from error

    def render(self) -> list[Any]:
        """A frame of each environment, as its ``render_mode`` says."""
        return [env.render() for env in self.envs]

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
            StateError: the snapshot is of another batch: other arguments, another ``n_envs``.
        """
        check_snapshot(snapshot, self.get_state())
        self.actions[:], self.pending = snapshot["actions"], snapshot["pending"]
        self._started = False
        keys = ("started", "stages", "rngs")
        for i, (started, stage, rng) in enumerate(zip(*(snapshot[k] for k in keys), strict=True)):
            self.envs[i].set_state(
                {
                    "params": snapshot["params"],
                    "states": snapshot["states"][i : i + 1],
                    "observations": snapshot["observations"][i : i + 1],
                    "started": started,
                    "stage": stage,
                    "rng": rng,
                }
            )


def check_actions(actions: Any, n: int, n_actions: int) -> NDArray[Any]:
    """The actions (n,) of a batch, integers from 0 to ``n_actions - 1``.

    Raises:
        ActionError: the shape is wrong, or an entry is something else.
    """
    actions = np.asarray(actions)
    if actions.shape != (n,) or actions.dtype.kind not in "iu":
        raise ActionError(
            f"actions have shape {actions.shape} and type {actions.dtype}: must be {n} integers"
        )
    if actions.min() < 0 or actions.max() >= n_actions:
        raise ActionError(f"actions = {actions!r}: must lie within 0 to {n_actions - 1}")
    return actions


def check_seed(seed: Any) -> int | None:
    """A seed of numpy's generators, or None.

    Raises:
        ArgumentError: it is no integer, or negative.
    """
    return None if seed is None else check_integer("seed", seed, 0, LARGEST_SEED)


def seeds_of(seed: int | Sequence[int | None] | None, n: int) -> list[int | None]:
    """The seeds of n environments: ``seed + i``, entry i of a list, or None.

    Raises:
        ArgumentError: a seed is no integer, is negative, or the list has another length.
    """
    if isinstance(seed, Sequence):
        if len(seed) != n:
            raise ArgumentError(f"seed = {seed!r}: {len(seed)} seeds for {n} environments")
        return [check_seed(each) for each in seed]
    first = check_seed(seed)
    return [None if first is None else first + i for i in range(n)]
