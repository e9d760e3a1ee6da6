"""What gymnasium.make and make_vec make of the registered names, and what came of an episode."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import coop_env
from coop_env import CoopInsertionEnv, CoopInsertionVectorEnv
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


def test_the_registry_names_both_entries() -> None:
    spec = gym.spec(ID)
    assert spec.max_episode_steps == 300
    assert spec.vector_entry_point == "coop_env.vector.vector_env:CoopInsertionVectorEnv"
    assert gym.make(ID, render_mode="ansi").unwrapped.render_mode == "ansi"
    for name in coop_env.__all__:
        assert getattr(coop_env, name) is not None


KEYS = {"success", "is_success", "all_filled"}
SIX: dict[str, Any] = {"task": {"holes": [[0.0, 0.0], *([0.5, k] for k in range(5))]}}


def start(env: CoopInsertionEnv, filled: list[int]) -> dict[str, Any]:
    """25 mm above the upright hole, its peg down."""
    z = 0.21 + env.task.dome_radius + 0.025 + env.params.delta.peg_length
    z -= env.params.delta.base_height
    options = {"configuration": [0.0, 0.0, z, 0.0, 0.0, 0.21], "target": 0, "filled": filled}
    return env.reset(options=options)[1]


@pytest.mark.parametrize(("filled", "all_filled"), [([], False), ([1, 2, 3, 4, 5], True)])
def test_a_success_is_one_insertion_and_all_filled_is_every_hole(
    filled: list[int], all_filled: bool
) -> None:
    env = CoopInsertionEnv(**SIX)
    info = start(env, filled)
    assert not any(info[key] for key in KEYS)
    *_, terminated, truncated, info = env.step(5)
    assert info["inserted"]
    assert info["success"]
    assert info["is_success"]
    assert info["all_filled"] == all_filled == terminated
    assert not truncated
    assert env.scene().status == ("success" if all_filled else "running")


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
