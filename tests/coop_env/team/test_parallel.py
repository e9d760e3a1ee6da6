"""The two agents as PettingZoo has them: its own tests, what they see, who may act."""

from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import coop_env
from coop_env import CoopInsertionJointEnv
from coop_env.errors import ActionError, ArgumentError, ResetOptionError
from coop_env.simulation.observation import PAPER_FIELDS, markov_fields

pytest.importorskip("pettingzoo", reason="two agents need the extra `team`")

from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils import parallel_to_aec

ARGUMENTS: list[dict[str, Any]] = [
    {},
    {"sight": True, "observation": "markov", "mask_singularities": True, "max_moves": 20},
]


@pytest.mark.filterwarnings("ignore:We recommend agents to be named")  # ours are named as asked
@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_pettingzoos_own_tests(arguments: dict[str, Any]) -> None:
    with pytest.warns(UserWarning, match="reset options .'options'. are unknown"):
        parallel_api_test(coop_env.parallel_env(**arguments), num_cycles=400)
    with pytest.warns(UserWarning, match="reset options .'options'. are unknown"):
        api_test(parallel_to_aec(coop_env.parallel_env(**arguments)), num_cycles=100)
    parallel_seed_test(lambda: coop_env.parallel_env(**arguments), num_cycles=200)


@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_agents_see_fields_of_the_joint_observation(arguments: dict[str, Any]) -> None:
    env = coop_env.parallel_env(**arguments)
    shared = {key: value for key, value in arguments.items() if key != "sight"}
    central = CoopInsertionJointEnv(**shared)
    names = markov_fields(6) if "observation" in arguments else PAPER_FIELDS
    rng = np.random.default_rng(0)
    observations, _ = env.reset(seed=1)
    row, _ = central.reset(seed=1)
    for _ in range(100):
        assert env.state().tobytes() == row.tobytes()
        for agent, seen in observations.items():
            space = env.observation_space(agent)
            assert space.contains(seen)
            expected = [row[names.index(name)] for name in env.team.fields[agent]]
            assert seen.tolist() == expected
        if not env.agents:
            observations, _ = env.reset()
            row, _ = central.reset()
            continue
        delta, rrs = (int(c) for c in rng.integers(7, size=2))
        observations, *shares, infos = env.step({"rrs": rrs, "delta": delta})
        row, *rest, info = central.step(7 * delta + rrs)
        for share, value in zip(shares, rest, strict=True):
            assert share == {"delta": value, "rrs": value}
        for agent, own in infos.items():
            mask = own.pop("action_mask")
            assert mask.dtype == np.int8  # as a space's sample() takes it
            np.testing.assert_array_equal(mask, env.action_masks()[agent])
            assert own == info


def test_fields_by_name() -> None:
    fields = coop_env.parallel_env().team.fields
    assert fields["delta"] == ("x", "y", "z", "e_x", "e_y", "e_z")
    assert fields["rrs"] == ("roll", "pitch", "heave", "n_x", "n_y", "n_z")
    fields = coop_env.parallel_env(sight=True).team.fields
    assert fields["delta"] == ("x", "y", "z", "roll", "pitch", "heave", "e_x", "e_y", "e_z")
    assert fields["rrs"] == ("x", "y", "z", "roll", "pitch", "heave", "n_x", "n_y", "n_z")


def test_agents_act_while_an_episode_runs_after_a_snapshot_too() -> None:
    env, hold = coop_env.parallel_env(max_moves=1, render_mode="ansi"), {"delta": 6, "rrs": 6}
    assert env.agents == []
    for early in (lambda: env.step(hold), env.state):
        with pytest.raises(ResetNeeded, match="reset"):
            early()
    env.reset(seed=0)
    assert "target" in env.render()
    snapshot = env.team.get_state()
    for there in (env, coop_env.parallel_env(max_moves=1)):
        there.team.set_state(snapshot)
        assert there.agents == ["delta", "rrs"]
        *_, truncated, _ = there.step(hold)
        assert truncated == {"delta": True, "rrs": True}
        assert there.agents == []
    for actions in (hold, {"delta": 6}, {}):
        with pytest.raises(ResetNeeded, match="both agents are done"):
            env.step(actions)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"delta": 0}, "one for each of"),
        ({"delta": 0, "rrs": 0, "ur5": 0}, "one for each of"),
        ([0, 0], "one for each of"),
        (None, "one for each of"),
        ({"delta": 7, "rrs": 0}, r"actions\['delta'\] = 7: must be an integer from 0 to 6"),
        ({"delta": 0, "rrs": -1}, r"actions\['rrs'\] = -1"),
    ],
)
def test_wrong_actions_are_named_and_change_nothing(actions: Any, message: str) -> None:
    env = coop_env.parallel_env()
    env.reset(seed=0)
    before = env.team.state.tobytes()
    with pytest.raises(ActionError, match=message):
        env.step(actions)
    assert env.team.state.tobytes() == before
    assert env.agents == ["delta", "rrs"]


def test_wrong_names_and_options() -> None:
    env = coop_env.parallel_env()
    for space in (env.observation_space, env.action_space):
        with pytest.raises(ArgumentError, match="agent = 'gripper': must be one of"):
            space("gripper")
    for options in ({"target": 9}, "home"):
        with pytest.raises(ResetOptionError):
            env.reset(options=options)  # type: ignore[arg-type]
