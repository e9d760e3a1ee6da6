"""Convolutions for images, without the layer after them."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN


def gains_by_channels_last(extractor: th.nn.Module) -> bool:
    """Whether an extractor works with channels last, which is faster on images of Atari's size.

    A user's own may have a ``view`` in it, which that order does not allow; a class without one
    says ``channels_last = True``.
    """
    return type(extractor) is NatureCNN or vars(type(extractor)).get("channels_last", False)


class NatureConvolutions(NatureCNN):
    """The three convolutions of SB3's ``NatureCNN`` (Mnih et al. 2015), flattened.

    Rainbow's streams follow, 512 noisy units for the value and as many for the advantages (Hessel
    et al. 2018), without a layer in between.

    Args:
        observation_space: of images, channels first, at least 36 by 36 pixels.
        features_dim: of ``NatureCNN``'s last layer, which is not here: None, or a ``ValueError``.
        normalized_image: whether the images are scaled to [0, 1] already.
    """

    channels_last = True

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int | None = None,
        normalized_image: bool = False,
    ) -> None:
        if features_dim is not None:
            raise ValueError(
                f"features_dim={features_dim}: NatureConvolutions end without a layer of it; pass "
                f"net_arch=dict(streams=[{features_dim}]), or features_extractor_class=NatureCNN"
            )
        super().__init__(observation_space, 1, normalized_image)
        first = self.linear[0]
        assert isinstance(first, th.nn.Linear)
        self._features_dim = first.in_features
        self.linear = th.nn.Sequential()
