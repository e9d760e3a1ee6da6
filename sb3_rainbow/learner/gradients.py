"""Loss and clipped gradient of one batch by torch, eager or as one compiled graph."""

import warnings
from typing import Any

import torch as th
from torch import nn

from sb3_rainbow.fast.flat_parameters import FlatParameters
from sb3_rainbow.learner.update import td_losses, td_target
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.type_aliases import Batch

LossAndPriorities = tuple[th.Tensor, th.Tensor]


class BatchLoss(nn.Module):
    """
    Weighted mean loss of a batch as a function of the online network's parameters.

    :param q_net: online network
    :param q_net_target: target network
    :param double_q: double Q-learning
    :param mixed_precision: whether to compute in bfloat16 where that is safe (CUDA)
    """

    def __init__(
        self,
        q_net: RainbowNetwork,
        q_net_target: RainbowNetwork,
        double_q: bool,
        mixed_precision: bool,
    ) -> None:
        super().__init__()
        self.q_net = q_net
        self._target = [q_net_target]  # in a list: no part of this module's parameters
        self.double_q = double_q
        self.mixed_precision = mixed_precision

    def forward(self, batch: Batch) -> LossAndPriorities:
        """Weighted mean loss with gradient, and priorities ``(B,)``."""
        device_type = self.q_net.support.device.type
        with th.autocast(device_type, th.bfloat16, enabled=self.mixed_precision):
            weights = self.q_net.noisy_weights()
            target = td_target(self.q_net, self._target[0], batch, self.double_q, weights)
            losses, priorities = td_losses(self.q_net, batch, target.values, weights)
        loss = (losses if batch.weights is None else losses * batch.weights).mean()
        return loss, priorities


class Gradients:
    """
    Leaves a batch's clipped gradient in the parameters' ``grad``.

    Compiled, loss, gradient and clipping are one graph without autograd's engine. It is a pure
    function: where it fails, at whatever call, the eager one takes over.

    :param loss: of one batch
    :param flat: the parameters as one vector, if they are
    :param max_grad_norm: gradient norm to clip to
    :param compiled: whether ``torch.compile`` makes one graph
    """

    def __init__(
        self, loss: BatchLoss, flat: FlatParameters | None, max_grad_norm: float, compiled: bool
    ) -> None:
        self.loss = loss
        self.flat = flat
        self.max_grad_norm = max_grad_norm
        trained = {name: p for name, p in loss.named_parameters() if p.requires_grad}
        self.parameters = list(trained.values())
        self._names = list(trained)
        self._graph: Any = None
        if compiled:
            # Batch normalization changes its statistics on the way, which a pure function cannot.
            pure = not any("running_" in name for name, _ in loss.named_buffers())
            on_gpu = loss.q_net.device.type == "cuda"
            self._graph = th.compile(
                self._gradients_of if pure else loss,
                fullgraph=True,
                dynamic=False,
                # Launching one kernel after the other would cost more than the kernels.
                mode="reduce-overhead" if pure and on_gpu else None,
            )
            self._is_pure = pure

    def __call__(self, batch: Batch) -> LossAndPriorities:
        """Mean loss, scalar, and priorities ``(B,)``; both stay on the device."""
        if self._graph is not None:
            try:
                return self._pure(batch) if self._is_pure else self._by_autograd(self._graph, batch)
            except Exception as error:  # whatever the compiler's back end raises
                reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
                warnings.warn(
                    f"compile=True has no effect, torch.compile failed: {reason}", stacklevel=2
                )
                self._graph = None
        return self._by_autograd(self.loss, batch)

    def _by_autograd(self, loss_of: Any, batch: Batch) -> LossAndPriorities:
        loss, priorities = loss_of(batch)
        # Without autograd's accumulation into .grad, and its zeros beforehand
        found = th.autograd.grad(loss, self.parameters, allow_unused=True, materialize_grads=True)
        with th.no_grad():
            self._store(self._clipped(self._joined(found)))
        return loss.detach(), priorities

    def _pure(self, batch: Batch) -> LossAndPriorities:
        parameters = [p.detach() for p in self.parameters]
        on_gpu = parameters[0].device.type == "cuda"
        if on_gpu:
            th.compiler.cudagraph_mark_step_begin()
        with th.no_grad():
            loss, priorities, found = self._graph(parameters, batch)
            self._store(found)
            if on_gpu:
                # The next call overwrites what this one returned.
                loss, priorities = loss.clone(), priorities.clone()
        return loss, priorities

    def _gradients_of(
        self, parameters: list[th.Tensor], batch: Batch
    ) -> tuple[th.Tensor, th.Tensor, list[th.Tensor]]:
        def loss_of(values: list[th.Tensor]) -> LossAndPriorities:
            named = dict(zip(self._names, values, strict=True))
            return th.func.functional_call(self.loss, named, (batch,))

        found, (loss, priorities) = th.func.grad_and_value(loss_of, has_aux=True)(parameters)
        return loss, priorities, self._clipped(self._joined(found))

    def _joined(self, gradients: Any) -> list[th.Tensor]:
        """One vector where the parameters are one."""
        if self.flat is None:
            return list(gradients)
        return [th.cat([g.reshape(-1) for g in gradients])]

    def _clipped(self, gradients: list[th.Tensor]) -> list[th.Tensor]:
        """Scaled down to ``max_grad_norm``, without a look at them from the host."""
        norm = th.stack([g.norm() for g in gradients]).norm()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        return [g * scale for g in gradients]

    def _store(self, gradients: list[th.Tensor]) -> None:
        if self.flat is not None:
            assert self.flat.vector.grad is not None
            self.flat.vector.grad.copy_(gradients[0])
            return
        for p, g in zip(self.parameters, gradients, strict=True):
            # A graph on a GPU overwrites its results.
            p.grad = g.clone() if p.grad is None else p.grad.copy_(g)
