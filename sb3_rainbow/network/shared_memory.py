"""Tensors that are parts of one vector, so that one operation serves them all."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BaseModel


def is_dense(tensor: th.Tensor) -> bool:
    """Whether a tensor fills its memory without gaps: in order, or with channels last."""
    return tensor.is_contiguous() or (
        tensor.ndim == 4 and tensor.is_contiguous(memory_format=th.channels_last)
    )


def parts(vector: th.Tensor, tensors: Sequence[th.Tensor]) -> list[th.Tensor]:
    """Views of a vector, one after another, with the shapes and memory formats of dense tensors."""
    sizes = [t.numel() for t in tensors]
    return [
        part.as_strided(t.shape, t.stride(), part.storage_offset())
        for part, t in zip(vector.split(sizes), tensors, strict=True)
    ]


@th.no_grad()
def join(tensors: Sequence[th.Tensor], like: Sequence[th.Tensor]) -> th.Tensor:
    """Copy tensors into one vector, each with the layout of its counterpart in ``like``."""
    vector = tensors[0].new_empty(sum(t.numel() for t in tensors))
    for part, tensor in zip(parts(vector, like), tensors, strict=True):
        part.copy_(tensor)
    return vector


def share(tensors: Sequence[th.Tensor], vector: th.Tensor) -> list[int]:
    """Make dense tensors parts of a vector, whose values they have from then on.

    Returns:
        the tensors' addresses: while those stay, they are parts.
    """
    for tensor, part in zip(tensors, parts(vector, tensors), strict=True):
        tensor.data = part
    return [tensor.data_ptr() for tensor in tensors]


@th.no_grad()
def separate(tensors: Iterable[th.Tensor]) -> None:
    """Give each tensor that is a part of a larger memory one of its own.

    A tensor that other processes share on the CPU stays where they look for it.
    """
    for tensor in tensors:
        if tensor.device.type == "cpu" and tensor.is_shared():
            continue
        if tensor.untyped_storage().nbytes() > tensor.numel() * tensor.element_size():
            tensor.data = tensor.detach().clone()


class AsVector(BaseModel):
    """``parameters_to_vector`` for weights of any memory format."""

    def parameters_to_vector(self) -> NDArray[np.float32]:
        """All parameters, one after another."""
        flat = [p.detach().reshape(-1) for p in self.parameters()]
        return th.cat(flat).cpu().numpy()
