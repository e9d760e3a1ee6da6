"""Moves that an environment forbids are never made: FrozenLake, masked so that no ice breaks.
20,000 steps, about half a minute; `python -m examples.masks 1000` takes fewer.
"""

import sys

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from sb3_contrib.common.maskable.evaluation import evaluate_policy
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3.common.monitor import Monitor

from sb3_rainbow import Rainbow

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
LIMIT = 100  # moves of an episode


def away_from_holes(env: gym.Env) -> NDArray[np.bool_]:
    """True for each move that stays on the ice; P[state][move] lists what may come of it."""
    moves = env.unwrapped.P[env.unwrapped.s]  # type: ignore[attr-defined]
    ends = [[(reward, over) for _, _, reward, over in moves[a]] for a in range(4)]
    return np.array([all(reward > 0 or not over for reward, over in end) for end in ends])


lake = gym.make("FrozenLake-v1", map_name="8x8", is_slippery=False)
env = Monitor(ActionMasker(lake, away_from_holes))
model = Rainbow("MlpPolicy", env, seed=0)
model.learn(steps)

# sb3-contrib's tools for masks work as they do with MaskablePPO
mean, _ = evaluate_policy(model, env, n_eval_episodes=20)  # type: ignore[arg-type]
lengths = zip(env.get_episode_rewards(), env.get_episode_lengths(), strict=True)
falls = sum(paid == 0 and length < LIMIT for paid, length in lengths)
print(f"share of episodes that reach the goal: {mean:.2f}; falls into water, ever: {falls}")
