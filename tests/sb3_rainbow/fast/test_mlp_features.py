"""The compiled kernels behind extractors that learn, against torch."""

import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn

from sb3_rainbow.learner.learner import Learner
from sb3_rainbow.policies import CnnPolicy
from sb3_rainbow.type_aliases import Batch
from tests.sb3_rainbow.fast.test_mlp_kernels import N_ACTIONS, make_batch


class Convolutions(BaseFeaturesExtractor):
    """Small, learning, and nothing that the kernels know."""

    def __init__(self, observation_space: spaces.Space, norm: bool = False) -> None:
        super().__init__(observation_space, 4 * 17 * 17)
        self.convolution = nn.Conv2d(2, 4, 3, stride=2)
        self.norm = nn.BatchNorm2d(4) if norm else nn.Identity()

    def forward(self, obs: th.Tensor) -> th.Tensor:
        features: th.Tensor = th.relu(self.norm(self.convolution(obs))).flatten(1)
        return features


def make_image_learner(cpu_kernels: bool, **kwargs: Any) -> Learner:
    th.manual_seed(0)
    space = spaces.Box(0, 255, (2, 36, 36), np.uint8)
    double_q = kwargs.pop("double_q", True)
    kwargs = {"distributional": True, "v_min": -4.0, "v_max": 4.0, "n_atoms": 11, **kwargs}
    # A large epsilon, so that Adam does not blow up the rounding of tiny gradients
    kwargs["optimizer_kwargs"] = {"eps": 1e-2}
    policy = CnnPolicy(space, spaces.Discrete(N_ACTIONS), lambda _: 1e-3, **kwargs)
    return Learner(policy, double_q, 0.5, cpu_kernels=cpu_kernels)


def make_images(seed: int) -> Batch:
    generator = th.Generator().manual_seed(seed)
    images = th.randint(0, 256, (2, 32, 2, 36, 36), generator=generator, dtype=th.uint8)
    return make_batch(seed, masked=True)._replace(
        observations=images[0], next_observations=images[1]
    )


@pytest.mark.parametrize(
    "kwargs",
    [
        {"net_arch": [16]},
        {"net_arch": []},
        {"net_arch": [16], "double_q": False},
        {"net_arch": [16], "noisy": False, "distributional": False},
        {"features_extractor_class": NatureCNN, "net_arch": [], "noisy_layers": "head"},
    ],
    ids=str,
)
def test_what_an_extractor_learns_agrees_with_torch(kwargs: dict[str, Any]) -> None:
    kwargs = {"features_extractor_class": Convolutions, **kwargs}
    ours, reference = (make_image_learner(kernels, **kwargs) for kernels in (True, False))
    assert ours.uses_kernels()
    assert not reference.uses_kernels()
    for seed in range(4):
        batch, results = make_images(seed), []
        for learner in (ours, reference):
            th.manual_seed(seed)
            results.append(learner.update(batch))
            learner.move_target(0.1)
        th.testing.assert_close(results[0], results[1], rtol=1e-4, atol=1e-4)
    for (name, p), q in zip(
        ours.q_net.named_parameters(), reference.q_net.parameters(), strict=True
    ):
        assert p.grad is not None
        th.testing.assert_close(p.grad, q.grad, rtol=1e-2, atol=1e-4, msg=name)
        state = [x.policy.optimizer.state[y] for x, y in ((ours, p), (reference, q))]
        assert state[0]["exp_avg"].stride() == p.stride()
        th.testing.assert_close(state[0]["exp_avg"], state[1]["exp_avg"], rtol=1e-2, atol=1e-4)
        th.testing.assert_close(p, q, rtol=1e-4, atol=1e-5, msg=name)
    again = pickle.loads(pickle.dumps(ours))  # memory formats included
    for learner in (ours, again):
        th.manual_seed(9)
        learner.update(make_images(9))
    for p, q in zip(ours.policy.parameters(), again.policy.parameters(), strict=True):
        assert th.equal(p, q)


@pytest.mark.parametrize("why", ["buffers", "frozen", "large"])
def test_extractors_that_are_left_to_torch(why: str) -> None:
    kwargs = {"features_extractor_kwargs": {"norm": True}} if why == "buffers" else {}
    width = 400 if why == "large" else 8
    learner = make_image_learner(
        True, features_extractor_class=Convolutions, net_arch=[width], **kwargs
    )
    if why == "frozen":
        learner.q_net.features_extractor.requires_grad_(False)
    assert not learner.uses_kernels()
    learner.update(make_images(0))
