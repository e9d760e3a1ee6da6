"""Teams in a batch, a row for each agent, against teams one by one."""

from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionTeamVecEnv
from coop_env.team.agents import Team

ARGUMENTS: list[dict[str, Any]] = [
    {"max_moves": 12},
    {"max_moves": 12, "sight": True, "mask_singularities": True, "observation": "markov"},
]


@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_rows_are_the_agents_of_single_teams(arguments: dict[str, Any]) -> None:
    batch: Any = CoopInsertionTeamVecEnv(3, seed=5, **arguments)
    teams = [Team(**arguments) for _ in range(3)]
    rows = batch.reset()
    assert rows.shape == (6, *batch.observation_space.shape)
    rng = np.random.default_rng(0)
    shares = [team.share(team.reset(seed=5 + i)[0]) for i, team in enumerate(teams)]
    for _ in range(60):
        assert rows[:, -2:].tolist() == [[1, 0], [0, 1]] * 3
        assert rows[:, :-2].tobytes() == np.concatenate(shares).tobytes()
        assert all(batch.observation_space.contains(row) for row in rows)
        masks = batch.action_masks()
        np.testing.assert_array_equal(masks, np.concatenate([t.action_masks() for t in teams]))
        assert np.array_equal(batch.env_method("action_masks"), masks)
        assert np.array_equal(batch.env_method("action_masks", indices=[3]), masks[3:4])
        choices = rng.integers(7, size=6)
        rows, rewards, dones, infos = batch.step(choices)
        for i, team in enumerate(teams):
            delta, rrs = choices[2 * i : 2 * i + 2].tolist()
            row, reward, terminated, truncated, info = team.step(7 * delta + rrs)
            shares[i] = team.share(row)
            for k in range(2):
                own = infos[2 * i + k]
                assert rewards[2 * i + k] == np.float32(reward)
                assert dones[2 * i + k] == (terminated or truncated)
                assert {key: own[key] for key in info} == info
                if dones[2 * i + k]:
                    assert own["TimeLimit.truncated"] == truncated
                    last = own["terminal_observation"]
                    assert last[:-2].tobytes() == shares[i][k].tobytes()
                    np.testing.assert_array_equal(
                        own["terminal_action_mask"], team.action_masks()[k]
                    )
            if dones[2 * i]:
                shares[i] = team.share(team.reset()[0])
        assert len({id(info) for info in infos}) == 6  # SB3's wrappers write into them


def test_without_indicator_and_in_si_units() -> None:
    batch = CoopInsertionTeamVecEnv(2, seed=0, indicator=False, normalize=False)
    rows = batch.reset()
    assert rows.shape == (4, 6)
    assert all(batch.observation_space.contains(row) for row in rows)
