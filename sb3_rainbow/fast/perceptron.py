"""Which networks the kernels know, and where a network's numbers lie for them."""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_rainbow.fast import mlp_kernels as kernels
from sb3_rainbow.fast.originals import are_untouched
from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.network.shared_memory import is_dense

# An extractor of these parts alone has the same features for the target network, and however often
# it is called: nothing in it changes, learns or draws random numbers.
_STATELESS = (FlattenExtractor, CombinedExtractor, nn.ModuleDict, nn.Flatten)
# Weights behind an extractor that learns up to which the kernels pay: beyond, the products of
# matrices are what costs, and torch has more threads for them
_MOST_WEIGHTS = 500_000


def is_perceptron(net: RainbowNetwork) -> bool:
    """Of the package's own parts alone, each in its place once, behind any extractor."""
    if type(net) is not RainbowNetwork or type(net.activation) is not nn.ReLU:
        return False
    layers = list(net.layers)
    if "advantage_layers" in net._modules:
        return False
    own = all(type(layer) in (nn.Linear, NoisyLinear) for layer in layers)
    if not (own and _extracts_plainly(net) and are_untouched(net)):
        return False
    parameters, table = parameters_of(net), table_of(net)
    n_parameters = int(((1 + table[:, kernels.NOISY]) * _sizes(table)).sum())
    learns = list(net.features_extractor.parameters())
    if learns and n_parameters > _MOST_WEIGHTS:
        return False
    return (
        len(parameters) == len(set(map(id, parameters))) == len(list(net.parameters()))
        and all(
            p is not None and (p.dtype, p.device.type) == (th.float32, "cpu") and is_dense(p)
            for p in parameters
        )
        and sum(p.numel() for p in parameters) - sum(p.numel() for p in learns) == n_parameters
        and table[0, kernels.INPUTS] == net.features_dim
        and table[-1, kernels.OUTPUTS] == (net.n_actions + net.dueling) * net.n_atoms
        and bool((table[1:, kernels.INPUTS] == table[:-1, kernels.OUTPUTS]).all())
    )


def is_stateless(net: RainbowNetwork) -> bool:
    """Whether the features of one network's extractor are those of any other's."""
    return all(type(module) in _STATELESS for module in net.features_extractor.modules())


def _extracts_plainly(net: RainbowNetwork) -> bool:
    # Buffers would have to follow to the target network, and noise be drawn.
    extractor = net.features_extractor
    return not (
        list(extractor.buffers()) or any(isinstance(m, NoisyLinear) for m in extractor.modules())
    )


def constants_of(net: RainbowNetwork) -> tuple[Any, ...]:
    """What two networks must have in common besides their tables."""
    return (net.n_actions, net.n_atoms, net.head, net.dueling, net.v_min, net.v_max)


def parameters_of(net: RainbowNetwork) -> list[nn.Parameter]:
    """In the order in which the kernels want them, then what the extractor learns."""
    names = {
        NoisyLinear: ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma"),
        nn.Linear: ("weight", "bias"),
    }
    own = [getattr(layer, name) for layer in net.layers for name in names[type(layer)]]
    return [*own, *net.features_extractor.parameters()]


def table_of(net: RainbowNetwork) -> NDArray[np.int64]:
    """Where each layer lies; see :mod:`sb3_rainbow.fast.mlp_kernels`."""
    rows = []
    parameters = noise = effective = hidden = 0
    for layer in net.layers:
        assert isinstance(layer, NoisyLinear | nn.Linear)
        noisy = isinstance(layer, NoisyLinear)
        n_in, n_out = layer.in_features, layer.out_features
        shared = layer.outputs_per_noise if noisy else 1
        rows.append([n_in, n_out, int(noisy), parameters, noise, effective, hidden, shared])
        size = (n_in + 1) * n_out
        parameters += 2 * size if noisy else size
        noise += n_in + n_out if noisy else 0
        effective += size if noisy else 0
        hidden += n_out
    return np.asarray(rows, dtype=np.int64)


def _sizes(table: NDArray[np.int64]) -> NDArray[np.int64]:
    return (table[:, kernels.INPUTS] + 1) * table[:, kernels.OUTPUTS]
