"""The central form of the team's task: one agent that moves both robots in the same tick."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError
from coop_env.simulation import joint
from coop_env.vector.vector_env import CoopInsertionVectorEnv


class CoopInsertionJointEnv(CoopInsertionEnv):
    """Cooperative insertion with both robots moving at once, commanded by one agent.

    All is as in :class:`~coop_env.env.CoopInsertionEnv` except as said here; with one
    robot on hold the states are the same to the last bit. ``docs/team.md`` says it at length.

    **Action Space**

    ``Discrete(49)``: action ``7 d + r`` is the Delta's choice ``d`` and the 3-RRS's choice ``r``.

    ======  =========  =============
    Choice  Delta      3-RRS
    ======  =========  =============
    0, 1    x + and -  roll + and -
    2, 3    y + and -  pitch + and -
    4, 5    z + and -  heave + and -
    6       hold       hold
    ======  =========  =============

    A robot whose own limits forbid its move stays while the other moves; if the robots would touch
    where they arrive, neither moves. Each is a violation; two in a tick count and cost as much as
    one. A move into a singular pose is executed and ends the episode.

    ``action_masks()`` is True where both moves are within the limits, and with
    ``mask_singularities`` where the tick also ends free of collision and singularity.

    Args:
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`, without ``mask_visited``,
            ``mask_refused`` and ``sim_to_real``. ``max_moves`` counts ticks.

    Raises:
        ArgumentError: an argument is one of these three and turned on, or out of range.
    """

    step_batch = staticmethod(joint.step_batch)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        task = self._params.task
        if task.visited or task.refused or task.imperfect:
            raise ArgumentError(
                "mask_visited, mask_refused and sim_to_real are of robots that move one at a time: "
                "leave them out where both move at once"
            )
        self.action_space = spaces.Discrete(joint.N_JOINT)

    def _masks_of(self, states: NDArray[np.void]) -> NDArray[np.bool_]:
        masks = np.empty((len(states), joint.N_JOINT), np.bool_)
        joint.joint_masks(states, self._packed, masks)
        return masks


class CoopInsertionJointVectorEnv(CoopInsertionVectorEnv):
    """Many :class:`CoopInsertionJointEnv` in one batch, as Gymnasium's ``VectorEnv``."""

    env_class = CoopInsertionJointEnv
