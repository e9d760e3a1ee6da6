"""Tensors that are parts of one vector, so that one operation serves them all."""

from collections.abc import Iterable, Sequence

import torch as th


def share(tensors: Sequence[th.Tensor], vector: th.Tensor) -> list[int]:
    """
    Make tensors parts of a vector, one after another; their values are the vector's from then on.

    :param tensors: of any shapes, in the vector's dtype and on its device
    :param vector: as many numbers as the tensors have together
    :return: the tensors' addresses: while those stay, they are parts
    """
    for tensor, part in zip(tensors, vector.split([t.numel() for t in tensors]), strict=True):
        tensor.data = part.view(tensor.shape)
    return [tensor.data_ptr() for tensor in tensors]


@th.no_grad()
def separate(tensors: Iterable[th.Tensor]) -> None:
    """Give each tensor that is a part of a larger memory one of its own."""
    for tensor in tensors:
        if tensor.untyped_storage().nbytes() > tensor.numel() * tensor.element_size():
            tensor.data = tensor.detach().clone()
