"""Denormal numbers are zero while the networks learn."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

_DENORMAL = th.tensor(1e-40)


def denormals_are_zero() -> bool:
    """Whether this thread computes with denormal numbers as with zero."""
    return not bool((_DENORMAL * 1.0).item())


@contextmanager
def flush_denormals() -> Iterator[None]:
    """
    Compute with denormal numbers as with zero in this thread, and leave the setting as it was.

    The probability of an atom far from a sharp distribution, its gradient, and Adam's average of
    that gradient's square are below 1e-38, where 32-bit numbers become denormal. Many processors
    take a hundred cycles for each product of such a number. No value that matters is so small.
    Without effect where the processor has no such mode.
    """
    if denormals_are_zero() or not th.set_flush_denormal(True):
        yield
        return
    try:
        yield
    finally:
        th.set_flush_denormal(False)
