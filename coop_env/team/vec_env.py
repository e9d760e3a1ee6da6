"""Teams in one batch, as SB3's ``VecEnv``: a row for each team, or a row for each agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import Wrapper, spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from coop_env.errors import check_flag
from coop_env.simulation import joint
from coop_env.team.agents import AGENTS, Team, joint_actions
from coop_env.team.joint_env import CoopInsertionJointEnv
from coop_env.vector.env_batch import check_actions
from coop_env.vector.vec_env import CoopInsertionVecEnv, StepReturn

_N: int = len(AGENTS)


class CoopInsertionJointVecEnv(CoopInsertionVecEnv):
    """Many :class:`~coop_env.team.joint_env.CoopInsertionJointEnv` in one batch.

    Args and errors as for :class:`~coop_env.vector.vec_env.CoopInsertionVecEnv`.
    """

    env_class = CoopInsertionJointEnv


class _Teams(CoopInsertionVecEnv):
    """A row for each team; masks are (n, 2, 7)."""

    env_class = Team
    envs: list[Any]


class CoopInsertionTeamVecEnv(VecEnv):
    """``n_teams`` teams in one batch with a row for each agent: one policy for both, say.

    Row ``2 i`` is the Delta of team i and row ``2 i + 1`` its 3-RRS, as SuperSuit stacks them; what
    they observe and may do is :class:`~coop_env.team.parallel_env.CoopInsertionParallelEnv`'s, bit
    for bit. Rewards and ends are the team's. An episode that ends is restarted at once, as in
    :class:`~coop_env.vector.vec_env.CoopInsertionVecEnv`, and both its rows carry
    ``terminal_observation``, ``terminal_action_mask`` and ``TimeLimit.truncated``. ``indices`` of
    methods are of rows.

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

    def __init__(
        self,
        n_teams: int,
        seed: int | None = None,
        sight: bool = False,
        indicator: bool = True,
        **kwargs: Any,
    ) -> None:
        self._teams = _Teams(n_teams, seed, sight=sight, **kwargs)
        self._team: Team = self._teams.envs[0]
        n = 1 if check_flag("indicator", indicator) else 0
        self._indicator = np.eye(_N, dtype=np.float32)[:, : n * _N]
        own = self._team.agent_spaces.values()
        low = np.min([space.low for space in own], axis=0)
        high = np.max([space.high for space in own], axis=0)
        space = spaces.Box(
            np.append(low, np.zeros(n * _N, np.float32)),
            np.append(high, np.ones(n * _N, np.float32)),
            dtype=np.float32,
        )
        self.metadata = self._team.metadata
        self.render_mode = self._team.render_mode
        super().__init__(_N * int(n_teams), space, spaces.Discrete(joint.N_CHOICES))

    @property
    def teams(self) -> list[Team]:
        """The teams' environments."""
        return self._teams.envs

    def _rows(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The agents' rows (2 n, fields) of the teams' (n, size)."""
        shared = self._team.share(rows)
        if self._indicator.size:
            tags = np.broadcast_to(self._indicator, (len(rows), _N, _N))
            shared = np.concatenate([shared, tags], axis=2)
        return shared.reshape(_N * len(rows), -1)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds of the next reset: team i gets ``seed + i``; None draws one.

        Raises:
            ArgumentError: the seed is no integer, or negative.
        """
        return [each for each in self._teams.seed(seed) for _ in AGENTS]

    def set_options(self, options: Any = None) -> None:
        """Reset options of the next reset: one mapping for all, or a list with one for each team.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken.
        """
        self._teams.set_options(options)

    def reset(self) -> NDArray[np.float32]:
        """Reset every team, with the seeds and options set since the last reset."""
        rows = self._teams.reset()
        self.reset_infos = _each(self._teams.reset_infos)
        return self._rows(rows)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions (2 n_teams,) of the next :meth:`step_wait`.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            ActionError: the shape is wrong, or an entry is no integer 0 to 6.
        """
        choices = check_actions(actions, self.num_envs, joint.N_CHOICES)
        self._teams.step_async(joint_actions(choices.reshape(-1, _N)))

    def step_wait(self) -> StepReturn:
        """Move all teams; those whose episode ends are reset.

        Raises:
            ResetNeeded: :meth:`reset` was never called.
            NoAsyncCallError: there was no :meth:`step_async` since the last call.
        """
        rows, rewards, dones, infos = self._teams.step_wait()
        each = _each(infos)
        for i in np.flatnonzero(dones).tolist():
            last = self._rows(infos[i]["terminal_observation"][None])
            masks = infos[i]["terminal_action_mask"]
            for k in range(_N):
                own = {"terminal_observation": last[k], "terminal_action_mask": masks[k]}
                each[_N * i + k] = {**infos[i], **own}
            for k in range(_N):
                self.reset_infos[_N * i + k] = dict(self._teams.reset_infos[i])
        return self._rows(rows), rewards.repeat(_N), dones.repeat(_N), each

    def action_masks(self) -> NDArray[np.bool_]:
        """Action masks of all agents, (2 n_teams, 7)."""
        return self._teams.action_masks().reshape(self.num_envs, joint.N_CHOICES)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the teams; ``action_masks`` gives each row its own."""
        if method_name == "action_masks":
            masks = self.action_masks()
            return list(masks if indices is None else masks[list(self._get_indices(indices))])
        return [getattr(env, method_name)(*args, **kwargs) for env in self._targets(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each row's team."""
        return [getattr(env, attr_name) for env in self._targets(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute (``stage``, say) of the rows' teams.

        Raises:
            ArgumentError: the teams have no such attribute to set.
        """
        self._teams.set_attr(attr_name, value, [i // _N for i in self._get_indices(indices)])

    def _targets(self, indices: VecEnvIndices) -> list[Team]:
        return [self.teams[i // _N] for i in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """False for each: the environments of a batch bear no wrappers."""
        return [False for _ in self._targets(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A frame of each team, None without ``render_mode="rgb_array"``."""
        return self._teams.get_images()

    def close(self) -> None:
        """Nothing is open that needs closing."""

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot of all teams, to resume from."""
        return self._teams.get_state()

    def set_state(self, snapshot: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return to a snapshot of :meth:`get_state`; the observations (2 n_teams, fields) there.

        Raises:
            StateError: the snapshot is of another batch: other arguments, another ``n_teams``.
        """
        return self._rows(self._teams.set_state(snapshot))


def _each(infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The teams' infos, one dictionary for each agent."""
    return [own for info in infos for own in (info, info.copy())]
