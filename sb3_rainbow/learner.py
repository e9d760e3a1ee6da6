"""One gradient step of Rainbow, from a batch of transitions to moved networks."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_rainbow.losses import clipped_share
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.type_aliases import Batch
from sb3_rainbow.update import td_losses, td_target


class Learner:
    """
    Moves a policy's networks.

    :param policy: whose networks and optimizer to work on
    :param double_q: double Q-learning
    :param max_grad_norm: gradient norm to clip to
    """

    def __init__(self, policy: RainbowPolicy, double_q: bool, max_grad_norm: float) -> None:
        self.q_net = policy.q_net
        self.q_net_target = policy.q_net_target
        self.optimizer = policy.optimizer
        self.double_q = double_q
        self.max_grad_norm = max_grad_norm
        # Collected once: walking the modules at every update costs as much as a matrix product.
        self._online: list[th.Tensor] = list(self.q_net.parameters())
        self._target: list[th.Tensor] = list(self.q_net_target.parameters())
        self._online_statistics = get_parameters_by_name(self.q_net, ["running_"])
        self._target_statistics = get_parameters_by_name(self.q_net_target, ["running_"])

    def update(self, batch: Batch) -> tuple[th.Tensor, th.Tensor]:
        """
        One optimizer step, with fresh and independent noise in both networks.

        :return: mean loss, scalar, and priorities ``(B,)``; both stay on the device
        """
        self.q_net.reset_noise()
        self.q_net_target.reset_noise()
        target = td_target(self.q_net, self.q_net_target, batch, self.double_q)
        losses, priorities = td_losses(self.q_net, batch, target.values)
        loss = (losses if batch.weights is None else losses * batch.weights).mean()
        self.optimizer.zero_grad()
        loss.backward()
        th.nn.utils.clip_grad_norm_(self._online, self.max_grad_norm)
        self.optimizer.step()
        return loss.detach(), priorities

    @th.no_grad()
    def move_target(self, tau: float) -> None:
        """Move the target network towards the online one by ``tau`` (Polyak average)."""
        th._foreach_lerp_(self._target, self._online, tau)
        if self._online_statistics:
            polyak_update(self._online_statistics, self._target_statistics, 1.0)

    @th.no_grad()
    def diagnostics(self, batch: Batch, priorities: th.Tensor) -> dict[str, float]:
        """
        What only the logs need, by name: the mean over states of the largest Q-value, the share of
        the target's mass that the support clips, the spread (standard deviation over mean) of the
        batch's priorities, and the noise magnitudes.
        """
        values = {"max_q": float(self.q_net(batch.observations).amax(dim=1).mean())}
        if self.q_net.distributional:
            target = td_target(self.q_net, self.q_net_target, batch, self.double_q)
            share = clipped_share(
                target.next_probabilities,
                batch.rewards,
                batch.discounts * (1.0 - batch.dones),
                self.q_net.support,
                self.q_net.v_min,
                self.q_net.v_max,
            )
            values["clipped_support"] = float(share)
        if batch.weights is not None:
            spread = priorities.std() / priorities.mean().clamp(min=1e-12)
            values["priority_spread"] = float(spread)
        magnitudes = self.q_net.noise_magnitudes()
        if magnitudes:
            values["noise_magnitude"] = float(np.mean(list(magnitudes.values())))
            values.update({f"noise_magnitude_{name}": m for name, m in magnitudes.items()})
        return values


def as_batch(samples: Any, gamma: float, masking: bool) -> Batch:
    """
    What an update needs of a sample of any of SB3's buffers.

    :param samples: from ``PrioritizedReplayBuffer`` or one of SB3's buffers
    :param gamma: discount of samples that bring none
    :param masking: whether the masks of the sample, if any, count
    """
    discounts = getattr(samples, "discounts", None)
    if discounts is None:
        discounts = th.full_like(samples.rewards, gamma)
    return Batch(
        samples.observations,
        samples.actions.long(),
        samples.next_observations,
        samples.dones,
        samples.rewards,
        discounts,
        getattr(samples, "weights", None),
        getattr(samples, "next_action_masks", None) if masking else None,
    )
