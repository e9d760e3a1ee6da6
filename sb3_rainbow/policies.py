"""Policies of Rainbow: the online and the target network, and how actions are chosen."""

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn.parameter import is_lazy

from sb3_rainbow.masking.conventions import as_action_masks
from sb3_rainbow.network.convolutions import NatureConvolutions
from sb3_rainbow.network.rainbow_network import AsVector, RainbowNetwork
from sb3_rainbow.type_aliases import NetArch, NoisyLayers, ObsArray

# Optimizers that have one kernel for all parameters: a quarter of the time of one per parameter
_WITH_FUSED_KERNEL = (th.optim.Adam, th.optim.AdamW)
_NOT_WITH_FUSED = {"foreach", "differentiable"}


class RainbowPolicy(AsVector, BasePolicy):
    """Policy with the online and the target network of Rainbow.

    The arguments after ``lr_schedule`` are those of SB3's ``DQNPolicy``, then ``noisy_layers``,
    then the ones that :class:`~sb3_rainbow.Rainbow` hands over from its own constructor to
    :class:`~sb3_rainbow.network.rainbow_network.RainbowNetwork`.

    Args:
        lr_schedule: ``lr_schedule(1)`` is the initial rate.
        net_arch: sizes of the hidden layers, or ``dict(shared=[...], streams=[...])``; [64, 64],
            none after ``NatureCNN``, streams of 512 after ``NatureConvolutions``.
        features_extractor_class: features extractor to use; None for the policy's own.
        normalize_images: whether to divide images by 255.
        optimizer_kwargs: the optimizer's arguments besides the learning rate.
        noisy_layers: ``"last_two"``, ``"head"`` or ``"all"``.
        network: ``dueling``, ``noisy``, ``sigma0``, ``distributional``, ``n_atoms``, ``v_min`` and
            ``v_max``, see ``Rainbow``.

    Raises:
        ValueError: without ``distributional``, which Rainbow hands over and no other algorithm.
    """

    q_net: RainbowNetwork
    q_net_target: RainbowNetwork
    _default_extractor: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    _parameters_then: Sequence[nn.Parameter] = ()  # the online network's at the last check

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Discrete,
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        noisy_layers: NoisyLayers = "last_two",
        **network: Any,
    ) -> None:
        if network.get("distributional") is None:
            raise ValueError(
                f"{type(self).__name__} needs distributional, which Rainbow hands to it: a file of "
                "Rainbow is loaded by Rainbow.load, and no other algorithm can use its policies"
            )
        if features_extractor_class is None:
            features_extractor_class = self._default_extractor
            if features_extractor_class is NatureConvolutions and (
                "features_dim" in (features_extractor_kwargs or {})
            ):
                features_extractor_class = NatureCNN  # a size asks for the layer that has it
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=normalize_images,
        )
        if net_arch is None:
            net_arch = [] if features_extractor_class is NatureCNN else [64, 64]
            if features_extractor_class is NatureConvolutions:
                net_arch = {"shared": [], "streams": [512]}
        self.net_args: dict[str, Any] = {
            "observation_space": observation_space,
            "action_space": action_space,
            "net_arch": net_arch,
            "activation_fn": activation_fn,
            "normalize_images": normalize_images,
            "noisy_layers": noisy_layers,
            **network,
        }
        self.net_arch = net_arch
        self.activation_fn = activation_fn
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self.q_net = self.make_q_net()
        self.q_net_target = self.make_q_net()
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        online = set(map(id, self.q_net.parameters()))  # of which a shared extractor has some
        for parameter in self.q_net_target.parameters():
            if id(parameter) not in online:  # a shared one may be frozen
                parameter.requires_grad_(False)
        self.q_net_target.set_training_mode(False)
        kwargs = dict(self.optimizer_kwargs)
        if self.optimizer_class in _WITH_FUSED_KERNEL and not kwargs.keys() & _NOT_WITH_FUSED:
            # torch refuses it for complex parameters
            kwargs.setdefault("fused", all(map(th.is_floating_point, self.q_net.parameters())))
        self.optimizer = self.optimizer_class(
            self.q_net.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **kwargs,
        )
        self._parameters_then = list(self.q_net.parameters())

    def update_optimizer(self) -> None:
        """Swap replaced parameters of the network for their successors.

        Parameters from elsewhere stay; parameters of the network that the user left out stay out.
        """
        then, self._parameters_then = self._parameters_then, list(self.q_net.parameters())
        groups = self.optimizer.param_groups
        gone = set(then) - set(self._parameters_then)
        held = {p for group in groups for p in group["params"]}
        known = held.union(then)
        new = [p for p in self._parameters_then if p not in known]
        for group in groups:
            if not gone.isdisjoint(group["params"]):
                group["params"] = [*(p for p in group["params"] if p not in gone), *new]
                new = []
        for p in gone & held:
            self.optimizer.state.pop(p, None)

    @property
    def device(self) -> th.device:
        """Where the policy lives."""
        return self.q_net.device if "q_net" in self._modules else super().device

    def make_q_net(self) -> RainbowNetwork:
        """A network with its own features extractor."""
        own = self.make_features_extractor()
        features: dict[str, Any] = {"features_extractor": own, "features_dim": own.features_dim}
        result = RainbowNetwork(**features, **self.net_args).to(self.device)
        if any(map(is_lazy, own.parameters())):  # which the first observation makes
            seen, _ = result.obs_to_tensor(copy.deepcopy(self.observation_space).sample())
            own.eval()
            with th.no_grad():
                result.extract_features(seen, own)
            own.train()
        return result

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """Greedy actions, shape ``(B,)``."""
        return self._predict(obs, deterministic=deterministic)

    def _predict(
        self,
        observation: PyTorchObs,
        deterministic: bool = True,
        action_masks: th.Tensor | None = None,
    ) -> th.Tensor:
        masks = {} if action_masks is None else {"action_masks": action_masks}
        return self.q_net._predict(observation, deterministic=deterministic, **masks)

    def predict(
        self,
        observation: ObsArray | tuple[Any, ...],
        state: tuple[NDArray, ...] | None = None,
        episode_start: NDArray | None = None,
        deterministic: bool = False,
        action_masks: NDArray | None = None,
    ) -> tuple[NDArray, tuple[NDArray, ...] | None]:
        """As ``Rainbow.predict``, without its epsilon."""
        self.set_training_mode(False)
        if isinstance(observation, tuple):
            if len(observation) == 2 and isinstance(observation[1], dict):
                raise ValueError(
                    "predict() got a tuple: it is probably Gymnasium's `obs, info = env.reset()`; "
                    "pass the observation alone"
                )
            observation = np.asarray(observation)
        obs_tensor, vectorized = self.obs_to_tensor(observation)
        rows = next(iter(obs_tensor.values())) if isinstance(obs_tensor, dict) else obs_tensor
        n_obs = len(rows)
        masked = {}  # A subclass for envs without masks may have the signature of SB3's.
        if action_masks is not None:
            given, n_actions = np.asarray(action_masks), int(self.q_net.action_space.n)
            if given.ndim == 1:
                # As sb3-contrib: one observation's mask, or those of a batch one after another
                whole = given.size == n_obs * n_actions
                given = given.reshape(n_obs, n_actions) if whole else given[None]
            checked = as_action_masks(given, n_obs, n_actions)
            masked["action_masks"] = th.as_tensor(checked, device=self.device)
        with th.no_grad():
            if not deterministic:
                self.q_net.reset_noise(n_obs)
            actions = self._predict(obs_tensor, deterministic=deterministic, **masked)
        chosen = actions.cpu().numpy()
        return (chosen if vectorized else chosen.squeeze(axis=0)), state

    def set_training_mode(self, mode: bool) -> None:
        """Training or evaluation mode of the online network, which the noisy layers ignore."""
        self.q_net.set_training_mode(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **self.net_args,
            "lr_schedule": self._dummy_schedule,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            "features_extractor_class": self.features_extractor_class,
            "features_extractor_kwargs": self.features_extractor_kwargs,
        }


class CnnPolicy(RainbowPolicy):
    """:class:`RainbowPolicy` for images: by default the network of Hessel et al. (2018), 512 noisy
    units for the value and as many for the advantages, after the convolutions of ``NatureCNN``.
    With ``features_extractor_kwargs=dict(features_dim=...)`` it is DQN's: ``NatureCNN``, then the
    head.
    """

    _default_extractor = NatureConvolutions


class MultiInputPolicy(RainbowPolicy):
    """:class:`RainbowPolicy` for dict observations: ``CombinedExtractor`` by default."""

    _default_extractor = CombinedExtractor


MlpPolicy = RainbowPolicy
