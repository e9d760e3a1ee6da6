"""Rainbow learns CartPole, plays twenty episodes and is saved.
50,000 steps, two minutes or so; `python -m examples.cartpole 1000` takes fewer.
"""

import sys

import gymnasium as gym
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_rainbow import Rainbow

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000

model = Rainbow("MlpPolicy", "CartPole-v1", seed=0)
model.learn(steps)
model.save("rainbow_cartpole")

mean, std = evaluate_policy(model, Monitor(gym.make("CartPole-v1")), n_eval_episodes=20)
print(f"return after {steps} steps: {mean:.1f} ± {std:.1f}")
