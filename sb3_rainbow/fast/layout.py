"""Where a perceptron's numbers lie for the kernels; see :mod:`sb3_rainbow.fast.mlp_kernels`."""

import numpy as np
from numpy.typing import NDArray
from torch import nn

from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.network.rainbow_network import RainbowNetwork

_PARAMETERS = {
    NoisyLinear: ("weight_mu", "weight_sigma", "bias_mu", "bias_sigma"),
    nn.Linear: ("weight", "bias"),
}


def parameters_of(net: RainbowNetwork) -> list[nn.Parameter]:
    """The layers' parameters in the order in which the kernels want them, then the extractor's."""
    own = [getattr(layer, name) for layer in net.layers for name in _PARAMETERS[type(layer)]]
    return [*own, *net.features_extractor.parameters()]


def table_of(net: RainbowNetwork) -> NDArray[np.int64]:
    """Sizes and offsets of each layer, ``(n_layers, 8)``."""
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
