"""One gradient step of Rainbow, from a batch of transitions to moved networks."""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_rainbow.fast.blas import single_blas_thread
from sb3_rainbow.fast.flat_parameters import FlatParameters
from sb3_rainbow.fast.mlp_update import MlpUpdate
from sb3_rainbow.learner.gradients import BatchLoss, Gradients
from sb3_rainbow.learner.update import td_target
from sb3_rainbow.network.losses import clipped_share
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.type_aliases import Batch


class Learner:
    """
    Moves a policy's networks.

    :param policy: whose networks and optimizer to work on
    :param double_q: double Q-learning
    :param max_grad_norm: gradient norm to clip to
    :param compile_loss: whether ``torch.compile`` makes one graph of target, loss and gradient
    :param mixed_precision: whether to compute the loss in bfloat16 where that is safe (CUDA)
    :param cpu_kernels: whether compiled kernels take over where they can
    """

    def __init__(
        self,
        policy: RainbowPolicy,
        double_q: bool,
        max_grad_norm: float,
        compile_loss: bool = False,
        mixed_precision: bool = False,
        cpu_kernels: bool = True,
    ) -> None:
        self.policy = policy
        self.q_net = policy.q_net
        self.q_net_target = policy.q_net_target
        self.double_q = double_q
        self.max_grad_norm = max_grad_norm
        # Collected once: walking the modules at every update costs as much as a matrix product.
        self._flat = policy.flat
        self._flat_target: FlatParameters | None = None
        self._online: list[th.Tensor] = list(self.q_net.parameters())
        self._target: list[th.Tensor] = list(self.q_net_target.parameters())
        if self._flat is not None:
            self._flat_target = FlatParameters(self.q_net_target.parameters())
            self._online = [self._flat.vector]
            self._target = [self._flat_target.vector]
        loss = BatchLoss(self.q_net, self.q_net_target, double_q, mixed_precision)
        self._gradients = Gradients(loss, self._flat, max_grad_norm, compile_loss)
        self._cpu_kernels = cpu_kernels
        self._use_optimizer(policy.optimizer)
        self._online_statistics = get_parameters_by_name(self.q_net, ["running_"])
        self._target_statistics = get_parameters_by_name(self.q_net_target, ["running_"])

    def check_trained_parameters(self) -> None:
        """
        :raises ValueError: if a parameter was frozen or freed since the model was made
        """
        trained = [id(p) for p in self.q_net.parameters() if p.requires_grad]
        if trained != [id(p) for p in self._gradients.parameters]:
            raise ValueError(
                "Which parameters train was changed after the model was made, when its optimizer "
                "was: call requires_grad_(False) where they are made, in the constructor of the "
                "features extractor"
            )

    def _use_optimizer(self, optimizer: th.optim.Optimizer) -> None:
        self.optimizer = optimizer
        self._mlp: MlpUpdate | None = None
        if self._cpu_kernels and MlpUpdate.is_possible(self.q_net, self._flat, optimizer):
            assert self._flat is not None
            assert self._flat_target is not None
            self._mlp = MlpUpdate(
                self.q_net, self.q_net_target, self._flat, self._flat_target, optimizer
            )

    def _tie_parameters(self) -> None:
        """Let the vectors hold what the networks hold, whoever replaced weights since last time."""
        for flat in (self._flat, self._flat_target):
            if flat is not None and not flat.is_tied:
                flat.tie()

    def update(self, batch: Batch) -> tuple[th.Tensor, th.Tensor]:
        """
        One optimizer step, with fresh and independent noise in both networks.

        :return: mean loss, scalar, and priorities ``(B,)``; both stay on the device
        """
        self.q_net.reset_noise()
        self.q_net_target.reset_noise()
        self._tie_parameters()
        if self.policy.optimizer is not self.optimizer:
            # Somebody gave the policy another one.
            self._use_optimizer(self.policy.optimizer)
        if self._mlp is not None:
            with single_blas_thread():
                return self._mlp.update(batch, self.double_q, self.max_grad_norm)
        loss, priorities = self._gradients(batch)
        self.optimizer.step()
        return loss, priorities

    def act(
        self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64] | None:
        """
        Greedy actions under fresh noise, ``(n_envs,)``; None where torch has to find them.

        :param obs: observations, ``(n_envs, ...)``
        :param action_masks: True where allowed, ``(n_envs, n_actions)``
        """
        if self._mlp is None:
            return None
        self.q_net.reset_noise()
        self._tie_parameters()
        with single_blas_thread():
            return self._mlp.act(obs, action_masks)

    @th.no_grad()
    def move_target(self, tau: float) -> None:
        """Move the target network towards the online one by ``tau`` (Polyak average)."""
        self._tie_parameters()
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
