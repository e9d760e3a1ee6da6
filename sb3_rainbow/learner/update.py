"""Rainbow's temporal-difference error on one batch."""

from typing import NamedTuple

import torch as th
from torch.nn import functional as F

from sb3_rainbow.network.losses import (
    categorical_losses,
    mask_q_values,
    project_distribution,
    quantile_losses,
    target_entropies,
)
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch


class Target(NamedTuple):
    """What the online network should predict, and what the logs need. B: batch size."""

    values: th.Tensor  # distribution over the atoms, or quantiles, (B, N), or scalar (B, 1)
    next_actions: th.Tensor  # chosen at t + k, (B, 1)
    next_values: th.Tensor  # as values, at t + k, before discounting


def td_target(
    q_net: RainbowNetwork, q_net_target: RainbowNetwork, batch: Batch, double_q: bool
) -> Target:
    """n-step target (Hessel et al. 2018, section "The Integrated Agent"), without gradients.

    The action at t + k is the best allowed there by that state's own mask, in the eyes of the
    online network with double Q-learning and of the target network without; its value is always
    the target network's.
    """
    chooser = q_net if double_q else q_net_target
    with th.no_grad():
        q_values = chooser(batch.next_observations, noisy=True)
        actions = mask_q_values(q_values, batch.next_action_masks).argmax(dim=1, keepdim=True)
        rewards, discounts = batch.rewards, batch.discounts * (1.0 - batch.dones)
        logits = of_actions(q_net_target.logits(batch.next_observations, noisy=True), actions)
        if q_net.head != "categorical":  # values themselves, be it one or the quantiles
            return Target(rewards + discounts * logits, actions, logits)
        probabilities = F.softmax(logits, dim=1)
        values = project_distribution(probabilities, rewards, discounts, q_net.v_min, q_net.v_max)
        return Target(values, actions, probabilities)


def td_losses(
    q_net: RainbowNetwork, batch: Batch, target: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """Losses and priorities of the batch, before importance weights.

    Categorical: the cross-entropy, and the Kullback-Leibler divergence (Hessel et al. 2018,
    section "The Integrated Agent"), whose gradients are the same. They differ by the target's
    entropy, which says how uncertain the return is and not what is left to learn: as priorities,
    cross-entropies are all but uniform. Quantiles: their Huber loss, and, for the same reason, the
    absolute error of their mean. Scalar: the Huber loss, and the absolute error.

    Args:
        target: the ``values`` of a :class:`Target`.

    Returns:
        losses ``(B,)`` with gradient, priorities ``(B,)`` without.
    """
    taken = of_actions(q_net.logits(batch.observations, noisy=True), batch.actions)
    if q_net.head == "categorical":
        losses = categorical_losses(taken, target)
        divergences = losses.detach() - target_entropies(target)
        return losses, divergences.clamp(min=0.0)
    if q_net.head == "quantile":
        errors = taken.detach().mean(dim=1) - target.mean(dim=1)
        return quantile_losses(taken, target), errors.abs()
    losses = F.smooth_l1_loss(taken[:, 0], target[:, 0], reduction="none")
    return losses, (taken - target)[:, 0].detach().abs()


def mean_loss(
    q_net: RainbowNetwork, q_net_target: RainbowNetwork, batch: Batch, double_q: bool
) -> tuple[th.Tensor, th.Tensor]:
    """Importance-weighted mean of the losses, scalar with gradient, and priorities ``(B,)``."""
    target = td_target(q_net, q_net_target, batch, double_q)
    losses, priorities = td_losses(q_net, batch, target.values)
    return (losses * batch.weights).mean(), priorities


def of_actions(logits: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """The head's outputs ``(B, N)`` for one action ``(B, 1)`` of each sample, of ``(B, A, N)``."""
    rows = actions.unsqueeze(-1).expand(-1, 1, logits.shape[2])
    return logits.gather(1, rows).squeeze(1)
