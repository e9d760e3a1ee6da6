"""Rainbow DQN with action masks for Stable-Baselines3."""

from sb3_rainbow.buffers import PrioritizedReplayBuffer
from sb3_rainbow.masking import TerminalActionMask
from sb3_rainbow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_rainbow.rainbow import Rainbow

__all__ = [
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "PrioritizedReplayBuffer",
    "Rainbow",
    "TerminalActionMask",
]
