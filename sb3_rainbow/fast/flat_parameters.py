"""All parameters of a network as one vector, so that an optimizer step is a handful of kernels."""

from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn


class FlatParameters:
    """
    Makes parameters views of one vector, and their gradients views of another.

    Norm, clipping, Adam and the Polyak average then each cost one kernel instead of one per
    parameter. The parameters keep their shapes, and loading a state dict still works: it copies in
    place.

    :param parameters: of one network
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self.parameters = list(parameters)
        self.vector = nn.Parameter(th.empty(0))
        self.tie()

    @staticmethod
    def is_possible(parameters: Iterable[nn.Parameter]) -> bool:
        """Whether all parameters train, in one dtype on one device."""
        kinds = {(p.dtype, p.device, p.requires_grad) for p in parameters}
        return len(kinds) == 1 and next(iter(kinds))[2]

    @property
    def has_gradient(self) -> bool:
        """Whether the parameters train; a target network's do not."""
        return self.parameters[0].requires_grad

    @property
    def is_tied(self) -> bool:
        """False after something replaced a parameter's memory, as ``to(device)`` does."""
        if self._addresses() != self._tied_addresses:
            return False
        first = self.parameters[0]
        return not self.has_gradient or (first.grad is not None and self.vector.grad is not None)

    def _addresses(self) -> list[int]:
        return [self.vector.data_ptr(), *[p.data_ptr() for p in self.parameters]]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # Pickle gives every view a memory of its own.
        self.tie()

    @th.no_grad()
    def tie(self) -> None:
        """Copy the parameters into one vector and make them views of it."""
        self.vector.data = th.cat([p.detach().reshape(-1) for p in self.parameters])
        self.vector.grad = th.zeros_like(self.vector) if self.has_gradient else None
        start = 0
        for p in self.parameters:
            end = start + p.numel()
            p.data = self.vector.data[start:end].view(p.shape)
            if self.vector.grad is not None:
                p.grad = self.vector.grad[start:end].view(p.shape)
            start = end
        self._tied_addresses = self._addresses()
