"""Targets and losses as pure functions of tensors. B: batch, A: actions, N: atoms."""

import torch as th
from torch.nn import functional as F


def mask_q_values(q_values: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
    """Q-values ``(B, A)`` with those of actions that masks ``(B, A)`` forbid at minus infinity.

    Masks act on expected values: on the logits of a distribution they would only deform it.
    """
    if action_masks is None:
        return q_values
    return q_values.masked_fill(~action_masks, -th.inf)


def project_distribution(
    probabilities: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, v_min: float, v_max: float
) -> th.Tensor:
    """Projections ``(B, N)`` of ``r + discount * Z`` (Bellemare et al. 2017, equation 7).

    The lower neighbour is at most the last atom but one: an atom that falls exactly on the grid, or
    is clipped to either end, keeps its whole mass without a special case.

    Args:
        probabilities: distribution of Z over N evenly spaced atoms, shape ``(B, N)``.
        rewards: n-step returns, shape ``(B, 1)``.
        discounts: gamma^k, and 0 where the episode terminated, shape ``(B, 1)``.
    """
    n_atoms = probabilities.shape[1]
    position = _positions(rewards, discounts, n_atoms, v_min, v_max).clamp(0, n_atoms - 1)
    lower = position.floor().clamp(max=n_atoms - 2)
    upper_mass = probabilities * (position - lower)
    index = lower.nan_to_num().long()  # a return that is no number makes its masses none
    projected = th.zeros_like(probabilities)
    projected.scatter_add_(1, index, probabilities - upper_mass)
    projected.scatter_add_(1, index + 1, upper_mass)
    return projected


def _positions(
    rewards: th.Tensor, discounts: th.Tensor, n_atoms: int, v_min: float, v_max: float
) -> th.Tensor:
    """Where the atoms of ``r + discount * Z`` fall, in atoms above the lowest, ``(B, N)``.

    Relative to ``v_min``: values themselves would leave few digits for what lies between the atoms
    of a narrow support far from zero.
    """
    delta_z = (v_max - v_min) / (n_atoms - 1)
    offset = (rewards + (discounts - 1.0) * v_min) / delta_z
    return offset + discounts * th.arange(n_atoms, device=rewards.device, dtype=rewards.dtype)


def clipped_share(
    probabilities: th.Tensor, rewards: th.Tensor, discounts: th.Tensor, v_min: float, v_max: float
) -> th.Tensor:
    """Share of the target's probability mass outside ``[v_min, v_max]``; scalar.

    Arguments as in :func:`project_distribution`. Above 0 the support is too narrow for the returns.
    """
    n_atoms = probabilities.shape[1]
    position = _positions(rewards, discounts, n_atoms, v_min, v_max)
    last, tolerance = n_atoms - 1, 1e-6 * (n_atoms - 1)
    outside = (position < -tolerance) | (position > last + tolerance)
    return (probabilities * outside).sum(dim=1).mean()


def categorical_losses(logits: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Cross-entropies ``(B,)`` of projected targets with the taken actions' logits ``(B, N)``."""
    return -(target * F.log_softmax(logits, dim=1)).sum(dim=1)


def target_entropies(target: th.Tensor) -> th.Tensor:
    """Entropies ``(B,)`` of projected targets ``(B, N)``: no cross-entropy is smaller."""
    return -th.special.xlogy(target, target).sum(dim=1)


def quantile_losses(quantiles: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Quantile Huber losses ``(B,)`` with threshold 1 (Dabney et al. 2018, equation 10): the mean
    over the target's samples ``(B, M)``, summed over the quantiles ``(B, N)`` of the action taken.
    """
    n = quantiles.shape[1]
    midpoints = (th.arange(n, device=quantiles.device, dtype=quantiles.dtype) + 0.5) / n
    predicted = quantiles.unsqueeze(2).expand(-1, -1, target.shape[1])
    wanted = target.unsqueeze(1).expand_as(predicted)
    huber = F.smooth_l1_loss(predicted, wanted, reduction="none")
    tilt = (midpoints[:, None] - (wanted < predicted.detach()).to(quantiles.dtype)).abs()
    return (tilt * huber).mean(dim=2).sum(dim=1)
