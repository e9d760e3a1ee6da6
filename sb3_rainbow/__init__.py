"""Rainbow DQN with action masks for Stable-Baselines3."""

from sb3_rainbow.masking.conventions import TerminalActionMask
from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.replay.sum_tree import SumTree
from sb3_rainbow.settings import HESSEL

__version__ = "0.1.0"
# what compiles at a first call, and how long that takes
_KERNELS = "replay, networks and updates: about 15 s"

__all__ = [
    "HESSEL",
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "NoisyLinear",
    "PrioritizedReplayBuffer",
    "Rainbow",
    "SumTree",
    "TerminalActionMask",
    "__version__",
]


def __dir__() -> list[str]:
    return __all__
