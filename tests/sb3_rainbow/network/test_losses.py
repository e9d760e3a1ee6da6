"""Projection and losses by hand and against a slow form; who chooses, and who values."""

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_contrib.common.utils import quantile_huber_loss
from scipy.stats import entropy

from sb3_rainbow.learner.update import td_losses, td_target
from sb3_rainbow.network.losses import (
    categorical_losses,
    clipped_share,
    project_distribution,
    quantile_losses,
    target_entropies,
)
from sb3_rainbow.policies import MlpPolicy
from sb3_rainbow.type_aliases import Batch
from tests.sb3_rainbow import small


def project(p: list[float], reward: float, discount: float, v_min: float, v_max: float) -> list:
    projected = project_distribution(
        th.tensor([p]), th.tensor([[reward]]), th.tensor([[discount]]), v_min, v_max
    )
    return projected[0].tolist()


def slow_projection(
    p: np.ndarray, reward: float, discount: float, v_min: float, v_max: float
) -> np.ndarray:
    """Each atom's mass shared among all by their distance from where it falls."""
    atoms = np.linspace(v_min, v_max, p.size)
    targets = np.clip(reward + discount * atoms, v_min, v_max)
    nearness = 1.0 - np.abs(targets[:, None] - atoms) / (atoms[1] - atoms[0])
    return p @ np.maximum(nearness, 0.0)


@pytest.mark.parametrize(
    ("reward", "discount", "expected"),
    [
        # r + 0.5 z = 0.25, 0.75, 1.25, 1.75
        (0.75, 0.5, [0.0, 0.075 + 0.05, 0.025 + 0.15 + 0.225 + 0.1, 0.075 + 0.3]),
        (0.0, 1.0, [0.1, 0.2, 0.3, 0.4]),  # on the grid
        (1.0, 1.0, [0.0, 0.1, 0.2, 0.7]),
        (1.0, 0.0, [0.0, 0.0, 1.0, 0.0]),  # a termination
        (0.25, 0.0, [0.0, 0.75, 0.25, 0.0]),
    ],
)
def test_projection_by_hand(reward: float, discount: float, expected: list[float]) -> None:
    """Of 0.1, 0.2, 0.3 and 0.4 at the atoms -1, 0, 1 and 2."""
    projected = project([0.1, 0.2, 0.3, 0.4], reward, discount, -1.0, 2.0)
    assert projected == pytest.approx(expected, abs=1e-6)


@settings(max_examples=80)
@given(
    n_atoms=st.integers(2, 60),
    reward=st.floats(-30, 30),
    discount=st.sampled_from([0.0, 0.5, 0.9, 0.970299, 1.0]),
    v_min=st.floats(-20, 5),
    width=st.floats(0.5, 40),
    seed=st.integers(0, 1000),
)
def test_projection_agrees_with_a_matrix_of_distances_and_keeps_mass_one(
    n_atoms: int, reward: float, discount: float, v_min: float, width: float, seed: int
) -> None:
    p = np.random.default_rng(seed).dirichlet(np.ones(n_atoms)).astype(np.float32)
    reward, v_max = float(np.float32(reward)), v_min + width
    projected = np.array(project(p.tolist(), reward, discount, v_min, v_max))
    assert projected.sum() == pytest.approx(1.0, abs=1e-5)
    assert projected.min() >= -1e-6
    slow = slow_projection(p, reward, discount, v_min, v_max)
    # by which float32 moves an atom of up to 50 is a share of the distance between two atoms
    moved = 2 * 2.0**-23 * 50 * (n_atoms - 1) / width
    np.testing.assert_allclose(projected, slow, atol=moved + 1e-6)


def test_a_return_that_is_no_number_makes_the_masses_none() -> None:
    assert np.isnan(project([0.5, 0.5], np.nan, 1.0, -1.0, 2.0)).all()


def test_clipped_share_is_the_mass_outside() -> None:
    p = th.tensor([[0.1, 0.2, 0.3, 0.4], [0.25, 0.25, 0.25, 0.25]])
    rewards, discounts = th.tensor([[1.5], [0.0]]), th.tensor([[1.0], [1.0]])
    # First row: atoms 0.5, 1.5, 2.5, 3.5; second row: unchanged, nothing outside.
    assert clipped_share(p, rewards, discounts, -1.0, 2.0).item() == pytest.approx((0.7 + 0.0) / 2)


def test_a_narrow_support_far_from_zero_loses_no_digits() -> None:
    """Priorities, against the matrix in double precision on the same numbers."""
    generator = np.random.default_rng(0)
    v_min, v_max, discount = -100.0, -99.99, np.float32(0.99)
    target, logits = generator.dirichlet(np.ones(51), 20), generator.normal(size=(20, 51))
    rewards = (generator.uniform(v_min, v_max, 20) - discount * -99.995).astype(np.float32)
    projected = project_distribution(
        th.tensor(target, dtype=th.float32), th.tensor(rewards)[:, None],
        th.full((20, 1), float(discount)), v_min, v_max,
    )  # fmt: skip
    predicted = th.tensor(logits, dtype=th.float32)
    result = categorical_losses(predicted, projected) - target_entropies(projected)
    wanted = [
        entropy(slow_projection(p, float(reward), float(discount), v_min, v_max), q)
        for p, reward, q in zip(target, rewards, np.exp(logits), strict=True)
    ]
    np.testing.assert_allclose(result, wanted, rtol=5e-5)
    share = clipped_share(th.full((1, 51), 1 / 51), th.zeros(1, 1), th.ones(1, 1), v_min, v_max)
    assert share.item() == 0.0


def test_quantile_losses_are_sb3_contribs() -> None:
    generator = th.Generator().manual_seed(0)
    # wide enough that both branches of the Huber loss are taken
    quantiles = (3 * th.randn(16, 7, generator=generator)).requires_grad_()
    target = 3 * th.randn(16, 7, generator=generator)
    expected = quantile_huber_loss(quantiles, target, sum_over_quantiles=True)
    (gradient,) = th.autograd.grad(expected, quantiles)
    losses = quantile_losses(quantiles, target)
    assert losses.shape == (16,)
    th.testing.assert_close(losses.mean(), expected)
    th.testing.assert_close(th.autograd.grad(losses.mean(), quantiles)[0], gradient)


N_ACTIONS = 4


def make_policy(**kwargs: Any) -> MlpPolicy:
    th.manual_seed(1)
    given = {"net_arch": [16], "v_min": -10.0, "v_max": 10.0, **kwargs}
    policy = small.make_policy(spaces.Box(-1, 1, (3,), np.float32), N_ACTIONS, **given)
    # Networks that disagree, so that it shows who chose.
    for parameter in policy.q_net_target.parameters():
        parameter.data += 0.5 * th.randn_like(parameter)
    for net in (policy.q_net, policy.q_net_target):
        net.reset_noise()
    return policy


BATCH = small.random_batch(3, N_ACTIONS, 64)


def target_of(policy: MlpPolicy, batch: Batch = BATCH, double_q: bool = True) -> Any:
    return td_target(policy.q_net, policy.q_net_target, batch, double_q)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("double_q", [False, True])
def test_who_chooses_the_next_action(double_q: bool, masked: bool) -> None:
    policy = make_policy()
    masks = th.rand(64, N_ACTIONS) < 0.4
    masks[th.arange(64), th.randint(0, N_ACTIONS, (64,))] = True
    best = []
    for net in (policy.q_net, policy.q_net_target):
        q_values = net(BATCH.next_observations, noisy=True).detach().numpy()
        allowed = masks.numpy() if masked else True
        best.append(np.where(allowed, q_values, -np.inf).argmax(axis=1).tolist())
    batch = BATCH._replace(next_action_masks=masks if masked else None)
    chosen = target_of(policy, batch, double_q).next_actions[:, 0].tolist()
    assert chosen == best[0 if double_q else 1] != best[1 if double_q else 0]


def test_the_target_network_values_the_choice_and_terminations_end_it() -> None:
    policy, batch = make_policy(), BATCH
    target = target_of(policy)
    distribution = policy.q_net_target.distribution(batch.next_observations, noisy=True)
    chosen = distribution[th.arange(64), target.next_actions[:, 0]]
    support = th.linspace(-10, 10, 51)
    discounts = batch.discounts * (1 - batch.dones)
    expected = project_distribution(chosen, batch.rewards, discounts, -10.0, 10.0)
    th.testing.assert_close(target.values, expected)
    ended = batch.dones[:, 0] == 1
    th.testing.assert_close((target.values @ support)[ended], batch.rewards[ended, 0])


def test_the_scalar_target() -> None:
    policy, batch = make_policy(distributional=False), BATCH
    target = target_of(policy)
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
    target = target_of(policy)
    losses, priorities = td_losses(policy.q_net, BATCH, target.values)
    predicted = policy.q_net.distribution(BATCH.observations, noisy=True)
    taken = predicted[th.arange(64), BATCH.actions[:, 0]]
    th.testing.assert_close(losses, -(target.values * taken.log()).sum(1), rtol=1e-4, atol=1e-5)
    ahead = th.distributions.Categorical(probs=target.values)
    divergences = th.distributions.kl_divergence(ahead, th.distributions.Categorical(probs=taken))
    th.testing.assert_close(priorities, divergences.detach(), rtol=1e-4, atol=1e-5)
    assert not priorities.requires_grad


def test_no_gradient_reaches_the_target() -> None:
    policy = make_policy()
    before = copy.deepcopy(policy.q_net_target.state_dict())
    values = target_of(policy).values
    assert not values.requires_grad
    td_losses(policy.q_net, BATCH, values)[0].mean().backward()
    assert all(parameter.grad is None for parameter in policy.q_net_target.parameters())
    small.identical(policy.q_net_target.state_dict(), before)
