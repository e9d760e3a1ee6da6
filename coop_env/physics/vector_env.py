"""Many episodes with real contact at once, as Gymnasium's ``VectorEnv``."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from coop_env.errors import check_integer
from coop_env.physics.batch import PhysicsBatch, row_of
from coop_env.physics.contact import ContactBatch
from coop_env.physics.env import PhysicsEnv, check_increments, make_spaces, move
from coop_env.physics.whole import WholeBatch
from coop_env.simulation.batch import masked
from coop_env.simulation.task import N_ACTIONS, N_AXES
from coop_env.vector.vector_env import check_actions, lesser_limit, seeds_of

Bools = NDArray[np.bool_]
Step = tuple[Any, NDArray[np.float64], Bools, Bools, dict[str, Any]]


class PhysicsVectorEnv(VectorEnv[Any, Any, Any]):
    """``num_envs`` episodes stepped by MuJoCo's threads, each bit-identical to a single one.

    Autoreset is ``SAME_STEP``: the step that ends an episode returns the next one's first
    observation and info, and ``infos`` has ``final_obs`` and ``final_info`` of the last. There is
    no rendering.

    Args:
        num_envs: number of environments.
        threads: of the simulation, at most as many as there are cores.
        max_episode_steps: from ``make_vec``; the smaller of it and the task's limit holds.
        arguments: of the single environment, without ``render_mode``.

    Raises:
        ArgumentError: a number is no positive integer, or another argument is wrong.
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        **PhysicsEnv.metadata,
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    batch_class: type[PhysicsBatch] = ContactBatch
    discrete = False

    def __init__(
        self, num_envs: int = 1, threads: int = 1, max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:  # fmt: skip
        self.num_envs = check_integer("num_envs", num_envs, 1)
        self.batch = self.batch_class(n=num_envs, threads=threads, **arguments)
        self.task = self.batch.task
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.task.dt))}
        limit = lesser_limit(max_episode_steps, "max_steps", self.batch.max_steps)
        self.batch.max_steps = limit
        single = make_spaces(self.batch, self.discrete)
        self.single_observation_space, self.single_action_space = single
        self.observation_space, self.action_space = (batch_space(s, num_envs) for s in single)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:  # fmt: skip
        """Start all episodes.

        Args:
            seed: environment i gets ``seed + i``, or entry i of a list; None goes on drawing.
            options: as for the single environment, for each of them.

        Raises:
            ResetOptionError: an option is malformed.
            ArgumentError: a seed is no integer, is negative, or the list has another length.
        """
        checked = self.batch.check_options(options)
        rngs = [
            old if old is not None and each is None else seeding.np_random(each)[0]
            for old, each in zip(self.batch.rngs, seeds_of(seed, self.num_envs), strict=True)
        ]
        firsts = [self.batch.reset(row, checked, rng) for row, rng in enumerate(rngs)]
        info = {name: part for name, part in self.batch.columns().items() if name in firsts[0]}
        return self.batch.seen(slice(None)), masked(info, np.ones(self.num_envs, bool))

    def step(self, actions: Any) -> Step:
        """Make one control step in all environments; those whose episode ends start the next.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: an action is not in the action space.
        """
        if None in self.batch.rngs:
            raise ResetNeeded("call reset() first: there are no running episodes")
        outcome = self.batch.step(self._increments(actions))
        ended = outcome.terminated | outcome.truncated
        infos, observations = masked(outcome.info, ~ended), outcome.observation
        if ended.any():
            final = np.full(self.num_envs, None, object)
            options = self.batch.check_options(None)
            for row in np.flatnonzero(ended).tolist():
                final[row] = row_of(observations, row)
                first = self.batch.reset(row, options, self.batch.rngs[row])
                seen = self.batch.seen(slice(row, row + 1))
                for whole, new in zip(_arrays(observations), _arrays(seen), strict=True):
                    whole[row] = new[0]
                for name, value in first.items():
                    if not isinstance(value, dict):
                        infos[name][row], infos[f"_{name}"][row] = value, True
            infos |= {"final_obs": final, "final_info": masked(outcome.info, ended),
                      "_final_obs": ended, "_final_info": ended.copy()}  # fmt: skip
        return observations, outcome.reward, outcome.terminated, outcome.truncated, infos

    def _increments(self, actions: Any) -> Any:
        if not self.discrete:
            return check_increments(actions, (self.num_envs, N_AXES))
        return np.array([move(a) for a in check_actions(actions, self.num_envs, N_ACTIONS)])

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self.batch.twin.close()


class CoopInsertionContactVectorEnv(PhysicsVectorEnv):
    """Many :class:`~coop_env.physics.env.CoopInsertionContactEnv`."""


class CoopInsertionContactDiscreteVectorEnv(PhysicsVectorEnv):
    """Many of them in twelve moves; actions are (num_envs,) integers 0 to 11."""

    discrete = True


class CoopInsertionPhysicsVectorEnv(PhysicsVectorEnv):
    """Many :class:`~coop_env.physics.env.CoopInsertionPhysicsEnv`."""

    batch_class = WholeBatch


def _arrays(observations: Any) -> list[Any]:
    return list(observations.values()) if isinstance(observations, dict) else [observations]
