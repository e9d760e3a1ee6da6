"""Rainbow's Q-network."""

from collections.abc import Iterator
from contextlib import nullcontext
from itertools import pairwise
from typing import Any, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_rainbow.network.losses import mask_q_values
from sb3_rainbow.network.noisy_linear import NoisyLinear, scale_noise_, silenced
from sb3_rainbow.network.shared_memory import separate, share
from sb3_rainbow.type_aliases import NoisyLayers

# Modules that hold no noisy layer and do not mind whether they are trained
_NOTHING_INSIDE = {
    *(NoisyLinear, nn.Linear, FlattenExtractor),
    *(nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.SiLU, nn.GELU),
}


class RainbowNetwork(BasePolicy):
    """
    Q-network with a dueling, distributional head and noisy layers, each of which can be off.

    The head is one linear layer with ``n_atoms`` outputs for the state value (dueling only) and
    ``n_atoms`` for each action's advantage. Without ``distributional`` there is one atom, which is
    the Q-value itself.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: extractor, whose layers are never noisy
    :param features_dim: its number of outputs
    :param net_arch: sizes of the hidden layers
    :param activation_fn: activation between them
    :param normalize_images: whether to divide images by 255
    :param dueling: separate streams for value and advantages (Wang et al. 2016)
    :param noisy: noisy linear layers (Fortunato et al. 2018)
    :param noisy_layers: ``"last_two"`` (last hidden layer and head), ``"head"`` or ``"all"``
    :param sigma0: initial noise scale
    :param distributional: categorical distribution over returns (Bellemare et al. 2017)
    :param n_atoms: atoms of the support
    :param v_min: lowest atom
    :param v_max: highest atom
    :raises ValueError: for an unknown ``noisy_layers``, ``n_atoms`` < 2 or ``v_min >= v_max``
    """

    action_space: spaces.Discrete
    support: th.Tensor
    noise: th.Tensor
    _noise_addresses: list[int] | None = None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        dueling: bool = True,
        noisy: bool = True,
        noisy_layers: NoisyLayers = "last_two",
        sigma0: float = 0.5,
        distributional: bool = True,
        n_atoms: int = 51,
        v_min: float = -100.0,
        v_max: float = 100.0,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
        )
        if distributional:
            check_support(n_atoms, v_min, v_max)
        if noisy_layers not in get_args(NoisyLayers):
            raise ValueError(
                f"noisy_layers must be one of {get_args(NoisyLayers)}, got {noisy_layers!r}"
            )
        self.net_arch = [64, 64] if net_arch is None else net_arch
        self.activation_fn = activation_fn
        self.features_dim = features_dim
        self.dueling = dueling
        self.noisy = noisy
        self.noisy_layers = noisy_layers
        self.sigma0 = sigma0
        self.distributional = distributional
        self.n_actions = int(action_space.n)
        self.n_atoms = n_atoms if distributional else 1
        self.v_min = v_min
        self.v_max = v_max
        # A constant, not a weight: what loads or randomizes the weights must not change it.
        self.register_buffer("support", th.linspace(v_min, v_max, self.n_atoms), persistent=False)
        self.register_buffer("noise", th.zeros(0), persistent=False)
        self._build_layers()
        self.reset_noise()

    @property
    def device(self) -> th.device:
        """Where the network lives; SB3's own way walks over the parameters at every step."""
        return self.support.device

    def _build_layers(self) -> None:
        n_streams = self.n_actions + (1 if self.dueling else 0)
        sizes = [self.features_dim, *self.net_arch, n_streams * self.n_atoms]
        n_layers = len(sizes) - 1
        n_noisy = {"last_two": 2, "head": 1, "all": n_layers}[self.noisy_layers]
        first_noisy = n_layers - n_noisy if self.noisy else n_layers
        self.layers = nn.ModuleList()
        for i, (n_in, n_out) in enumerate(pairwise(sizes)):
            is_noisy = i >= first_noisy
            self.layers.append(
                NoisyLinear(n_in, n_out, self.sigma0) if is_noisy else nn.Linear(n_in, n_out)
            )
        self.activation = self.activation_fn()

    def _own_layers(self) -> list[nn.Module]:
        """The layers that :meth:`streams` calls; none where a subclass does without."""
        layers = self._modules.get("layers")
        return [] if layers is None else list(layers.children())

    def _epsilons(self) -> list[th.Tensor]:
        """The noise of the layers that draw it as the package's own do, in their order."""
        layers = [layer for layer in self._own_layers() if _draws_plainly(layer)]
        return [b for x in layers for b in (x._buffers["epsilon_in"], x._buffers["epsilon_out"])]  # type: ignore[misc]

    def tie_noise(self) -> list[th.Tensor]:
        """
        Let the layers' epsilons be parts of ``noise``, so that they are drawn in one go.

        They no longer are after a layer was replaced, or the network moved or copied.

        :return: the epsilons
        """
        epsilons = self._epsilons()
        if [e.data_ptr() for e in epsilons] != self._noise_addresses:
            self.noise = th.cat(epsilons) if epsilons else self.support.new_zeros(0)
            self._noise_addresses = share(epsilons, self.noise)
        return epsilons

    def _layers_called_by_others(self) -> Iterator[NoisyLinear]:
        """Noisy layers inside of wrappers, in the features extractor, or of a subclass's own."""
        own = self._own_layers()
        for part in self._parts():
            if isinstance(part, NoisyLinear) or type(part) not in _NOTHING_INSIDE:
                inside = (m for m in part.modules() if isinstance(m, NoisyLinear))
                yield from (m for m in inside if not any(m is layer for layer in own))

    def _parts(self) -> list[nn.Module]:
        others = [part for name, part in self._modules.items() if name != "layers" and part]
        return [*others, *self._own_layers()]

    def __getstate__(self) -> dict[str, Any]:
        # Pickle would store the whole memory of which a tensor is a part with every part.
        separate([*self.parameters(), *self._epsilons()])
        return {**self.__dict__, "_noise_addresses": None}

    @th.no_grad()
    def reset_noise(self) -> None:
        """Draw new noise for every noisy layer."""
        if self.tie_noise():
            scale_noise_(self.noise.normal_())
        for layer in self._own_layers():
            if isinstance(layer, NoisyLinear) and not _draws_plainly(layer):
                layer.reset_noise()
        for layer in self._layers_called_by_others():
            layer.reset_noise()

    def noise_magnitudes(self) -> dict[str, float]:
        """Mean absolute sigma of each noisy layer, by the layer's place among the layers."""
        return {
            f"layer{i}": float(layer.noise_magnitude())
            for i, layer in enumerate(self._own_layers())
            if isinstance(layer, NoisyLinear)
        }

    def streams(self, obs: PyTorchObs, noisy: bool) -> th.Tensor:
        """
        Outputs of the head before value and advantages are joined. Acting, target and loss all go
        through here.

        :return: shape ``(B, n_streams, n_atoms)``, the value first where there is one
        """
        with nullcontext() if noisy else silenced(self._layers_called_by_others()):
            hidden = self.extract_features(obs, self.features_extractor)
            last = len(self.layers) - 1
            for i, layer in enumerate(self.layers):
                hidden = layer(hidden, noisy) if isinstance(layer, NoisyLinear) else layer(hidden)
                if i < last:
                    hidden = self.activation(hidden)
        return hidden.view(hidden.shape[0], -1, self.n_atoms)

    def join(self, streams: th.Tensor) -> th.Tensor:
        """
        Value plus advantage minus the mean advantage over actions, atom by atom (Wang et al. 2016,
        equation 9): without the mean the split of value and advantages would be arbitrary.

        :param streams: as :meth:`streams` returns them
        :return: logits over the atoms, shape ``(B, A, N)``
        """
        if not self.dueling:
            return streams
        advantages = streams[:, 1:]
        return advantages + (streams[:, :1] - advantages.mean(dim=1, keepdim=True))

    def expected_values(self, logits: th.Tensor) -> th.Tensor:
        """
        :param logits: shape ``(B, A, N)``
        :return: Q-values, shape ``(B, A)``
        """
        if not self.distributional:
            return logits.squeeze(-1)
        return F.softmax(logits, dim=-1) @ self.support

    def logits(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """
        Logits over the atoms for each action (without ``distributional``, the Q-values).

        :return: shape ``(B, A, N)``
        """
        return self.join(self.streams(obs, noisy))

    def forward(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """
        Q-values, by default without noise.

        :param obs: a batch of observations
        :param noisy: whether the noisy layers use their current noise
        :return: shape ``(B, A)``
        """
        return self.expected_values(self.logits(obs, noisy))

    def distribution(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """
        Probabilities of the atoms for each action (all 1 without ``distributional``).

        :return: shape ``(B, A, N)``
        """
        return F.softmax(self.logits(obs, noisy), dim=-1)

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the network in training or evaluation mode, of which the noisy layers take no notice.

        :param mode: True for training, False for evaluation
        """
        if mode != self.training or not _NOTHING_INSIDE.issuperset(map(type, self._parts())):
            self.train(mode)

    def _predict(
        self,
        observation: PyTorchObs,
        deterministic: bool = True,
        action_masks: th.Tensor | None = None,
    ) -> th.Tensor:
        q_values = self(observation, noisy=not deterministic)
        return mask_q_values(q_values, action_masks).argmax(dim=1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        names = (
            *("net_arch", "activation_fn", "features_dim", "features_extractor", "dueling"),
            *("noisy", "noisy_layers", "sigma0", "distributional", "n_atoms", "v_min", "v_max"),
        )
        data.update({name: getattr(self, name) for name in names})
        return data


def _draws_plainly(layer: nn.Module) -> bool:
    """Whether a layer's noise is what :class:`NoisyLinear` draws."""
    if not isinstance(layer, NoisyLinear) or "reset_noise" in vars(layer):
        return False
    return type(layer).reset_noise is NoisyLinear.reset_noise


def check_support(n_atoms: int, v_min: float, v_max: float) -> None:
    """
    :raises ValueError: if the atoms do not form a support
    """
    if n_atoms < 2 or n_atoms != int(n_atoms):
        raise ValueError(f"n_atoms must be a whole number, at least 2, got {n_atoms}")
    if not (np.isfinite(v_min) and np.isfinite(v_max) and v_min < v_max):
        raise ValueError(f"v_min must be below v_max, both finite, got {v_min} and {v_max}")
