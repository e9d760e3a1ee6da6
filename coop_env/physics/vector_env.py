"""Many episodes with real contact at once, as Gymnasium's ``VectorEnv``."""

import copy
from collections.abc import Sequence
from functools import partial
from typing import Any, Self

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from coop_env.errors import check_integer
from coop_env.physics.batch import PhysicsBatch
from coop_env.physics.contact import ContactBatch
from coop_env.physics.env import PhysicsRow, check_increments, move
from coop_env.physics.task import split_options
from coop_env.physics.whole import WholeBatch
from coop_env.simulation.task import N_ACTIONS, N_AXES
from coop_env.vector.vector_env import check_actions, lesser_limit, seeds_of


class PhysicsVectorEnv(SyncVectorEnv):
    """``num_envs`` episodes stepped by MuJoCo's threads, each bit-identical to a single one.

    Autoreset is ``SAME_STEP``: the step that ends an episode returns the next one's first
    observation and info, and ``infos`` has ``final_obs`` and ``final_info`` of the last. There is
    no rendering.

    Args:
        num_envs: number of environments.
        threads: of the simulation, at most as many as there are cores.
        max_episode_steps: from ``make_vec``; the smaller of it and the task's limit holds, and is
            the task's: rows equal single environments of that ``max_steps``.
        arguments: of the single environment, without ``render_mode``.

    Raises:
        ArgumentError: a number is no positive integer, or another argument is wrong.
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.
    """

    batch_class: type[PhysicsBatch] = ContactBatch
    discrete = False

    def __init__(
        self, num_envs: int = 1, threads: int = 1, max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:  # fmt: skip
        n = check_integer("num_envs", num_envs, 1)
        self.batch = batch = self.batch_class(n=n, threads=threads, **arguments)
        self.task = batch.task
        batch.max_steps = lesser_limit(max_episode_steps, "max_steps", batch.max_steps)
        rows = [partial(PhysicsRow, batch, row, self.discrete, None) for row in range(n)]
        super().__init__(rows, autoreset_mode=AutoresetMode.SAME_STEP)
        self.metadata["render_modes"] = []

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:  # fmt: skip
        """Start all episodes.

        Args:
            seed: environment i gets ``seed + i``, or entry i of a list; None goes on drawing.
            options: as for the single environment, for each of them.

        Raises:
            ResetOptionError: an option is malformed, or names a start that cannot be taken.
            ArgumentError: a seed is no integer, is negative, or the list has another length.
        """
        split_options(options)  # before Gymnasium looks for a mask in them
        return super().reset(seed=seeds_of(seed, self.num_envs), options=options)

    def step(self, actions: Any) -> Any:
        """Make one control step in all environments; those whose episode ends start the next.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: an action is not in the action space.
        """
        if None in self.batch.rngs:
            raise ResetNeeded("call reset() first: there are no running episodes")
        if self.discrete:
            moves = check_actions(actions, self.num_envs, N_ACTIONS)
            increments = np.array([move(a) for a in moves])
        else:
            increments = check_increments(actions, (self.num_envs, N_AXES))
        self.batch.step(increments)
        return super().step(actions)


class CoopInsertionContactVectorEnv(PhysicsVectorEnv):
    """Many :class:`~coop_env.physics.env.CoopInsertionContactEnv`."""


class CoopInsertionContactDiscreteVectorEnv(PhysicsVectorEnv):
    """Many of them in twelve moves; actions are (num_envs,) integers 0 to 11."""

    discrete = True


class CoopInsertionPhysicsVectorEnv(PhysicsVectorEnv):
    """Many :class:`~coop_env.physics.env.CoopInsertionPhysicsEnv`."""

    batch_class = WholeBatch
