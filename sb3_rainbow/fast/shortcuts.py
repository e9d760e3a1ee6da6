"""Compiled kernels for an update and for acting, only where they compute what torch would."""

from typing import Any

import torch as th

from sb3_rainbow.fast.eligibility import ChangeDetector, inherits, kernels_apply
from sb3_rainbow.fast.mlp_update import MlpUpdate
from sb3_rainbow.policies import RainbowPolicy

_ACTING = ("predict", "_predict", "forward", "obs_to_tensor", "reset_noise", "set_training_mode")


class Shortcuts:
    """Compiled kernels for ReLU perceptrons on the CPU.

    Whether they apply is decided anew whenever the policy's modules or its optimizer changed.

    Args:
        policy: whose networks and optimizer to work on.
    """

    def __init__(self, policy: RainbowPolicy) -> None:
        self.policy = policy
        self._detector: ChangeDetector | None = None
        self._optimizer: th.optim.Optimizer | None = None
        self._mlp: MlpUpdate | None = None
        self.acts = False
        """Whether the kernels may choose actions too, as of the last look."""

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
        self.acts = inherits(self.policy, RainbowPolicy, *_ACTING)
        self._detector, self._optimizer = ChangeDetector(self.policy), optimizer
        return self._mlp
