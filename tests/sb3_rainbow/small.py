"""Settings of models that learn within a second, and policies with networks of one's own."""

from typing import Any

from sb3_rainbow import MlpPolicy
from sb3_rainbow.network.rainbow_network import RainbowNetwork

FAST: dict[str, Any] = {
    "learning_starts": 20,
    "buffer_size": 500,
    "batch_size": 8,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16]},
}


def policy_of(network: type[RainbowNetwork]) -> type[MlpPolicy]:
    """A policy whose networks are of a class."""

    class Policy(MlpPolicy):
        def make_q_net(self) -> RainbowNetwork:
            arguments = self._update_features_extractor(self.net_args, features_extractor=None)
            return network(**arguments).to(self.device)

    return Policy
