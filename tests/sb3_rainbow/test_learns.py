"""Cheap gates: Rainbow and each of its reductions solve tasks that can be solved in seconds."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv, IdentityEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_rainbow import Rainbow

IDENTITY: dict[str, Any] = {
    "learning_rate": 3e-3,
    "learning_starts": 100,
    "gamma": 0.5,
    "tau": 0.05,
    "train_freq": 1,
    "gradient_steps": 1,
    "batch_size": 32,
    "buffer_size": 2000,
    "v_min": -1.0,
    "v_max": 3.0,
    "exploration_fraction": 0.5,
    "policy_kwargs": {"net_arch": [32]},
    "seed": 1,
}


@pytest.mark.parametrize(
    "switches",
    [
        {},
        {"noisy": False},
        {"distributional": False},
        {"distributional": "quantile"},
        {"prioritized": False, "double_q": False, "dueling": False},
    ],
    ids=str,
)
def test_identity(switches: dict[str, Any]) -> None:
    env = DummyVecEnv([lambda: IdentityEnv(4)])
    model = Rainbow("MlpPolicy", env, **switches, **IDENTITY)
    model.learn(1200)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=10, warn=False)
    # 100 steps an episode, a reward for every right answer
    assert np.mean(mean) > 95


def test_the_bare_line_passes_sb3s_own_threshold_on_its_bandit() -> None:
    env = DummyVecEnv([lambda: IdentityEnv(4)])
    model = Rainbow("MlpPolicy", env, gamma=0.4, seed=3, learning_starts=0).learn(2500)
    mean, _ = evaluate_policy(model, env, n_eval_episodes=20, warn=False)
    assert np.mean(mean) > 90


def test_the_defaults_learn_sb3s_bit_flipping_with_hindsight() -> None:
    model = Rainbow(
        "MultiInputPolicy",
        BitFlippingEnv(n_bits=5, continuous=False),
        replay_buffer_class=HerReplayBuffer,
        prioritized=False,
        n_steps=1,
        stats_window_size=50,
        seed=0,
    )
    model.learn(1000)
    assert np.mean(model.ep_success_buffer or [0]) > 0.9


def test_identity_with_masks_and_several_envs() -> None:
    env = DummyVecEnv(
        [lambda: InvalidActionEnvDiscrete(dim=10, n_invalid_actions=5) for _ in range(4)]
    )
    for i, single in enumerate(env.envs):  # its states come from its own space, seeded by nobody
        single.action_space.seed(i)
    # enough random answers that each state has met its own: noise fades before it tries them all
    settings = {**IDENTITY, "gradient_steps": 2, "learning_starts": 600}
    model = Rainbow("MlpPolicy", env, **settings)
    model.learn(3000)
    mean, _ = evaluate_masked(model, env, n_eval_episodes=8, warn=False)  # type: ignore[arg-type]
    assert np.mean(mean) > 90


def test_values_of_a_chain_are_those_of_the_bellman_equation() -> None:
    """A walk of three steps with reward 1 at its end: Q = gamma^2, gamma, 1 from its start."""
    import gymnasium as gym

    class Chain(gym.Env):
        observation_space = spaces.Discrete(3)
        action_space = spaces.Discrete(2)

        def reset(self, **kwargs: Any) -> Any:
            self.place = 0
            return self.place, {}

        def step(self, action: int) -> Any:
            # Action 0 goes on, action 1 ends the episode without reward.
            if action == 1:
                return self.place, 0.0, True, False, {}
            self.place += 1
            ended = self.place == 3
            return min(self.place, 2), float(ended), ended, False, {}

    settings = {**IDENTITY, "v_min": -0.5, "v_max": 1.5, "n_steps": 1, "gamma": 0.8, "noisy": False}
    model = Rainbow("MlpPolicy", Chain(), **{**settings, "exploration_final_eps": 0.3})
    model.learn(2500)
    obs, _ = model.policy.obs_to_tensor(np.arange(3))
    q_values = model.q_net(obs).detach().numpy()
    np.testing.assert_allclose(q_values[:, 0], [0.64, 0.8, 1.0], atol=0.06)
    np.testing.assert_allclose(q_values[:, 1], 0.0, atol=0.06)
