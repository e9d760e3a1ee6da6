"""Rainbow with a network for each agent: their sum on joint actions, or one for each row.

Only what is computed differs: replay, targets, loss and exploration are Rainbow's own.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from benchmarks.methods.team.env import DecentralizedEnv
from coop_env.simulation.joint import N_CHOICES
from coop_env.team.agents import AGENTS
from coop_env.vector.vec_env import CoopInsertionVecEnv
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import RainbowPolicy


class DecentralizedVecEnv(CoopInsertionVecEnv):
    """A batch of :class:`~benchmarks.methods.team.env.DecentralizedEnv`."""

    env_class = DecentralizedEnv


class TeamNetwork(RainbowNetwork):
    """Two networks in the place of one, each fed the ``columns`` that its agent sees."""

    def __init__(self, columns: Sequence[Sequence[int]], **kwargs: Any) -> None:
        self.columns, self._shared = [list(own) for own in columns], kwargs
        super().__init__(**kwargs)

    def _build_layers(self) -> None:
        assert isinstance(self.observation_space, spaces.Box)
        low, high = self.observation_space.low, self.observation_space.high
        self.agents = nn.ModuleList()
        for own in self.columns:
            space = spaces.Box(low[own], high[own], dtype=low.dtype.type)
            extractor = FlattenExtractor(space)
            own_parts = {
                "observation_space": space,
                "action_space": spaces.Discrete(N_CHOICES),
                "features_extractor": extractor,
                "features_dim": extractor.features_dim,
            }
            self.agents.append(RainbowNetwork(**{**self._shared, **own_parts}))

    @property
    def networks(self) -> list[RainbowNetwork]:
        """The agents' own."""
        return list(self.agents)  # type: ignore[arg-type]

    def own_logits(self, obs: PyTorchObs, noisy: bool) -> list[th.Tensor]:
        """Each agent's outputs ``(B, 7, N)`` for its columns of observations ``(B, size)``."""
        assert isinstance(obs, th.Tensor)
        pairs = zip(self.networks, self.columns, strict=True)
        return [net.logits(obs[:, own], noisy) for net, own in pairs]

    @abstractmethod
    def logits(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Both agents' outputs as those of one network."""

    @th.no_grad()
    def reset_noise(self, n_envs: int = 1) -> None:
        """Draw new noise for both networks."""
        for net in self.networks:
            net.reset_noise(n_envs)

    def noise_magnitudes(self) -> dict[str, float]:
        """Mean absolute sigma of each noisy layer of each agent."""
        return {
            f"{agent}_{layer}": magnitude
            for agent, net in zip(AGENTS, self.networks, strict=True)
            for layer, magnitude in net.noise_magnitudes().items()
        }


class SumNetwork(TeamNetwork):
    """Value decomposition (VDN, Sunehag et al. 2018): a joint action's return is the sum of both
    agents', of distributions quantile by quantile (DFAC, Sun et al. 2021).

    Each agent's own best choice is then its part of the best joint action, without communication.

    Raises:
        ValueError: for a categorical head, whose sum is no sum of logits.
    """

    def __init__(self, columns: Sequence[Sequence[int]], **kwargs: Any) -> None:
        super().__init__(columns, **kwargs)
        if self.head == "categorical":
            raise ValueError(
                "a sum of categorical distributions is none of their logits: leave v_min and v_max "
                "null, for quantiles"
            )

    def logits(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Outputs ``(B, 49, N)`` of joint actions ``7 delta + rrs``."""
        delta, rrs = self.own_logits(obs, noisy)
        return (delta[:, :, None] + rrs[:, None]).flatten(1, 2)


class IndependentNetwork(TeamNetwork):
    """A network for each agent's rows: two learners with no parameter in common.

    The last two columns say whose a row is.
    """

    def logits(self, obs: PyTorchObs, noisy: bool = False) -> th.Tensor:
        """Outputs ``(B, 7, N)``, each row's of its agent's network."""
        assert isinstance(obs, th.Tensor)
        delta, rrs = self.own_logits(obs, noisy)  # for all rows, as noise is drawn for each of them
        return th.where(obs[:, -2, None, None] > 0.5, delta, rrs)


class TeamPolicy(RainbowPolicy):
    """Rainbow's policy with a :class:`TeamNetwork`."""

    network_class: ClassVar[type[TeamNetwork]]

    def __init__(
        self, *args: Any, columns: Sequence[Sequence[int]] | None = None, **kwargs: Any
    ) -> None:
        self.columns = columns
        super().__init__(*args, **kwargs)

    def make_q_net(self) -> TeamNetwork:
        """A network whose agents see ``columns``, or all."""
        size = self.observation_space.shape[0]  # type: ignore[index]
        columns = self.columns or [range(size)] * len(AGENTS)
        net_args = self._update_features_extractor(self.net_args, features_extractor=None)
        return self.network_class(columns, **net_args).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "columns": self.columns}


class SumPolicy(TeamPolicy):
    """Policy of value decomposition."""

    network_class = SumNetwork


class IndependentPolicy(TeamPolicy):
    """Policy of two independent learners."""

    network_class = IndependentNetwork
