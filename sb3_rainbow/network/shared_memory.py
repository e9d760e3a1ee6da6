"""Tensors that are parts of one vector, so that one operation serves them all."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BaseModel

from sb3_rainbow.network.noisy_linear import NoisyLinear


def parts(vector: th.Tensor, tensors: Sequence[th.Tensor]) -> list[th.Tensor]:
    """Views of a vector, one after another, with the shapes and memory formats of dense tensors."""
    sizes = [t.numel() for t in tensors]
    return [
        part.as_strided(t.shape, t.stride(), part.storage_offset())
        for part, t in zip(vector.split(sizes), tensors, strict=True)
    ]


@th.no_grad()
def share(tensors: Sequence[th.Tensor], like: Sequence[th.Tensor] | None = None) -> th.Tensor:
    """Make float32 tensors parts of a new vector on the CPU, laid out as those in ``like``."""
    vector = th.empty(sum(t.numel() for t in tensors), dtype=th.float32)
    for tensor, part in zip(tensors, parts(vector, like or tensors), strict=True):
        tensor.data = part.copy_(tensor)
    return vector


@th.no_grad()
def _separate(tensors: Iterable[th.Tensor]) -> None:
    for tensor in tensors:
        if tensor.device.type == "cpu" and tensor.is_shared():
            continue  # with other processes, which look for it where it is
        if tensor.untyped_storage().nbytes() > tensor.numel() * tensor.element_size():
            tensor.data = tensor.detach().clone()


class AsVector(BaseModel):
    """A model of SB3's whose weights may have any memory format, and be parts of one vector."""

    def parameters_to_vector(self) -> NDArray[np.float32]:
        """All parameters, one after another."""
        flat = [p.detach().reshape(-1) for p in self.parameters()]
        return th.cat(flat).cpu().numpy()

    def separate(self) -> None:
        """Give each weight, noise and moment a memory of its own: pickle stores memory whole."""
        optimizer = getattr(self, "optimizer", None)
        states = getattr(optimizer, "state", {}).values()  # a wrapper may have none
        _separate(v for state in states for v in state.values() if isinstance(v, th.Tensor))
        noisy = [m for m in self.modules() if isinstance(m, NoisyLinear)]
        _separate([*self.parameters(), *(e for layer in noisy for e in layer.buffers())])

    def __getstate__(self) -> dict[str, Any]:
        self.separate()
        return self.__dict__.copy()

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:  # type: ignore[override]
        """As torch's, of tensors that share no memory."""
        self.separate()
        return super().state_dict(*args, **kwargs)
