"""Rainbow DQN with action masks for Stable-Baselines3."""

from sb3_rainbow.buffers import PrioritizedReplayBuffer
from sb3_rainbow.callbacks import PrioritizedReplayCallback
from sb3_rainbow.masking import TerminalActionMask
from sb3_rainbow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.sum_tree import SumTree
from sb3_rainbow.torch_layers import NoisyLinear

__all__ = [
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "NoisyLinear",
    "PrioritizedReplayBuffer",
    "PrioritizedReplayCallback",
    "Rainbow",
    "SumTree",
    "TerminalActionMask",
]
