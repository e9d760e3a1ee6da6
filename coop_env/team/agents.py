"""The two agents' observations and choices: fields, spaces and masks."""

from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coop_env.errors import check_flag
from coop_env.simulation import joint
from coop_env.simulation.observation import PAPER_FIELDS, markov_fields
from coop_env.team.joint_env import CoopInsertionJointEnv

AGENTS: Final = ("delta", "rrs")

_AXES: Final = PAPER_FIELDS[:6]
_OWN: Final = {"delta": _AXES[:3], "rrs": _AXES[3:]}
# The peg's tip carries the Delta's end, the platform's centre the 3-RRS's: seen from there a mouth
# lies along its normal, at the dome's radius.
_HOLE: Final = {"delta": ("e_x", "e_y", "e_z"), "rrs": ("n_x", "n_y", "n_z")}


class Team(CoopInsertionJointEnv):
    """A joint environment with observations and masks for the agents ``delta`` and ``rrs``.

    Args:
        sight: each agent sees the other's configuration, and its masks know of collisions with the
            other robot where it stands (with ``mask_singularities``).
        kwargs: as for :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`.

    Attributes:
        fields: what each agent sees, by name.
        columns: where those stand in the joint observation, (2, fields).
        agent_spaces: the agents' observation spaces, of one shape.

    Raises:
        ArgumentError: ``sight`` is no bool, or an argument is wrong.
    """

    def __init__(self, sight: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.sight = check_flag("sight", sight)
        names = markov_fields(len(self.task.holes))[: self.observation_space.shape[0]]
        # one's own configuration and the hole seen from one's own end; with sight also the other's
        # configuration; of the observation "markov" also the filled holes and the time
        shared = {*names[len(PAPER_FIELDS) :], *(_AXES if self.sight else ())}
        self.fields = {
            agent: tuple(f for f in names if f in {*_OWN[agent], *_HOLE[agent], *shared})
            for agent in AGENTS
        }
        self.columns = np.array([[names.index(f) for f in self.fields[a]] for a in AGENTS])
        low, high = self.observation_space.low, self.observation_space.high
        self.agent_spaces = {
            agent: spaces.Box(low[columns], high[columns], dtype=np.float32)
            for agent, columns in zip(AGENTS, self.columns, strict=True)
        }

    def share(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The agents' observations (..., 2, fields) of full ones (..., size)."""
        return rows[..., self.columns]

    def _masks_of(self, states: NDArray[np.void]) -> NDArray[np.bool_]:
        """Masks (n, 2, 7), one for each agent."""
        masks = np.empty((len(states), len(AGENTS), joint.N_CHOICES), np.bool_)
        joint.agent_masks(states, self._packed, self.sight, masks)
        return masks


def joint_actions(choices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Joint actions (n,) of the agents' choices (n, 2)."""
    return joint.N_CHOICES * choices[:, joint.DELTA] + choices[:, joint.RRS]
