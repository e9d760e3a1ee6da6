"""Rainbow's Q-network."""

from contextlib import nullcontext
from inspect import signature
from itertools import pairwise
from operator import index
from typing import Any, Literal, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_rainbow.network.convolutions import gains_by_channels_last
from sb3_rainbow.network.losses import mask_q_values
from sb3_rainbow.network.noisy_linear import NoisyLinear, scale_noise_, silenced
from sb3_rainbow.type_aliases import Distributional, NetArch, NoisyLayers

# Where the layers are that a network calls by itself
_LAYERS = ("layers", "value_layers", "advantage_layers")


class AsVector(BaseModel):
    """A model of SB3's whose weights may be parts of one vector."""

    @th.no_grad()
    def separate(self) -> None:
        """Give each weight, noise and moment a memory of its own: pickle stores memory whole."""
        optimizer = getattr(self, "optimizer", None)
        states = getattr(optimizer, "state", {}).values()  # a wrapper may have none
        moments = [v for state in states for v in state.values() if isinstance(v, th.Tensor)]
        noise = [e for m in self.modules() if isinstance(m, NoisyLinear) for e in m.buffers()]
        for tensor in [*moments, *self.parameters(), *noise]:
            if tensor.device.type == "cpu" and tensor.is_shared():
                continue  # with other processes, which look for it where it is
            if tensor.untyped_storage().nbytes() > tensor.numel() * tensor.element_size():
                tensor.data = tensor.detach().clone()

    def __getstate__(self) -> dict[str, Any]:
        self.separate()
        return self.__dict__.copy()

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:  # type: ignore[override]
        """As torch's, of tensors that share no memory."""
        self.separate()
        return super().state_dict(*args, **kwargs)


class RainbowNetwork(AsVector, BasePolicy):
    """Q-network with a dueling, distributional head and noisy layers, each of which can be off.

    Its outputs are ``n_atoms`` for the state value (dueling only) and ``n_atoms`` for each action's
    advantage: logits over the atoms of a support, or as many quantiles of the return, or, without
    ``distributional``, one, which is the Q-value itself.

    Args:
        features_extractor: extractor, whose layers are never noisy.
        features_dim: its number of outputs.
        net_arch: sizes of the hidden layers, which value and advantages share up to the head; or
            ``dict(shared=[...], streams=[...])``, where each of the two then has layers of its own.
        activation_fn: between the layers, one module for all of them: parameters that it has,
            ``PReLU``'s say, are shared.
        dueling: separate streams for value and advantages (Wang et al. 2016).
        noisy: noisy linear layers (Fortunato et al. 2018).
        noisy_layers: ``"last_two"`` (last hidden layer and head), ``"head"`` or ``"all"``; of
            streams, the last of each.
        distributional: ``"categorical"`` or True (Bellemare et al. 2017), ``"quantile"`` (Dabney et
            al. 2018), or False.

    Raises:
        ValueError: for an unknown ``noisy_layers`` or ``distributional``, a ``net_arch`` of
            another form, too few atoms or ``v_min >= v_max``.
    """

    action_space: spaces.Discrete
    support: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        net_arch: NetArch | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        dueling: bool = True,
        noisy: bool = True,
        noisy_layers: NoisyLayers = "last_two",
        sigma0: float = 0.5,
        distributional: Distributional = True,
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
        self.head = head_of(distributional)
        least = 2 if self.head == "categorical" else 1
        if self.head != "scalar" and (n_atoms < least or n_atoms != int(n_atoms)):
            raise ValueError(f"n_atoms must be a whole number, at least {least}, got {n_atoms}")
        if self.head == "categorical" and not -np.inf < v_min < v_max < np.inf:
            raise ValueError(f"v_min must be below v_max, both finite, got {v_min} and {v_max}")
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
        self.n_atoms = int(n_atoms) if distributional else 1
        self.v_min = v_min
        self.v_max = v_max
        # A constant, not a weight: what loads or randomizes the weights must not change it.
        self.register_buffer("support", th.linspace(v_min, v_max, self.n_atoms), persistent=False)
        self._build_layers()
        self.reset_noise()

    @property
    def device(self) -> th.device:
        """Where the network lives; SB3's own way walks over the parameters at every step."""
        return self.support.device

    def _build_layers(self) -> None:
        shared, streams = split_arch(self.net_arch)
        depth = len(shared) + len(streams) + 1
        sizes, n_out = [self.features_dim, *shared], self.n_actions * self.n_atoms
        if streams:
            self.layers = self._make_layers(sizes, 0, depth)
            sizes = [sizes[-1], *streams]
            if self.dueling:
                self.value_layers = self._make_layers([*sizes, self.n_atoms], len(shared), depth)
            self.advantage_layers = self._make_layers([*sizes, n_out], len(shared), depth)
        else:
            n_out += self.n_atoms if self.dueling else 0
            self.layers = self._make_layers([*sizes, n_out], 0, depth)
        self.activation = self.activation_fn()

    def _make_layers(self, sizes: list[int], first: int, depth: int) -> nn.ModuleList:
        """Layers between these sizes, from the ``first`` on of a network ``depth`` layers deep."""
        n_noisy = {"last_two": 2, "head": 1, "all": depth}[self.noisy_layers] if self.noisy else 0
        layers: list[nn.Module] = []
        for i, (n_in, n_out) in enumerate(pairwise(sizes), start=first):
            if i < depth - n_noisy:
                layers.append(nn.Linear(n_in, n_out))
                continue
            shared = self.n_atoms if i == depth - 1 and self.head == "quantile" else 1
            layers.append(NoisyLinear(n_in, n_out, self.sigma0, shared))
        return nn.ModuleList(layers)

    def extract_features(
        self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor
    ) -> th.Tensor:
        """As SB3's; large images get their channels last."""
        images = isinstance(obs, th.Tensor) and obs.ndim == 4
        if images and gains_by_channels_last(features_extractor):
            assert isinstance(obs, th.Tensor)
            obs = obs.contiguous(memory_format=th.channels_last)
        return super().extract_features(obs, features_extractor)

    def _own_layers(self) -> list[nn.Module]:
        """The layers that :meth:`streams` calls; none where a subclass does without."""
        lists = [self._modules.get(name) for name in _LAYERS]
        return [layer for layers in lists if layers is not None for layer in layers.children()]

    def layers_drawn_together(self) -> list[NoisyLinear]:
        """The network's own noisy layers that draw their noise as ``NoisyLinear`` does."""
        return [
            layer
            for layer in self._own_layers()
            if isinstance(layer, NoisyLinear)
            and type(layer).reset_noise is NoisyLinear.reset_noise
            and "reset_noise" not in vars(layer)
        ]

    def _layers_called_by_others(self) -> list[NoisyLinear]:
        """Noisy layers inside of wrappers, in the features extractor, or of a subclass's own."""
        own = set(map(id, self._own_layers()))
        return [m for m in self.modules() if isinstance(m, NoisyLinear) and id(m) not in own]

    @th.no_grad()
    def reset_noise(self, n_envs: int = 1) -> None:
        """Draw new noise for every noisy layer, for each of ``n_envs`` environments its own.

        With one environment all rows of a batch share a noise, as in an update.
        """
        together = self.layers_drawn_together()
        if together:  # one call of the generator takes a fraction of the time of many
            noises = (
                noise for layer in together for noise in (layer.epsilon_in, layer.epsilon_out)
            )
            sizes = [noise.numel() for noise in noises]
            shape = (sum(sizes),) if n_envs == 1 else (n_envs, sum(sizes))
            parts = iter(scale_noise_(self.support.new_empty(shape).normal_()).split(sizes, dim=-1))
            for layer in together:
                layer.set_noise(next(parts), next(parts))
        for module in self.modules():
            if isinstance(module, NoisyLinear) and module not in together:
                module.reset_noise()

    def noise_magnitudes(self) -> dict[str, float]:
        """Mean absolute sigma of each noisy layer's weights, by its place among the layers."""
        return {
            f"layer{i}": float(layer.weight_sigma.detach().abs().mean())
            for i, layer in enumerate(self._own_layers())
            if isinstance(layer, NoisyLinear)
        }

    def streams(self, obs: PyTorchObs, noisy: bool) -> th.Tensor:
        """Outputs of the head ``(B, n_streams, n_atoms)`` before value and advantages are joined,
        for acting, target and loss; the value first where there is one.
        """
        with nullcontext() if noisy else silenced(self._layers_called_by_others()):
            features = self.extract_features(obs, self.features_extractor)
            outputs = self._run(self.layers, features, noisy)
            if "advantage_layers" in self._modules:
                shared = self.activation(outputs) if self.layers else outputs
                outputs = self._run(self.advantage_layers, shared, noisy)
                if self.dueling:
                    value = self._run(self.value_layers, shared, noisy)
                    outputs = th.cat([value, outputs], dim=1)
        rows, columns = outputs.shape
        return outputs.view(rows, columns // self.n_atoms, self.n_atoms)  # of no row, too

    def _run(self, layers: nn.ModuleList, hidden: th.Tensor, noisy: bool) -> th.Tensor:
        """Outputs of layers in a row, with activations between them."""
        last = len(layers) - 1
        for i, layer in enumerate(layers):
            hidden = layer(hidden, noisy) if isinstance(layer, NoisyLinear) else layer(hidden)
            if i < last:
                hidden = self.activation(hidden)
        return hidden

    def join(self, streams: th.Tensor) -> th.Tensor:
        """Logits ``(B, A, N)`` of the :meth:`streams`: value plus advantage minus the mean
        advantage, atom by atom (Wang et al. 2016, equation 9).
        """
        if not self.dueling:
            return streams
        advantages = streams[:, 1:]
        return advantages + (streams[:, :1] - advantages.mean(dim=1, keepdim=True))

    def expected_values(self, logits: th.Tensor) -> th.Tensor:
        """Q-values ``(B, A)`` of the head's outputs ``(B, A, N)``."""
        if self.head == "scalar":
            return logits.squeeze(-1)
        if self.head == "quantile":
            return logits.mean(dim=-1)
        return F.softmax(logits, dim=-1) @ self.support

    def logits(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Logits over the atoms, or quantiles, or Q-values, of each action, ``(B, A, N)``."""
        return self.join(self.streams(obs, noisy))

    def forward(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Q-values ``(B, A)``, by default without the layers' current noise."""
        return self.expected_values(self.logits(obs, noisy))

    def distribution(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Probabilities of each action's atoms, ``(B, A, N)``; quantiles are equally likely."""
        logits = self.logits(obs, noisy)
        if self.head == "categorical":
            return F.softmax(logits, dim=-1)
        return th.full_like(logits, 1.0 / self.n_atoms)

    def _predict(
        self,
        observation: PyTorchObs,
        deterministic: bool = True,
        action_masks: th.Tensor | None = None,
    ) -> th.Tensor:
        q_values = self(observation, noisy=not deterministic)
        return mask_q_values(q_values, action_masks).argmax(dim=1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in signature(RainbowNetwork).parameters}


def head_of(distributional: Distributional) -> Literal["scalar", "categorical", "quantile"]:
    """What a head predicts."""
    if isinstance(distributional, bool | np.bool_):
        return "categorical" if distributional else "scalar"
    if distributional in ("categorical", "quantile"):
        return distributional
    raise ValueError(
        f"distributional must be True, False, 'categorical' or 'quantile', got {distributional!r}"
    )


def split_arch(net_arch: NetArch) -> tuple[list[int], list[int]]:
    """Sizes of the hidden layers that all streams share, and of those of each."""
    sizes = net_arch if isinstance(net_arch, dict) else {"shared": net_arch}
    try:
        if not sizes.keys() <= {"shared", "streams"}:
            raise ValueError
        if not all(isinstance(part, list | tuple) for part in sizes.values()):
            raise ValueError  # SB3 could not load a model of an array
        shared, streams = ([index(n) for n in sizes.get(k, [])] for k in ("shared", "streams"))
        if min([*shared, *streams], default=1) < 1:
            raise ValueError
    except (TypeError, ValueError):
        raise ValueError(
            "net_arch must be a list of positive sizes or dict(shared=[...], streams=[...]), "
            f"got {net_arch!r}"
        ) from None
    return shared, streams
