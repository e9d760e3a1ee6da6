"""Feature extractors for images, as those who defined the tasks have them."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from benchmarks.protocol.plan import ATARI


class Convolutions(BaseFeaturesExtractor):
    """Layers on images with channels first."""

    layers: nn.Sequential

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features, shape ``(B, features_dim)``."""
        features: torch.Tensor = self.layers(observations)
        return features


class SmallCnn(Convolutions):
    """MinAtar's own convolution (Young and Tian 2019): 16 filters of 3 x 3, then ReLU.

    Args:
        observation_space: images with channels first, 3 x 3 pixels or more.
    """

    def __init__(self, observation_space: spaces.Box) -> None:
        channels, rows, columns = observation_space.shape
        filters = 16
        super().__init__(observation_space, filters * (rows - 2) * (columns - 2))
        self.layers = nn.Sequential(nn.Conv2d(channels, filters, 3), nn.ReLU(), nn.Flatten())


class DataEfficientCnn(Convolutions):
    """Data-efficient Rainbow's convolutions (van Hasselt et al. 2019): 32, then 64 of 5 x 5 by 5.

    Args:
        observation_space: images with channels first, 25 x 25 pixels or more.
    """

    channels_last = True  # in memory, which is faster

    def __init__(self, observation_space: spaces.Box) -> None:
        channels, rows, columns = observation_space.shape
        super().__init__(observation_space, 64 * (rows // 5 // 5) * (columns // 5 // 5))
        first, second = nn.Conv2d(channels, 32, 5, stride=5), nn.Conv2d(32, 64, 5, stride=5)
        self.layers = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), nn.Flatten())


def extractor_of(env: str) -> type[BaseFeaturesExtractor]:
    """The extractor for the images of an environment."""
    return DataEfficientCnn if env.startswith(ATARI) else SmallCnn
