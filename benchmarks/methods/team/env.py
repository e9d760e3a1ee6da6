"""Both robots at once in one environment, commanded centrally or by two agents. No torch here."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods.base import Masks, Observations, Policy
from coop_env.env import CoopInsertionEnv
from coop_env.shield import ShieldedInsertionEnv
from coop_env.simulation.joint import N_CHOICES
from coop_env.team.agents import AGENTS, Team, joint_actions
from coop_env.team.joint_env import CoopInsertionJointEnv


class DecentralizedEnv(Team):
    """The joint environment for two agents that each choose for themselves.

    A joint action is allowed where both agents' own masks allow their parts.
    """

    def _masks_of(self, states: NDArray[np.void]) -> NDArray[np.bool_]:
        own = super()._masks_of(states)
        return (own[:, 0, :, None] & own[:, 1, None, :]).reshape(len(states), -1)


def make_env(team: str | None = None, **arguments: Any) -> CoopInsertionEnv:
    """The single environment of a track's ``team``, or of robots that move one at a time."""
    if "shield" in arguments:
        return ShieldedInsertionEnv(**arguments)
    if team is None:
        return CoopInsertionEnv(**arguments)
    if team == "central":
        return CoopInsertionJointEnv(**arguments)
    return DecentralizedEnv(**arguments)


def own_masks(masks: Masks) -> Masks:
    """The agents' masks (n, 2, 7) of joint ones (n, 49); holding is always allowed to both."""
    pairs = masks.reshape(-1, N_CHOICES, N_CHOICES)
    return np.stack([pairs.any(axis=2), pairs.any(axis=1)], axis=1)


def each_for_itself(policy: Policy, env: DecentralizedEnv) -> Policy:
    """Joint actions by a policy that was trained on agents' rows with the indicator."""

    def act(observations: Observations, masks: Masks) -> NDArray[Any]:
        n = len(observations)
        tags = np.broadcast_to(np.eye(len(AGENTS), dtype=np.float32), (n, len(AGENTS), len(AGENTS)))
        rows = np.concatenate([env.share(observations), tags], axis=2)
        choices = policy(rows.reshape(n * len(AGENTS), -1), own_masks(masks).reshape(-1, N_CHOICES))
        return joint_actions(choices.reshape(n, len(AGENTS)))

    return act
