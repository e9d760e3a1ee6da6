"""Settings of models that learn within a second, toy environments, batches, own networks."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_rainbow import MlpPolicy, Rainbow
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


def make(policy: Any = "MlpPolicy", env: Any = "CartPole-v1", **settings: Any) -> Rainbow:
    """A small model."""
    return Rainbow(policy, env, **{**FAST, **settings})


def weights(net: nn.Module) -> th.Tensor:
    """A copy of all parameters in one vector."""
    return nn.utils.parameters_to_vector(net.parameters()).detach().clone()


def identical(ours: Mapping[str, th.Tensor], others: Mapping[str, th.Tensor]) -> None:
    """Fails by the name of a tensor that is not the same to the last bit."""
    th.testing.assert_close(ours, others, rtol=0, atol=0)


class Toy(gym.Env):
    """Shows and pays what functions of the number of steps say, and ends after ``length``.

    By default it shows what its space draws, and pays 1.
    """

    def __init__(
        self,
        space: spaces.Space,
        shown: Callable[[int], Any] | None = None,
        paid: Callable[[int], float] = lambda step: 1.0,
        length: int | None = None,
        terminated: bool = False,
    ) -> None:
        self.observation_space, self.action_space = space, spaces.Discrete(2)
        self.shown, self.paid, self.length = shown, paid, length
        self.terminated = terminated
        self.steps = 0

    def _observation(self) -> Any:
        return self.observation_space.sample() if self.shown is None else self.shown(self.steps)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        over = self.steps == self.length
        ends = (over, False) if self.terminated else (False, over)
        return self._observation(), self.paid(self.steps), *ends, {}


class Extracting(BaseFeaturesExtractor):
    """Features by the module that ``build`` makes."""

    def __init__(self, space: spaces.Space, build: Callable[[], nn.Module], size: int) -> None:
        super().__init__(space, size)
        self.net = build()

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features: th.Tensor = self.net(observations)
        return features


def extracting(build: Callable[[], nn.Module], size: int) -> dict[str, Any]:
    """Arguments of a policy with an extractor of one's own, of so many features."""
    kwargs = {"build": build, "size": size}
    return {"features_extractor_class": Extracting, "features_extractor_kwargs": kwargs}


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


def make_policy(
    space: spaces.Space, n_actions: int, kind: type[MlpPolicy] = MlpPolicy, **kwargs: Any
) -> MlpPolicy:
    """A policy without its algorithm."""
    given = {"distributional": True, **kwargs}
    return kind(space, spaces.Discrete(n_actions), lambda _: 1e-3, **given)


def policy_of(network: type[RainbowNetwork]) -> type[MlpPolicy]:
    """A policy whose networks are of a class."""

    class Policy(MlpPolicy):
        def make_q_net(self) -> RainbowNetwork:
            arguments = self._update_features_extractor(self.net_args, features_extractor=None)
            return network(**arguments).to(self.device)

    return Policy
