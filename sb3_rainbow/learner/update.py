"""Rainbow's temporal-difference error on one batch."""

from typing import NamedTuple, TypeAlias

import torch as th
from torch.nn import functional as F

from sb3_rainbow.network.losses import (
    categorical_losses,
    huber_losses,
    mask_q_values,
    project_distribution,
    target_entropies,
)
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

Weights: TypeAlias = list[tuple[th.Tensor, th.Tensor]]


class Target(NamedTuple):
    """What the online network should predict, and what the logs tell about it. B: batch size."""

    values: th.Tensor
    """Distribution over the atoms ``(B, N)``, or scalar ``(B, 1)``."""
    next_actions: th.Tensor
    """Actions chosen at t + k, ``(B, 1)``."""
    next_probabilities: th.Tensor
    """Distribution at t + k before discounting, ``(B, N)``."""


def td_target(
    q_net: RainbowNetwork,
    q_net_target: RainbowNetwork,
    batch: Batch,
    double_q: bool,
    online_weights: Weights | None = None,
) -> Target:
    """
    n-step target (Hessel et al. 2018, equation 3), or its scalar form; without gradients.

    The action at t + k is the best allowed there by that state's own mask, in the eyes of the
    online network with double Q-learning and of the target network without; its value is always
    the target network's.

    :param online_weights: ``q_net.noisy_weights()``, if at hand
    """
    with th.no_grad():
        streams = q_net_target.streams_under(q_net_target.noisy_weights(), batch.next_observations)
        if double_q:
            weights = q_net.noisy_weights() if online_weights is None else online_weights
            chooser = q_net.join(q_net.streams_under(weights, batch.next_observations))
        else:
            chooser = q_net_target.join(streams)
        q_values = mask_q_values(q_net.expected_values(chooser), batch.next_action_masks)
        actions = q_values.argmax(dim=1, keepdim=True)
        logits = q_net_target.join_taken(streams, actions)
        discounts = batch.discounts * (1.0 - batch.dones)
        if not q_net.distributional:
            return Target(batch.rewards + discounts * logits, actions, logits)
        probabilities = F.softmax(logits, dim=1)
        values = project_distribution(
            probabilities, batch.rewards, discounts, q_net.support, q_net.v_min, q_net.v_max
        )
        return Target(values, actions, probabilities)


def td_losses(
    q_net: RainbowNetwork,
    batch: Batch,
    target: th.Tensor,
    online_weights: Weights | None = None,
) -> tuple[th.Tensor, th.Tensor]:
    """
    Losses and priorities of the batch, before importance weights.

    Distributional: the cross-entropy, and the Kullback-Leibler divergence (Hessel et al. 2018,
    section "Multi-step learning"), whose gradients are the same. They differ by the target's
    entropy, which says how uncertain the return is and not what is left to learn: as priorities,
    cross-entropies are all but uniform. Scalar: the Huber loss, and the absolute error.

    :param target: the ``values`` of a :class:`Target`
    :param online_weights: ``q_net.noisy_weights()``, if at hand
    :return: losses ``(B,)`` with gradient, priorities ``(B,)`` without
    """
    weights = q_net.noisy_weights() if online_weights is None else online_weights
    logits = q_net.join_taken(q_net.streams_under(weights, batch.observations), batch.actions)
    if q_net.distributional:
        losses = categorical_losses(logits, target)
        divergences = losses.detach() - target_entropies(target)
        return losses, divergences.clamp(min=0.0)
    losses = huber_losses(logits[:, 0], target[:, 0])
    return losses, (logits[:, 0] - target[:, 0]).detach().abs()
