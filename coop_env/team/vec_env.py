"""Teams in one batch, as SB3's ``VecEnv``: a row for each team, or a row for each agent."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coop_env.errors import check_flag, check_integer
from coop_env.simulation import joint
from coop_env.team.agents import AGENTS, Team, joint_actions
from coop_env.team.joint_env import CoopInsertionJointEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv
from coop_env.vector.vector_env import check_actions


class CoopInsertionJointVecEnv(CoopInsertionVecEnv):
    """Many :class:`~coop_env.team.joint_env.CoopInsertionJointEnv` in one batch.

    Args and errors as for :class:`~coop_env.vector.vec_env.CoopInsertionVecEnv`.
    """

    env_class = CoopInsertionJointEnv


class CoopInsertionTeamVecEnv(CoopInsertionVecEnv):
    """``n_teams`` teams in one batch with a row for each agent: one policy for both, say.

    Row ``2 i`` is the Delta of team i and row ``2 i + 1`` its 3-RRS, as SuperSuit stacks them; what
    they observe and may do is :class:`~coop_env.team.parallel_env.CoopInsertionParallelEnv`'s, bit
    for bit. Rewards and ends are the team's; ``terminal_observation``, ``terminal_action_mask`` and
    ``TimeLimit.truncated`` are in both rows. ``indices`` of methods are of rows; ``envs`` are the
    teams.

    Args:
        n_teams: number of teams; there are ``num_envs = 2 n_teams`` rows.
        seed: team i gets ``seed + i`` at the first reset; None draws one.
        sight: each agent sees the other's configuration.
        indicator: two fields follow that say which agent a row is, (1, 0) or (0, 1), without which
            one policy could not tell them apart.
        kwargs: as for :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`.

    Raises:
        ArgumentError: ``n_teams`` is no positive integer, or a keyword is wrong.
    """

    env_class = Team
    rows_each: ClassVar[int] = len(AGENTS)

    def __init__(
        self,
        n_teams: int,
        seed: int | None = None,
        sight: bool = False,
        indicator: bool = True,
        **kwargs: Any,
    ) -> None:
        n = self.rows_each if check_flag("indicator", indicator) else 0
        self._indicator = np.eye(self.rows_each, dtype=np.float32)[:, :n]
        super().__init__(check_integer("n_teams", n_teams, 1), seed, sight=sight, **kwargs)

    def _make_spaces(self) -> tuple[spaces.Box, spaces.Discrete]:
        own, n = self.envs[0].agent_spaces.values(), self._indicator.shape[1]
        low = np.pad(np.min([space.low for space in own], axis=0), (0, n))
        high = np.pad(np.max([space.high for space in own], axis=0), (0, n), constant_values=1)
        return spaces.Box(low, high, dtype=np.float32), spaces.Discrete(joint.N_CHOICES)

    def _observed(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        shared: NDArray[np.float32] = self.envs[0].share(rows)
        tags = np.broadcast_to(self._indicator, (len(rows), *self._indicator.shape))
        return np.concatenate([shared, tags], axis=2).reshape(self.rows_each * len(rows), -1)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the choices (2 n_teams,), 0 to 6, of the next ``step_wait``."""
        choices = check_actions(actions, self.num_envs, joint.N_CHOICES)
        super().step_async(joint_actions(choices.reshape(-1, self.rows_each)))
