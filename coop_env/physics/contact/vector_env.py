"""Many episodes of the contact task at once, as Gymnasium's ``VectorEnv``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from coop_env.errors import ActionError, check_integer
from coop_env.physics.contact.batch import FAILURES, ContactBatch
from coop_env.physics.contact.env import (
    CoopInsertionContactEnv,
    check_increments,
    make_machine,
    make_spaces,
    move,
)
from coop_env.physics.contact.task import ContactOptions, check_options, resolve_task
from coop_env.simulation.task import N_ACTIONS, N_AXES
from coop_env.vector.vector_env import seeds_of

Bools = NDArray[np.bool_]
Step = tuple[NDArray[np.float32], NDArray[np.float64], Bools, Bools, dict[str, Any]]


class CoopInsertionContactVectorEnv(VectorEnv[Any, Any, Any]):
    """``num_envs`` episodes stepped by MuJoCo's threads, each bit-identical to a single one.

    The engine's work, nine tenths of a step, runs in ``threads`` of them; what is around it is done
    for all episodes at once. Autoreset is ``SAME_STEP``: the step that ends an episode returns the
    next one's first observation and info, and ``infos`` has ``final_obs`` and ``final_info`` of the
    last. There is no rendering.

    Args:
        num_envs: number of environments.
        threads: of the simulation, at most as many as there are cores.
        max_episode_steps: Gymnasium's limit, which ``make_vec`` gives; the smaller of it and the
            task's ``max_steps`` holds.
        level: as for :class:`~coop_env.physics.contact.env.CoopInsertionContactEnv`.
        geometry: likewise.
        delta: likewise.
        holes: likewise.
        servos: likewise.

    Raises:
        ArgumentError: a number is no positive integer, or another argument is wrong.
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        **CoopInsertionContactEnv.metadata,
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    discrete = False

    def __init__(
        self,
        num_envs: int = 1,
        threads: int = 1,
        max_episode_steps: int | None = None,
        level: Any = "standard",
        geometry: Any = "optimized",
        delta: Any = None,
        holes: Any = None,
        servos: Any = None,
    ) -> None:
        self.task = resolve_task(level)
        limit = self.task.max_steps
        if max_episode_steps is not None:
            limit = min(limit, check_integer("max_episode_steps", max_episode_steps, 1))
        self.num_envs = check_integer("num_envs", num_envs, 1)
        made = make_machine(self.task, geometry, delta, holes, servos)
        self.batch = ContactBatch(self.task, made, self.num_envs, threads, limit)
        self.single_observation_space, self.single_action_space = make_spaces(self.discrete)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._rngs: list[np.random.Generator] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all episodes.

        Args:
            seed: environment i gets ``seed + i``, or entry i of a list; None goes on drawing.
            options: as for the single environment, for each of them.

        Raises:
            ResetOptionError: an option is malformed.
            ArgumentError: a seed is no integer, is negative, or the list has another length.
        """
        given = check_options(options, self.batch.starts)
        if seed is not None or not self._rngs:
            self._rngs = [seeding.np_random(each)[0] for each in seeds_of(seed, self.num_envs)]
        began = [self.batch.reset(row, given, rng) for row, rng in enumerate(self._rngs)]
        info = {name: np.array([each[name] for each in began]) for name in began[0]}
        return self.batch.observation.copy(), _masked(info, np.ones(self.num_envs, bool))

    def step(self, actions: Any) -> Step:
        """Make one control step in all environments; those whose episode ends start the next.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: an action is not in the action space.
        """
        if not self._rngs:
            raise ResetNeeded("call reset() first: there are no running episodes")
        outcome = self.batch.step(self._increments(actions), self._rngs)
        info = {
            "success": outcome.success,
            "is_success": outcome.success,
            "failure": np.array(FAILURES, object)[outcome.failure],
            **outcome.info,
            "hole": self.batch.hole.copy(),
            "friction": self.batch.friction.copy(),
            "error": self.batch.error.copy(),
        }
        ended = outcome.terminated | outcome.truncated
        found, observations = _masked(info, ~ended), outcome.observation
        if ended.any():
            final = np.full(self.num_envs, None, object)
            for row in np.flatnonzero(ended).tolist():
                final[row] = observations[row].copy()
                began = self.batch.reset(row, ContactOptions(), self._rngs[row])
                for name, value in began.items():
                    found[name][row], found[f"_{name}"][row] = value, True
            observations = self.batch.observation.copy()
            found |= {"final_obs": final, "final_info": _masked(info, ended),
                      "_final_obs": ended, "_final_info": ended.copy()}  # fmt: skip
        return observations, outcome.reward, outcome.terminated, outcome.truncated, found

    def _increments(self, actions: Any) -> Any:
        if not self.discrete:
            return check_increments(actions, (self.num_envs, N_AXES))
        found = np.asarray(actions)
        if found.shape != (self.num_envs,) or found.dtype.kind not in "iu":
            raise ActionError(f"actions = {actions!r}: must be {self.num_envs} integers")
        if found.min() < 0 or found.max() >= N_ACTIONS:
            raise ActionError(f"actions = {actions!r}: must lie within 0 to {N_ACTIONS - 1}")
        return np.array([move(action) for action in found.tolist()])

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self.batch.twin.close()


class CoopInsertionContactDiscreteVectorEnv(CoopInsertionContactVectorEnv):
    """The same in twelve moves; actions are (num_envs,) integers 0 to 11."""

    discrete = True


def _masked(columns: dict[str, Any], there: Bools) -> dict[str, Any]:
    """Gymnasium's form: zeros (or None) in rows that have no info, and a mask ``_key`` each."""
    found: dict[str, Any] = {}
    for name, part in columns.items():
        if isinstance(part, dict):
            found[name] = _masked(part, there)
        else:
            found[name] = np.full_like(part, None if part.dtype == object else 0)
            found[name][there] = part[there]
        found[f"_{name}"] = there.copy()
    return found
