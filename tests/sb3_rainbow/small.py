"""Settings of models that learn within a second, batches, policies with a network of one's own."""

from typing import Any

import numpy as np
import torch as th

from sb3_rainbow import MlpPolicy
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

FAST: dict[str, Any] = {
    "learning_starts": 20,
    "buffer_size": 500,
    "batch_size": 8,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16]},
}


def random_batch(
    size: int, n_actions: int, n: int, seed: int = 0, masks: th.Tensor | None = None
) -> Batch:
    """Transitions of ``size`` numbers each, some terminated, of one to three rewards."""
    generator = th.Generator().manual_seed(seed)
    return Batch(
        observations=th.randn(n, size, generator=generator),
        actions=th.randint(0, n_actions, (n, 1), generator=generator),
        next_observations=th.randn(n, size, generator=generator),
        dones=(th.rand(n, 1, generator=generator) < 0.3).float(),
        rewards=2 * th.randn(n, 1, generator=generator),
        discounts=0.9 ** th.randint(1, 4, (n, 1), generator=generator).float(),
        weights=th.rand(n, generator=generator),
        indices=np.arange(n),
        next_action_masks=masks,
    )


def policy_of(network: type[RainbowNetwork]) -> type[MlpPolicy]:
    """A policy whose networks are of a class."""

    class Policy(MlpPolicy):
        def make_q_net(self) -> RainbowNetwork:
            arguments = self._update_features_extractor(self.net_args, features_extractor=None)
            return network(**arguments).to(self.device)

    return Policy
