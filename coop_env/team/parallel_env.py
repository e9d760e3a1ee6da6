"""The team as a PettingZoo ``ParallelEnv``; :func:`coop_env.parallel_env` makes it."""

import copy
from collections.abc import Mapping
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.env import check_action
from coop_env.errors import ActionError, ArgumentError, imports
from coop_env.simulation import joint
from coop_env.simulation.start_states import OPTIONS
from coop_env.team.agents import AGENTS, Team

with imports("two agents need", "team"):
    from pettingzoo import ParallelEnv

Observations = dict[str, NDArray[np.float32]]
Infos = dict[str, dict[str, Any]]


class CoopInsertionParallelEnv(ParallelEnv[str, NDArray[np.float32], int]):
    """Cooperative insertion by two agents, ``delta`` and ``rrs``, which move at the same time.

    ``docs/team.md`` says it at length.

    **Action Space**

    ``Discrete(7)`` each: the choices of :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`,
    which also says what becomes of a tick in which a move is refused.

    **Observation Space**

    ``Box(0, 1, (6,), float32)`` each, scaled as the single agent's fields of the same names:

    =====  ===============================================================================
    Agent  Fields
    =====  ===============================================================================
    delta  x, y, z; hole's mouth - tip
    rrs    roll, pitch, heave; the hole's normal: mouth - platform's centre, in dome radii
    =====  ===============================================================================

    With ``sight`` ``(9,)``: all six axes, then the hole. With ``observation="markov"`` the filled
    holes and the time follow.

    **Rewards, Episode End**

    Both get the single agent's reward of the tick, and both end together.

    **Masks**

    :meth:`action_masks` has them as bool, ``info["action_mask"]`` as int8, PettingZoo's type.
    They say what an agent can know: its own limits, with ``mask_singularities`` also the 3-RRS's
    singularities, and with ``sight`` as well collisions with the other where it stands. The other
    moves in the same tick, so an allowed move may still collide.

    Args:
        sight: each agent sees the other's configuration.
        kwargs: as for :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`.

    Attributes:
        team: the environment that both move in; its ``configuration``, ``state``, ``set_stage``,
            ``get_state`` and ``set_state`` are the single agent's.

    Raises:
        ArgumentError: an argument is wrong.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own form
        "name": "coop_insertion_v0",
        "is_parallelizable": True,
        **Team.metadata,
    }

    def __init__(self, sight: bool = False, **kwargs: Any) -> None:
        self.team = Team(sight, **kwargs)
        self.metadata = {**type(self).metadata, **self.team.metadata}
        self.render_mode = self.team.render_mode
        self.possible_agents = list(AGENTS)
        self.observation_spaces = self.team.agent_spaces
        self.action_spaces = {agent: spaces.Discrete(joint.N_CHOICES) for agent in AGENTS}
        self.state_space = self.team.observation_space

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    @property
    def agents(self) -> list[str]:
        """Both agents while an episode runs, or none; so after ``team.set_state`` as well."""
        return list(AGENTS) if self.team.running else []

    def observation_space(self, agent: str) -> spaces.Box:
        """The agent's observation space; ArgumentError, if there is no such agent."""
        return self.observation_spaces[_check_agent(agent)]

    def action_space(self, agent: str) -> spaces.Discrete:
        """The agent's action space; likewise."""
        return self.action_spaces[_check_agent(agent)]

    def action_masks(self) -> dict[str, NDArray[np.bool_]]:
        """(7,) of each agent: True where a choice is within what it knows of its limits."""
        return dict(zip(AGENTS, self.team.action_masks(), strict=True))

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Start an episode, as :meth:`coop_env.env.CoopInsertionEnv.reset` does.

        PettingZoo lets any option be given to any environment, so one foreign to this task raises a
        warning here, no error.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken.
        """
        if isinstance(options, Mapping):
            if foreign := sorted(str(key) for key in options if key not in OPTIONS):
                gym.logger.warn(f"reset options {foreign} are unknown; known: {list(OPTIONS)}")
            options = {key: options[key] for key in options if key in OPTIONS}
        row, info = self.team.reset(seed=seed, options=options)
        return self._share(row), self._infos(info)

    def step(
        self, actions: dict[str, int]
    ) -> tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Move both robots in one tick.

        Raises:
            ResetNeeded: both agents are done, or no episode was started.
            ActionError: an agent is unknown or missing, or an action is no integer 0 to 6. The
                environment is left as it was.
        """
        if not self.agents:
            raise ResetNeeded("call reset() first: both agents are done, or never began")
        if not isinstance(actions, Mapping) or set(actions) != set(AGENTS):
            raise ActionError(f"actions = {actions!r}: must have one for each of {list(AGENTS)}")
        choices = [check_action(actions[a], joint.N_CHOICES, f"actions[{a!r}]") for a in AGENTS]
        action = joint.N_CHOICES * choices[joint.DELTA] + choices[joint.RRS]
        row, reward, terminated, truncated, info = self.team.step(action)
        return (
            self._share(row),
            dict.fromkeys(AGENTS, reward),
            dict.fromkeys(AGENTS, terminated),
            dict.fromkeys(AGENTS, truncated),
            self._infos(info),
        )

    def _share(self, row: NDArray[np.float32]) -> Observations:
        return dict(zip(AGENTS, self.team.share(row), strict=True))

    def _infos(self, info: dict[str, Any]) -> Infos:
        masks = self.team.action_masks().astype(np.int8)  # the type that a space's sample() takes
        return {a: {**info, "action_mask": masks[i]} for i, a in enumerate(AGENTS)}

    def state(self) -> NDArray[np.float32]:
        """The single agent's observation (size,), for training that is centralized."""
        return self.team.observe()

    def render(self) -> Any:
        """As :meth:`coop_env.rendering.modes.Rendered.render`."""
        return self.team.render()


def _check_agent(agent: str) -> str:
    if agent not in AGENTS:
        raise ArgumentError(f"agent = {agent!r}: must be one of {list(AGENTS)}")
    return agent
