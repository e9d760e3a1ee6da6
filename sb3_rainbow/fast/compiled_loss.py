"""Loss and clipped gradient of one batch as one graph by ``torch.compile``."""

import warnings
from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn

from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

LossAndPriorities = tuple[th.Tensor, th.Tensor]

# Buffers that stay as they are during an update; others, such as those of batch normalization, are
# written to on the way, which a pure function cannot
_CONSTANT_BUFFERS = {"support", "noise", "epsilon_in", "epsilon_out"}


class _Loss(nn.Module):
    """The loss of a batch as a function of the online network's parameters."""

    def __init__(
        self,
        q_net: RainbowNetwork,
        q_net_target: RainbowNetwork,
        loss: Callable[[RainbowNetwork, RainbowNetwork, Batch], LossAndPriorities],
    ) -> None:
        super().__init__()
        self.q_net = q_net
        self._others = (q_net_target, loss)  # in a tuple: no part of this module's parameters

    def forward(self, batch: Batch) -> LossAndPriorities:
        q_net_target, loss = self._others
        return loss(self.q_net, q_net_target, batch)


class CompiledLoss:
    """Leaves a batch's clipped gradient in the online parameters' ``grad``.

    Loss, gradient and clipping are one graph without autograd's engine. It is a pure function:
    where it fails, at whatever call, nothing has happened yet.

    Args:
        q_net: online network.
        q_net_target: target network.
        loss: weighted mean loss with gradient, and priorities, of both networks and a batch.
    """

    def __init__(
        self,
        q_net: RainbowNetwork,
        q_net_target: RainbowNetwork,
        loss: Callable[[RainbowNetwork, RainbowNetwork, Batch], LossAndPriorities],
    ) -> None:
        self._loss = _Loss(q_net, q_net_target, loss)
        trained = {n: p for n, p in self._loss.named_parameters() if p.requires_grad}
        self._names, self.parameters = list(trained), list(trained.values())
        # What does not train must not keep a gradient of former times.
        q_net.zero_grad()
        buffers = {name.rpartition(".")[2] for name, _ in self._loss.named_buffers()}
        self._is_pure = buffers <= _CONSTANT_BUFFERS
        self._on_gpu = q_net.device.type == "cuda"
        self._graph: Any = None

    def _compile(self) -> Any:
        return th.compile(
            self._gradients_of if self._is_pure else self._loss,
            fullgraph=True,
            dynamic=False,
            # Launching one kernel after the other would cost more than the kernels.
            mode="reduce-overhead" if self._is_pure and self._on_gpu else None,
        )

    def __call__(self, batch: Batch, max_grad_norm: float | None) -> LossAndPriorities | None:
        """Mean loss, scalar, and priorities ``(B,)``, both on the device; None if it failed.

        Args:
            batch: transitions.
            max_grad_norm: gradient norm to clip to, None for no clipping.
        """
        try:
            if self._graph is None:  # already this fails where Python is newer than torch
                self._graph = self._compile()
            return self._run(batch, max_grad_norm)
        except Exception as error:  # whatever the compiler's back end raises
            reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
            warnings.warn(
                f"compile=True has no effect, torch.compile failed: {reason}", stacklevel=2
            )
            return None

    def _run(self, batch: Batch, max_grad_norm: float | None) -> LossAndPriorities:
        if not self._is_pure:
            loss, priorities = self._graph(batch)
            self._loss.zero_grad()
            loss.backward()
            if max_grad_norm is not None:
                nn.utils.clip_grad_norm_(self.parameters, max_grad_norm)
            return loss.detach(), priorities
        if self._on_gpu:
            th.compiler.cudagraph_mark_step_begin()
        with th.no_grad():
            values = [p.detach() for p in self.parameters]
            loss, priorities, found = self._graph(values, batch, max_grad_norm)
            gradients = [th.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
            # The next call on a GPU overwrites what this one returned.
            th._foreach_copy_(gradients, found)
            for p, gradient in zip(self.parameters, gradients, strict=True):
                p.grad = gradient
            return (loss.clone(), priorities.clone()) if self._on_gpu else (loss, priorities)

    def _gradients_of(
        self, parameters: list[th.Tensor], batch: Batch, max_grad_norm: float | None
    ) -> tuple[th.Tensor, th.Tensor, list[th.Tensor]]:
        def loss_of(values: list[th.Tensor]) -> LossAndPriorities:
            named = dict(zip(self._names, values, strict=True))
            return th.func.functional_call(self._loss, named, (batch,))

        found, (loss, priorities) = th.func.grad_and_value(loss_of, has_aux=True)(parameters)
        if max_grad_norm is not None:
            norm = th.stack([g.norm() for g in found]).norm()
            scale = (max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
            found = [g * scale for g in found]
        return loss, priorities, list(found)
