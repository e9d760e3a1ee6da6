"""Masks of agents and of the joint form, against trying every choice; what an agent cannot know."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from coop_env import OPTIMIZED, CoopInsertionEnv, CoopInsertionJointEnv
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import INVALID, VALID
from coop_env.team.agents import Team
from tests.coop_env.team.walks import HOLD, joint_action, low_walk

HIGH = (0.0, 0.0, -0.27)  # of the Delta, out of the 3-RRS's way


def tried(env: CoopInsertionJointEnv, delta: int, rrs: int) -> dict[str, Any]:
    """The info of a tick that is taken back."""
    snapshot = env.get_state()
    *_, info = env.step(joint_action(delta, rrs))
    env.set_state(snapshot)
    return info


def alone(agent: int, choice: int) -> tuple[int, int]:
    return (choice, HOLD) if agent == 0 else (HOLD, choice)


def walk(env: CoopInsertionJointEnv, n: int) -> Any:
    """States of a low walk, after each tick."""
    for delta, rrs in low_walk(env, 0, n):
        env.step(joint_action(delta, rrs))
        if not env.state["over"]:
            yield


@pytest.mark.parametrize("sight", [False, True])
def test_a_masked_choice_is_one_that_is_refused_for_ones_own_limits(sight: bool) -> None:
    env, refused = Team(sight), 0
    for _ in walk(env, 300):
        masks = env.action_masks()
        assert masks.shape == (2, 7)
        assert masks[:, HOLD].all()
        for agent in range(2):
            for choice in range(6):
                info = tried(env, *alone(agent, choice))
                own = info["violation"] and not info["collision"] and not info["singular"]
                assert masks[agent, choice] == (not own)
                refused += own
    assert refused > 100


def test_with_sight_an_allowed_choice_is_free_while_the_other_holds() -> None:
    env, collisions = Team(sight=True, mask_singularities=True), 0
    for _ in walk(env, 300):
        masks = env.action_masks()
        for agent in range(2):
            for choice in range(6):
                info = tried(env, *alone(agent, choice))
                assert masks[agent, choice] == (not info["violation"])
                collisions += info["collision"]
    assert collisions > 100


def test_without_sight_the_other_robot_makes_no_difference() -> None:
    """Masks are what the robot's own half alone says, with the other one out of its way."""
    env, level = Team(mask_singularities=True), CoopInsertionEnv()
    hidden = 0
    for _ in walk(env, 300):
        masks, here = env.action_masks(), env.configuration
        steps = np.array(PAPER_TASK.steps)
        for agent in range(2):
            for choice in range(6):
                to = here.copy()
                axis = 3 * agent + choice // 2
                offset = env.state["offset"][axis] + 1 - 2 * (choice % 2)
                to[axis] = env.state["start"][axis] + offset * steps[axis]
                if agent == 0:
                    assert masks[0, choice] == (level.configuration_status(to) != INVALID)
                else:
                    to[:3] = HIGH
                    assert masks[1, choice] == (level.configuration_status(to) == VALID)
                hidden += masks[agent, choice] and tried(env, *alone(agent, choice))["collision"]
    assert hidden > 100


@pytest.mark.parametrize("safe", [False, True])
def test_the_joint_mask_against_trying_all_49(safe: bool) -> None:
    env = CoopInsertionJointEnv(mask_singularities=safe)
    collisions = 0
    for _ in walk(env, 120):
        mask = env.action_masks()
        assert mask.shape == (49,)
        assert mask[48]
        for action in range(49):
            info = tried(env, *divmod(action, 7))
            bad = info["violation"]
            if not safe:  # neither robot's own limits
                parts = [tried(env, action // 7, HOLD), tried(env, HOLD, action % 7)]
                bad = any(
                    part["violation"] and not part["collision"] and not part["singular"]
                    for part in parts
                )
            assert mask[action] == (not bad)
            collisions += info["collision"]
    assert collisions > 100


def test_a_full_mask_of_the_single_agent_is_not_taken_for_leave() -> None:
    """Where no move is valid the single agent's mask is full; the team's allows to hold alone."""
    arguments: dict[str, Any] = {
        "task": {"linear_step": 0.2, "angular_step": 0.5, "heave_step": 0.2},
        "geometry": {**OPTIMIZED.as_dict(), "max_tilt": 0.4},
        "mask_singularities": True,
    }
    here = {"configuration": (0.0, 0.0, -0.4, 0.0, 0.0, 0.23)}
    single = CoopInsertionEnv(**arguments)
    single.reset(options=here)
    assert single.action_masks().all()
    team, central = Team(sight=True, **arguments), CoopInsertionJointEnv(**arguments)
    team.reset(options=here)
    central.reset(options=here)
    assert team.action_masks().tolist() == [[False] * 6 + [True]] * 2
    assert central.action_masks().tolist() == [False] * 48 + [True]
