"""Denormal numbers are zero while the networks learn."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

# A normal number, whatever the mode at import, whose tenth is denormal
_SMALL = 3e-308


def denormals_are_zero() -> bool:
    """Whether this thread computes with denormal numbers as with zero."""
    return _SMALL * 0.1 == 0.0


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Compute with denormal numbers as with zero in this thread, and leave the setting as it was.

    The probability of an atom far from a sharp distribution, its gradient, and Adam's average of
    that gradient's square are below 1e-38, where 32-bit numbers become denormal. Many processors
    take a hundred cycles for each product of such a number. No value that matters is so small.
    Without effect where the processor has no such mode.

    The mode is the calling thread's own. Torch's worker threads, which share the work on large
    tensors, are not reached: one thread (``torch.set_num_threads(1)``) gives the full effect.
    """
    if denormals_are_zero() or not th.set_flush_denormal(True):
        yield
        return
    try:
        yield
    finally:
        th.set_flush_denormal(False)
