"""Arrays of the batched library: checks of arguments, and kernels over all rows."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coop_env.compilation import njit

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class ShapeError(ValueError):
    """An array with a wrong last axis, or two that do not broadcast; the message names them."""


def as_points(name: str, value: ArrayLike, *components: str) -> Floats:
    """``value`` as float64 with the named components along its last axis; ShapeError, TypeError."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":  # None and complex would turn into numbers
            raise TypeError
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
    return array.astype(np.float64)


def require_broadcast(name_a: str, a: Floats, name_b: str, b: Floats) -> None:
    """Raise ShapeError for two batches that do not broadcast."""
    try:
        np.broadcast_shapes(a.shape, b.shape)
    except ValueError:
        raise ShapeError(
            f"{name_a} of shape {a.shape} and {name_b} of shape {b.shape} do not broadcast: "
            "make their leading axes equal, or 1"
        ) from None


def over_rows(*kinds: str) -> Callable[[Callable[..., None]], Callable[..., list[Any]]]:
    """Compile a loop over rows and let it fill arrays for a batch of any shape.

    The loop ``(params, *columns, *outputs)`` gets every component of its inputs as an array
    ``(n,)`` and fills one array ``(n, ...)`` of each kind. The function that replaces it takes the
    params and the inputs ``(..., 3)``, which broadcast, and returns the arrays ``(..., ...)``.
    """

    def decorate(loop: Callable[..., None]) -> Callable[..., list[Any]]:
        kernel, dtypes = njit(cache=True)(loop), [np.dtype(kind) for kind in kinds]

        def fill(params: Any, *inputs: Floats) -> list[Any]:
            alike = len({a.shape for a in inputs}) == 1  # the usual case, and broadcasting is slow
            wide = inputs if alike else np.broadcast_arrays(*inputs)
            columns = np.array([column for a in wide for column in a.reshape(-1, 3).T], order="C")
            rows = [np.empty(columns.shape[1], dtype) for dtype in dtypes]
            kernel(params, *columns, *rows)
            shape = wide[0].shape[:-1]
            return [row.reshape(shape + row.shape[1:])[()] for row in rows]

        return fill

    return decorate
