"""Arrays of a batch to the device and back, each way in one piece."""

from typing import Any, TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_rainbow.type_aliases import ObsArray

# Views of any dtype may start at these places.
_ALIGNMENT = 16

Places: TypeAlias = list[tuple[str, int, NDArray]]


def to_device(arrays: dict[str, ObsArray], device: th.device) -> dict[str, Any]:
    """Tensors of fresh, contiguous arrays, or of dicts of such.

    On the CPU they share the arrays' memory. To any other device all bytes go in one copy, which
    nobody waits for: one for each array would cost more than a small batch's whole update.
    """
    if device.type == "cpu":
        return {
            name: {key: th.from_numpy(part) for key, part in given.items()}
            if isinstance(given, dict)
            else th.from_numpy(given)
            for name, given in arrays.items()
        }
    flat: dict[str, NDArray] = {}
    for name, given in arrays.items():
        parts = given.items() if isinstance(given, dict) else [("", given)]
        flat |= {f"{name}/{key}": part for key, part in parts}
    places, size = place(flat)
    packed = pack(places, size, pinned=device.type == "cuda")
    tensors = unpack(packed.to(device, non_blocking=True), places)
    return {
        name: {key: tensors[f"{name}/{key}"] for key in given}
        if isinstance(given, dict)
        else tensors[f"{name}/"]
        for name, given in arrays.items()
    }


def place(arrays: dict[str, NDArray]) -> tuple[Places, int]:
    """Where each array begins in the packed bytes, and how many there are."""
    places: Places = []
    start = 0
    for name, array in arrays.items():
        places.append((name, start, array))
        start += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    return places, start


def pack(places: Places, size: int, pinned: bool) -> th.Tensor:
    """All bytes in one tensor, in page-locked memory if ``pinned``."""
    packed = th.empty(size, dtype=th.uint8, pin_memory=pinned)
    view = packed.numpy()
    for _, start, array in places:
        view[start : start + array.nbytes] = array.reshape(-1).view(np.uint8)
    return packed


def unpack(packed: th.Tensor, places: Places) -> dict[str, th.Tensor]:
    """Undo :func:`pack`, wherever the bytes are now; the tensors are views."""
    return {
        name: packed[start : start + array.nbytes]
        .view(th.from_numpy(array[:0]).dtype)
        .view(array.shape)
        for name, start, array in places
    }


def from_device(loss: th.Tensor, priorities: th.Tensor) -> tuple[float, NDArray[np.float32]]:
    """A scalar and a vector ``(n,)`` in one transfer."""
    if loss.device.type == "cpu":
        return float(loss), priorities.numpy()
    both = th.cat((loss.reshape(1), priorities)).cpu().numpy()
    return float(both[0]), both[1:]
