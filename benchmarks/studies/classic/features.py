"""Feature extractors for images, as in the papers that defined the tasks."""

from typing import ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from benchmarks.protocol.plan import ATARI


class Convolutions(BaseFeaturesExtractor):
    """Layers of square filters on images with channels first, each followed by ReLU.

    Args:
        observation_space: images of at least the filters' size.
    """

    filters: ClassVar[tuple[tuple[int, int, int], ...]]  # number, size, stride

    def __init__(self, observation_space: spaces.Box) -> None:
        channels, *sizes = observation_space.shape
        layers: list[nn.Module] = []
        for number, size, stride in self.filters:
            layers += [nn.Conv2d(channels, number, size, stride), nn.ReLU()]
            sizes = [(n - size) // stride + 1 for n in sizes]
            channels = number
        super().__init__(observation_space, channels * sizes[0] * sizes[1])
        self.layers = nn.Sequential(*layers, nn.Flatten())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features, shape ``(B, features_dim)``."""
        features: torch.Tensor = self.layers(observations)
        return features


class SmallCnn(Convolutions):
    """MinAtar's own convolution (Young and Tian 2019)."""

    filters = ((16, 3, 1),)


class DataEfficientCnn(Convolutions):
    """Data-efficient Rainbow's convolutions (van Hasselt et al. 2019)."""

    filters = ((32, 5, 5), (64, 5, 5))
    channels_last = True  # in memory, which is faster


def extractor_of(env: str) -> type[BaseFeaturesExtractor]:
    """The extractor for the images of an environment."""
    return DataEfficientCnn if env.startswith(ATARI) else SmallCnn
