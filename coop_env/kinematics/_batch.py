"""What the batched library does with arrays: checks at the door, then a kernel over all rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class ShapeError(ValueError):
    """An array whose last axis (or axes) is not what the function takes; the message names it."""


def as_points(name: str, value: ArrayLike, *components: str) -> Floats:
    """``value`` as float64 whose last axis holds the named components.

    Raises:
        ShapeError: wrong last axis.
        TypeError: not real numbers.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":  # None and complex would turn into numbers
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise TypeError(
            f"{name} = {value!r}: must be real numbers in one array of shape "
            f"(..., {len(components)})"
        ) from None
    if array.ndim == 0 or array.shape[-1] != len(components):
        raise ShapeError(
            f"{name} has shape {array.shape}: must be (..., {len(components)}), "
            f"the last axis ({', '.join(components)})"
        )
    return array


def require_broadcast(name_a: str, a: Floats, name_b: str, b: Floats) -> None:
    """Refuse two batches that do not broadcast.

    Raises:
        ShapeError: the leading axes disagree.
    """
    try:
        np.broadcast_shapes(a.shape, b.shape)
    except ValueError:
        raise ShapeError(
            f"{name_a} of shape {a.shape} and {name_b} of shape {b.shape} do not broadcast: "
            "make their leading axes equal, or 1"
        ) from None


def over_rows(
    kernel: Callable[..., None], params: Any, inputs: tuple[Floats, ...], *kinds: str
) -> list[Any]:
    """What a kernel makes of each row of the inputs ``(..., 3)``, which broadcast.

    ``kernel(params, *columns, *outputs)`` gets every component of the inputs as an array ``(n,)``
    and fills arrays ``(n, ...)`` of the kinds given; a list of these, the batch's axes first.
    """
    lead = np.broadcast_shapes(*(array.shape[:-1] for array in inputs))
    columns = [np.broadcast_to(array[..., k], lead).flatten() for array in inputs for k in range(3)]
    outputs = [np.empty(lead, kind) for kind in kinds]
    rows = [output.reshape(columns[0].size, *output.shape[len(lead) :]) for output in outputs]
    kernel(params, *columns, *rows)
    return [output[()] for output in outputs]
