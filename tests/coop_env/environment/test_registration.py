"""What gymnasium.make and make_vec make of the registered names, and what came of an episode."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from coop_env import CoopInsertionVectorEnv
from coop_env.errors import ArgumentError

ID = "CoopInsertion-v0"


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, 300),
        ({"max_moves": 40}, 40),
        ({"max_episode_steps": 25}, 25),
        ({"max_moves": 30, "max_episode_steps": 99}, 30),
        ({"max_moves": 30, "max_episode_steps": -1}, 30),
        ({"max_moves": 450, "max_episode_steps": 450}, 450),
    ],
)
def test_the_earlier_of_both_limits_cuts(limits: dict[str, Any], expected: int) -> None:
    env: Any = gym.make(ID, **limits)
    env.reset(seed=0)
    ends = [env.step(k % 2)[2:4] for k in range(expected)]
    assert ends == [(False, k == expected - 1) for k in range(expected)]


def test_make_vec_knows_gymnasiums_name_of_the_limit() -> None:
    env: Any = gym.make_vec(ID, num_envs=2, max_episode_steps=-1)
    assert env.envs[0].params.task.max_moves == 300
    env = gym.make_vec(ID, num_envs=2, max_episode_steps=5)
    assert isinstance(env, CoopInsertionVectorEnv)
    env.reset(seed=0)
    for _ in range(5):
        *_, truncated, _ = env.step(np.zeros(2, int))
    assert truncated.all()
    longer = CoopInsertionVectorEnv(2, max_episode_steps=5, max_moves=6)
    assert longer.envs[0].params.task.max_moves == 5
    with pytest.raises(ArgumentError, match="max_episode_steps = 0"):
        CoopInsertionVectorEnv(2, max_episode_steps=0)


KEYS = {"success", "is_success", "all_filled"}


@pytest.mark.parametrize("name", sorted(n for n in gym.registry if n.startswith("CoopInsertion")))
def test_every_environment_has_the_keys(name: str) -> None:
    if "Contact" in name or "Physics" in name:
        pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
    env = gym.make(name)
    env.reset(seed=0)
    *_, info = env.step(env.action_space.sample() * 0)
    assert set(info) >= KEYS
    assert all(isinstance(info[key], bool) for key in KEYS)
    many = gym.make_vec(name, num_envs=2)
    many.reset(seed=0)
    *_, infos = many.step(many.action_space.sample() * 0)
    assert set(infos) >= KEYS
    assert all(infos[key].shape == (2,) for key in KEYS)
    env.close()
    many.close()
