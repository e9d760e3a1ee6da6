"""The keys of `info` that say what came of an episode, the same in every environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest

import coop_env
from coop_env import CoopInsertionEnv

KEYS = {"success", "is_success", "all_filled"}
TWO: dict[str, Any] = {"task": {"holes": [[0.0, 0.0], [0.5, 0.0]]}, "stage": 1}


def start(env: CoopInsertionEnv, filled: list[int]) -> dict[str, Any]:
    """25 mm above the upright hole, its peg down."""
    z = 0.21 + env.task.dome_radius + 0.025 + env.params.delta.peg_length
    z -= env.params.delta.base_height
    options = {"configuration": [0.0, 0.0, z, 0.0, 0.0, 0.21], "target": 0, "filled": filled}
    return env.reset(options=options)[1]


@pytest.mark.parametrize(("filled", "all_filled"), [([], False), ([1], True)])
def test_a_success_is_one_insertion_and_all_filled_is_every_hole(
    filled: list[int], all_filled: bool
) -> None:
    env = CoopInsertionEnv(**TWO)
    info = start(env, filled)
    assert not any(info[key] for key in KEYS)
    *_, terminated, _, info = env.step(5)
    assert info["inserted"]
    assert info["success"]
    assert info["is_success"]
    assert info["all_filled"] == all_filled == terminated


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


def test_the_team_has_the_keys() -> None:
    pytest.importorskip("pettingzoo", reason="PettingZoo is not installed (extra team)")
    env = coop_env.parallel_env()
    env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(env.agents, 0))
    assert all(set(info) >= KEYS for info in infos.values())
