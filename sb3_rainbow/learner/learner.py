"""One gradient step of Rainbow, from a batch of transitions to moved networks."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_rainbow.learner.update import mean_loss, td_target
from sb3_rainbow.network.losses import clipped_share
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.type_aliases import Batch

try:
    from sb3_rainbow.fast.mlp_update import MlpUpdate
    from sb3_rainbow.fast.shortcuts import Shortcuts
except ModuleNotFoundError:  # without that folder this module does it all, slower
    Shortcuts = None  # type: ignore[assignment, misc]

# A normal number, whatever the mode at import, whose tenth is denormal
_SMALL = 3e-308


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Compute with denormal numbers as with zero in this thread; the setting is restored after.

    Atoms far from a sharp distribution have probabilities and gradients below 1e-38, where float32
    becomes denormal and many processors take a hundred cycles a product. No value that matters is
    so small. Torch's worker threads are not reached: ``torch.set_num_threads(1)`` gives the full
    effect. Without effect where the processor has no such mode.
    """
    changes = _SMALL * 0.1 != 0.0 and th.set_flush_denormal(True)
    try:
        yield
    finally:
        if changes:
            th.set_flush_denormal(False)


class Learner:
    """Moves a policy's networks, with ``cpu_kernels`` by compiled kernels where they can.

    ``double_q`` and ``max_grad_norm`` may change between two updates.
    """

    def __init__(
        self,
        policy: RainbowPolicy,
        double_q: bool,
        max_grad_norm: float | None,
        cpu_kernels: bool = True,
    ) -> None:
        self.policy = policy
        self.double_q = double_q
        self.max_grad_norm = max_grad_norm
        available = cpu_kernels and Shortcuts is not None
        self.shortcuts: Shortcuts | None = Shortcuts(policy) if available else None

    def kernels(self) -> "MlpUpdate | None":
        """The compiled kernels, where they take over at present."""
        return None if self.shortcuts is None else self.shortcuts.kernels

    def undisturbed(self) -> AbstractContextManager[None]:
        """Context for updates between which nobody else touches the policy: one check for all."""
        kernels = self.kernels()
        return nullcontext() if kernels is None else kernels.undisturbed(self.policy.optimizer)

    def update(self, batch: Batch, tau: float | None = None) -> tuple[th.Tensor, th.Tensor]:
        """One optimizer step, with fresh and independent noise in both networks.

        Args:
            tau: how far the target network moves after it, None for not at all.

        Returns:
            mean loss, scalar, and priorities ``(B,)``; both stay on the device.
        """
        kernels, optimizer = self.kernels(), self.policy.optimizer
        if kernels is None:
            result = self._update(batch)
        else:
            result = kernels.update(batch, optimizer, self.double_q, self.max_grad_norm)
        if tau is not None:
            self.move_target(tau)
        return result

    def _update(self, batch: Batch) -> tuple[th.Tensor, th.Tensor]:
        """One optimizer step by torch."""
        policy = self.policy
        policy.q_net.reset_noise()
        policy.q_net_target.reset_noise()
        policy.update_optimizer()
        loss, priorities = mean_loss(policy.q_net, policy.q_net_target, batch, self.double_q)
        policy.q_net.zero_grad()
        policy.optimizer.zero_grad()  # which may hold parameters of elsewhere
        loss.backward()
        if self.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(policy.q_net.parameters(), self.max_grad_norm)
        policy.optimizer.step()
        return loss.detach(), priorities

    def act(
        self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64] | None:
        """Greedy actions under fresh noise, ``(n_envs,)``; None where the policy has to choose."""
        kernels = self.kernels()
        if self.shortcuts is None or kernels is None or not self.shortcuts.acts:
            return None
        return kernels.act(obs, action_masks)

    @th.no_grad()
    def move_target(self, tau: float) -> None:
        """Move the target network towards the online one by ``tau`` (Polyak average)."""
        kernels = self.kernels()
        if kernels is not None:
            kernels.move_target(tau)
            return
        online, target = self.policy.q_net, self.policy.q_net_target
        th._foreach_lerp_(list(target.parameters()), list(online.parameters()), tau)
        # as SB3: by "running_" anywhere in the name, and copied
        for (name, ours), theirs in zip(online.named_buffers(), target.buffers(), strict=True):
            if "running_" in name:
                theirs.copy_(ours)

    @th.no_grad()
    def diagnostics(self, batch: Batch, priorities: th.Tensor) -> dict[str, float]:
        """Values for the logs: mean over states of the largest Q-value, share of the target that
        the support clips, spread (standard deviation over mean) of priorities, noise magnitudes.
        """
        q_net = self.policy.q_net
        q_net.set_training_mode(False)  # statistics of normalization layers stay
        values = {"max_q": float(q_net(batch.observations).amax(dim=1).mean())}
        if q_net.head == "categorical":
            target = td_target(q_net, self.policy.q_net_target, batch, self.double_q)
            share = clipped_share(
                target.next_values,
                batch.rewards,
                batch.discounts * (1.0 - batch.dones),
                q_net.v_min,
                q_net.v_max,
            )
            values["clipped_support"] = float(share)
        if len(batch.indices):  # of a buffer that has priorities
            deviation = priorities.std(correction=int(len(priorities) > 1))
            values["priority_spread"] = float(deviation / priorities.mean().clamp(min=1e-12))
        magnitudes = q_net.noise_magnitudes()
        if magnitudes:
            values["noise_magnitude"] = float(np.mean(list(magnitudes.values())))
            values.update({f"noise_magnitude_{name}": m for name, m in magnitudes.items()})
        return values


def as_batch(samples: Any, gamma: float, masking: bool) -> Batch:
    """A sample of any buffer as a batch; ``gamma`` if it has no discounts, masks if ``masking``."""
    discounts, weights = (getattr(samples, name, None) for name in ("discounts", "weights"))
    n = len(samples.rewards)
    return Batch(
        samples.observations,
        samples.actions.long(),
        samples.next_observations,
        samples.dones,
        samples.rewards,
        th.full_like(samples.rewards, gamma) if discounts is None else discounts.reshape(n, 1),
        samples.rewards.new_ones(n) if weights is None else weights.reshape(n),
        getattr(samples, "indices", np.empty(0, np.int64)),
        getattr(samples, "next_action_masks", None) if masking else None,
    )
