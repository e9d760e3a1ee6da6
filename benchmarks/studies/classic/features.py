"""A feature extractor for images that SB3's NatureCNN refuses, those below 36 x 36 pixels."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class SmallCnn(BaseFeaturesExtractor):
    """MinAtar's own convolution (Young and Tian 2019): 16 filters of 3 x 3, then ReLU.

    Args:
        observation_space: images with channels first, 3 x 3 pixels or more.
    """

    def __init__(self, observation_space: spaces.Box) -> None:
        channels, rows, columns = observation_space.shape
        filters = 16
        super().__init__(observation_space, filters * (rows - 2) * (columns - 2))
        self.layers = nn.Sequential(nn.Conv2d(channels, filters, 3), nn.ReLU(), nn.Flatten())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features, shape ``(B, features_dim)``."""
        features: torch.Tensor = self.layers(observations)
        return features
