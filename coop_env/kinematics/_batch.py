"""Checks at the door of the batched library."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def quiet() -> np.errstate:
    """NaN passes through the kernels by design; within this numpy does not warn of it."""
    return np.errstate(invalid="ignore", divide="ignore", over="ignore")


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
