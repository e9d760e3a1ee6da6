"""Faster ways of an update, each taken only where it computes what the plain way computes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_rainbow.fast.adam import has_hooks
from sb3_rainbow.fast.blas import single_blas_thread
from sb3_rainbow.fast.compiled_loss import CompiledLoss
from sb3_rainbow.fast.mlp_update import MlpUpdate
from sb3_rainbow.fast.originals import Watch, are_hooked, inherits
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.type_aliases import Batch

LossAndPriorities = tuple[th.Tensor, th.Tensor]
Loss = Callable[[RainbowNetwork, RainbowNetwork, Batch], LossAndPriorities]

_ACTING = ("predict", "_predict", "forward", "obs_to_tensor", "reset_noise", "set_training_mode")


class Shortcuts:
    """Compiled kernels for ReLU perceptrons on the CPU, or one graph of loss and gradient.

    What stands in for the plain way is decided anew whenever the policy's modules or its optimizer
    changed. Each method says by what it returns that the plain way has to do it.

    Args:
        policy: whose networks and optimizer to work on.
        loss: weighted mean loss with gradient, and priorities, of two networks and a batch.
        compile_loss: whether to make one graph by ``torch.compile``.
        cpu_kernels: whether compiled kernels take over where they can.
    """

    def __init__(
        self,
        policy: RainbowPolicy,
        loss: Loss,
        compile_loss: bool,
        cpu_kernels: bool,
    ) -> None:
        self.policy = policy
        self._loss = loss
        self._compile_loss = compile_loss
        self._cpu_kernels = cpu_kernels
        self._forget()

    def _forget(self) -> None:
        self._watch: Watch | None = None
        self._optimizer: th.optim.Optimizer | None = None
        self._mlp: MlpUpdate | None = None
        self._graph: CompiledLoss | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A copy finds its own: these hold on to the modules and the memory of the original.
        return {**self.__dict__, "_watch": None, "_mlp": None, "_graph": None}

    @property
    def kernels(self) -> MlpUpdate | None:
        """The compiled kernels, where they can do it."""
        self._look()
        return self._mlp

    @property
    def graph(self) -> CompiledLoss | None:
        """The compiled loss, where there is one."""
        self._look()
        return self._graph

    def _look(self) -> None:
        if (
            self._watch is not None
            and self._optimizer is self.policy.optimizer
            and self._watch.sees_no_change()
            and (self._mlp is None or self._mlp.is_current(self.policy.optimizer))
        ):
            return
        self._forget()
        self.policy.update_optimizer()
        q_net, q_net_target = self.policy.q_net, self.policy.q_net_target
        if self._cpu_kernels and MlpUpdate.is_possible(q_net, q_net_target, self.policy.optimizer):
            self._mlp = MlpUpdate(q_net, q_net_target)
        elif self._compile_loss and not are_hooked(q_net.parameters()):
            self._graph = CompiledLoss(q_net, q_net_target, self._loss)
        self._acts = inherits(self.policy, RainbowPolicy, *_ACTING)
        self._watch, self._optimizer = Watch(self.policy), self.policy.optimizer

    def update(
        self,
        batch: Batch,
        double_q: bool,
        max_grad_norm: float | None,
        advantage_learning: float,
    ) -> LossAndPriorities | None:
        """A whole update, noise and optimizer's step included; None where it did nothing."""
        self._look()
        if self._mlp is None:
            return None
        with single_blas_thread():
            return self._mlp.update(
                batch, self.policy.optimizer, double_q, max_grad_norm, advantage_learning
            )

    def gradient(self, batch: Batch, max_grad_norm: float | None) -> LossAndPriorities | None:
        """Leave the clipped gradient in the parameters' ``grad``; None where it did nothing."""
        self._look()
        if self._graph is None:
            return None
        found = self._graph(batch, max_grad_norm)
        if found is None:
            self._compile_loss, self._graph = False, None
        return found

    def act(
        self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64] | None:
        """Greedy actions under fresh noise, ``(n_envs,)``; None where it found none."""
        self._look()
        if self._mlp is None or not self._acts:
            return None
        with single_blas_thread():
            return self._mlp.act(obs, action_masks)

    def move_target(self, tau: float, just_updated: bool = False) -> bool:
        """Move the target network by ``tau``; False where it did not."""
        if not just_updated or has_hooks(self.policy.optimizer):
            self._look()
        if self._mlp is None:
            return False
        self._mlp.move_target(tau)
        return True
