"""SB3's own DQN on Rainbow's replay buffer: prioritized, with three-step returns.
50,000 steps, about a minute; `python -m examples.prioritized_dqn 2000` takes fewer.
"""

import sys

import gymnasium as gym
from stable_baselines3 import DQN
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_rainbow import PrioritizedReplayBuffer, PrioritizedReplayCallback

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000

model = DQN(
    "MlpPolicy",
    "CartPole-v1",
    learning_rate=1e-3,
    target_update_interval=500,
    exploration_fraction=0.2,
    replay_buffer_class=PrioritizedReplayBuffer,
    replay_buffer_kwargs={"n_steps": 3, "gamma": 0.99, "alpha": 0.6},
    seed=0,
)
model.learn(steps, callback=PrioritizedReplayCallback())

buffer = model.replay_buffer
assert isinstance(buffer, PrioritizedReplayBuffer)
known = buffer.tree.leaves[buffer.tree.leaves > 0]
print(f"priorities from {known.min():.2g} to {known.max():.2g}")
mean, std = evaluate_policy(model, Monitor(gym.make("CartPole-v1")), n_eval_episodes=20)
print(f"return after {steps} steps: {mean:.1f} ± {std:.1f}")
