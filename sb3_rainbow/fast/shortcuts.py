"""Compiled kernels for an update and for acting, only where they compute what torch would."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_rainbow.fast.blas import single_blas_thread
from sb3_rainbow.fast.eligibility import ChangeDetector, inherits, kernels_apply
from sb3_rainbow.fast.mlp_update import MlpUpdate
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.type_aliases import Batch

_ACTING = ("predict", "_predict", "forward", "obs_to_tensor", "reset_noise", "set_training_mode")


class Shortcuts:
    """Compiled kernels for ReLU perceptrons on the CPU.

    Whether they apply is decided anew whenever the policy's modules or its optimizer changed. Where
    they do not, each method says so by what it returns, and torch has to do it.

    Args:
        policy: whose networks and optimizer to work on.
    """

    def __init__(self, policy: RainbowPolicy) -> None:
        self.policy = policy
        self._detector: ChangeDetector | None = None
        self._optimizer: th.optim.Optimizer | None = None
        self._mlp: MlpUpdate | None = None

    def __getstate__(self) -> dict[str, Any]:
        # A copy makes its own: these refer to the modules and the memory of the original.
        return {**self.__dict__, "_detector": None, "_mlp": None}

    @property
    def kernels(self) -> MlpUpdate | None:
        """The compiled kernels, where they apply."""
        if self._mlp is not None and self._mlp.settled:
            return self._mlp
        if th.is_autocast_enabled("cpu"):
            return None
        optimizer = self.policy.optimizer
        if (
            self._detector is not None
            and self._optimizer is optimizer
            and self._detector.is_unchanged()
            and (self._mlp is None or self._mlp.is_current(optimizer))
        ):
            return self._mlp
        self._mlp = None
        self.policy.update_optimizer()
        nets = self.policy.q_net, self.policy.q_net_target
        if kernels_apply(*nets, optimizer):
            self._mlp = MlpUpdate(*nets)
        self._acts = inherits(self.policy, RainbowPolicy, *_ACTING)
        self._detector, self._optimizer = ChangeDetector(self.policy), optimizer
        return self._mlp

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Decide once whether the kernels apply, for updates between which nobody else acts."""
        kernels = self.kernels
        if kernels is None or not kernels.settle(self.policy.optimizer):
            yield
            return
        try:
            with single_blas_thread():
                yield
        finally:
            kernels.settled = False

    def update(
        self, batch: Batch, double_q: bool, max_grad_norm: float | None
    ) -> tuple[th.Tensor, th.Tensor] | None:
        """A whole update, noise and optimizer's step included; None where the kernels do not apply.

        Returns:
            mean loss, scalar, and priorities ``(B,)``.
        """
        kernels = self.kernels
        if kernels is None:
            return None
        with nullcontext() if kernels.settled else single_blas_thread():
            return kernels.update(batch, self.policy.optimizer, double_q, max_grad_norm)

    def act(
        self, obs: th.Tensor, action_masks: NDArray[np.bool_] | None
    ) -> NDArray[np.int64] | None:
        """Greedy actions under fresh noise, ``(n_envs,)``; None where the kernels do not apply."""
        kernels = self.kernels
        if kernels is None or not self._acts:
            return None
        with single_blas_thread():
            return kernels.act(obs, action_masks)

    def move_target(self, tau: float) -> bool:
        """Move the target network by ``tau``; False where the kernels do not apply."""
        kernels = self.kernels
        if kernels is None:
            return False
        kernels.move_target(tau)
        return True
