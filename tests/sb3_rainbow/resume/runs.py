"""Short runs whose every bit can be compared."""

import pickle
from operator import attrgetter
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rainbow import Rainbow
from tests.sb3_rainbow import small


def make(env: Any = "CartPole-v1", policy: str = "MlpPolicy", **settings: Any) -> Rainbow:
    """A small model with one update every two steps."""
    own = {"learning_starts": 40, "buffer_size": 300, "train_freq": 2, "gradient_steps": 1}
    return small.make(policy, env, **{**own, "seed": 7, **settings})


class StatefulVecEnv(DummyVecEnv):
    """CartPoles that can tell and take their exact state, as a batched simulator can."""

    def get_state(self) -> bytes:
        return pickle.dumps((self.envs, self.buf_obs))

    def set_state(self, state: bytes) -> None:
        self.envs, self.buf_obs = pickle.loads(state)


def make_stateful(n_envs: int = 3) -> StatefulVecEnv:
    return StatefulVecEnv([lambda: gym.make("CartPole-v1") for _ in range(n_envs)])


def assert_same(a: Rainbow, b: Rainbow) -> None:
    """Networks, optimizer, counters and replay are identical to the last bit."""
    assert (a.num_timesteps, a._n_updates) == (b.num_timesteps, b._n_updates)
    small.identical(a.policy.state_dict(), b.policy.state_dict())
    small.identical(*(each.policy.optimizer.state_dict()["state"] for each in (a, b)))
    for stored in ("observations", "rewards", "tree.leaves"):
        own = attrgetter(f"replay_buffer.{stored}")
        np.testing.assert_array_equal(own(a), own(b))
