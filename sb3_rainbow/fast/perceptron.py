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

# What an extractor may consist of. The kernels let the online network's serve the target too, and
# call it as often as suits them: nothing in it may change, learn or draw random numbers.
_STATELESS = (FlattenExtractor, CombinedExtractor, nn.ModuleDict, nn.Flatten)


def is_perceptron(net: RainbowNetwork) -> bool:
    """Of the package's own parts alone, each in its place once."""
    if type(net) is not RainbowNetwork or type(net.activation) is not nn.ReLU:
        return False
    layers = list(net.layers)
    if "advantage_layers" in net._modules:
        return False
    own = all(type(layer) in (nn.Linear, NoisyLinear) for layer in layers)
    stateless = all(type(module) in _STATELESS for module in net.features_extractor.modules())
    if not (own and stateless and are_untouched(net.modules())):
        return False
    parameters, table = parameters_of(net), table_of(net)
    n_parameters = int(((1 + table[:, kernels.NOISY]) * _sizes(table)).sum())
    return (
        len(parameters) == len(set(map(id, parameters))) == len(list(net.parameters()))
        and all(
            p is not None and (p.dtype, p.device.type) == (th.float32, "cpu") and p.is_contiguous()
            for p in parameters
        )
        and sum(p.numel() for p in parameters) == n_parameters
        and table[0, kernels.INPUTS] == net.features_dim
        and table[-1, kernels.OUTPUTS] == (net.n_actions + net.dueling) * net.n_atoms
        and bool((table[1:, kernels.INPUTS] == table[:-1, kernels.OUTPUTS]).all())
    )


def constants_of(net: RainbowNetwork) -> tuple[Any, ...]:
    """What two networks must have in common besides their tables."""
    return (net.n_actions, net.n_atoms, net.head, net.dueling, net.v_min, net.v_max)


def parameters_of(net: RainbowNetwork) -> list[nn.Parameter]:
    """In the order in which the kernels want them."""
    names = {
        NoisyLinear: ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma"),
        nn.Linear: ("weight", "bias"),
    }
    return [getattr(layer, name) for layer in net.layers for name in names[type(layer)]]


def table_of(net: RainbowNetwork) -> NDArray[np.int64]:
    """Where each layer lies; see :mod:`sb3_rainbow.fast.mlp_kernels`."""
    rows = []
    parameters = noise = effective = hidden = 0
    for layer in net.layers:
        assert isinstance(layer, NoisyLinear | nn.Linear)
        noisy = isinstance(layer, NoisyLinear)
        n_in, n_out = layer.in_features, layer.out_features
        rows.append([n_in, n_out, int(noisy), parameters, noise, effective, hidden])
        size = (n_in + 1) * n_out
        parameters += 2 * size if noisy else size
        noise += n_in + n_out if noisy else 0
        effective += size
        hidden += n_out
    return np.asarray(rows, dtype=np.int64)


def _sizes(table: NDArray[np.int64]) -> NDArray[np.int64]:
    return (table[:, kernels.INPUTS] + 1) * table[:, kernels.OUTPUTS]
