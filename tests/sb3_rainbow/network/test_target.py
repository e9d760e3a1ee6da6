"""The target: which network chooses, which one values, under which state's mask."""

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_rainbow.learner.update import td_losses, td_target
from sb3_rainbow.network.losses import project_distribution
from sb3_rainbow.policies import MlpPolicy
from sb3_rainbow.type_aliases import Batch

N_ACTIONS = 4


def make_policy(**kwargs: Any) -> MlpPolicy:
    th.manual_seed(1)
    policy = MlpPolicy(
        spaces.Box(-1, 1, (3,), np.float32),
        spaces.Discrete(N_ACTIONS),
        lambda _: 1e-3,
        net_arch=[16],
        v_min=-10.0,
        v_max=10.0,
        **{"distributional": True, **kwargs},
    )
    # Networks that disagree, so that it shows who chose.
    for parameter in policy.q_net_target.parameters():
        parameter.data += 0.5 * th.randn_like(parameter)
    policy.q_net.reset_noise()
    policy.q_net_target.reset_noise()
    return policy


def make_batch(masks: th.Tensor | None = None, n: int = 64) -> Batch:
    generator = th.Generator().manual_seed(0)
    return Batch(
        observations=th.rand(n, 3, generator=generator),
        actions=th.randint(0, N_ACTIONS, (n, 1), generator=generator),
        next_observations=3 * th.rand(n, 3, generator=generator) - 1,
        dones=(th.rand(n, 1, generator=generator) < 0.3).float(),
        rewards=th.randn(n, 1, generator=generator),
        discounts=0.99 ** th.randint(1, 4, (n, 1), generator=generator).float(),
        weights=None,
        next_action_masks=masks,
    )


def masked_argmax(q_values: np.ndarray, masks: np.ndarray | None) -> list[int]:
    return [
        max(
            (a for a in range(N_ACTIONS) if masks is None or masks[i, a]),
            key=lambda a: q_values[i, a],
        )
        for i in range(len(q_values))
    ]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("double_q", [False, True])
def test_who_chooses_the_next_action(double_q: bool, masked: bool) -> None:
    policy = make_policy()
    masks = th.rand(64, N_ACTIONS) < 0.4
    masks[th.arange(64), th.randint(0, N_ACTIONS, (64,))] = True
    batch = make_batch(masks if masked else None)
    chooser = policy.q_net if double_q else policy.q_net_target
    q_values = chooser(batch.next_observations, noisy=True).detach().numpy()
    expected = masked_argmax(q_values, masks.numpy() if masked else None)
    target = td_target(policy.q_net, policy.q_net_target, batch, double_q)
    assert target.next_actions[:, 0].tolist() == expected
    # The networks do disagree about some states.
    other = policy.q_net_target if double_q else policy.q_net
    other_q = other(batch.next_observations, noisy=True).detach().numpy()
    assert masked_argmax(other_q, masks.numpy() if masked else None) != expected


def test_the_target_network_values_the_choice_and_terminations_end_it() -> None:
    policy = make_policy()
    batch = make_batch()
    target = td_target(policy.q_net, policy.q_net_target, batch, True)
    distribution = policy.q_net_target.distribution(batch.next_observations, noisy=True)
    chosen = distribution[th.arange(64), target.next_actions[:, 0]]
    support = th.linspace(-10, 10, 51)
    discounts = batch.discounts * (1 - batch.dones)
    expected = project_distribution(chosen, batch.rewards, discounts, -10.0, 10.0)
    th.testing.assert_close(target.values, expected)
    ended = batch.dones[:, 0] == 1
    th.testing.assert_close((target.values @ support)[ended], batch.rewards[ended, 0])


def test_the_scalar_target() -> None:
    policy = make_policy(distributional=False)
    batch = make_batch()
    target = td_target(policy.q_net, policy.q_net_target, batch, True)
    q_values = policy.q_net_target(batch.next_observations, noisy=True)
    chosen = q_values.gather(1, target.next_actions)
    expected = batch.rewards + batch.discounts * (1 - batch.dones) * chosen
    th.testing.assert_close(target.values, expected)
    losses, priorities = td_losses(policy.q_net, batch, target.values)
    predicted = policy.q_net(batch.observations, noisy=True).gather(1, batch.actions)
    errors = (predicted - expected).abs()[:, 0]
    th.testing.assert_close(priorities, errors)
    th.testing.assert_close(losses, th.where(errors < 1, 0.5 * errors**2, errors - 0.5))


def test_priorities_are_divergences() -> None:
    policy = make_policy()
    batch = make_batch()
    target = td_target(policy.q_net, policy.q_net_target, batch, True)
    losses, priorities = td_losses(policy.q_net, batch, target.values)
    predicted = policy.q_net.distribution(batch.observations, noisy=True)
    taken = predicted[th.arange(64), batch.actions[:, 0]]
    th.testing.assert_close(losses, -(target.values * taken.log()).sum(1), rtol=1e-4, atol=1e-5)
    ahead = th.distributions.Categorical(probs=target.values)
    divergences = th.distributions.kl_divergence(ahead, th.distributions.Categorical(probs=taken))
    th.testing.assert_close(priorities, divergences.detach(), rtol=1e-4, atol=1e-5)
    assert not priorities.requires_grad


def test_no_gradient_reaches_the_target() -> None:
    policy = make_policy()
    batch = make_batch()
    before = copy.deepcopy(policy.q_net_target.state_dict())
    target = td_target(policy.q_net, policy.q_net_target, batch, True)
    assert not target.values.requires_grad
    td_losses(policy.q_net, batch, target.values)[0].mean().backward()
    assert all(parameter.grad is None for parameter in policy.q_net_target.parameters())
    for name, value in policy.q_net_target.state_dict().items():
        assert th.equal(value, before[name])
