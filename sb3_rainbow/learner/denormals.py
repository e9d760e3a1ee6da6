"""Treats denormal numbers as zero while the networks learn."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

# A normal number, whatever the mode at import, whose tenth is denormal
_SMALL = 3e-308


@contextmanager
def flush_denormals() -> Iterator[None]:
    """Compute with denormal numbers as with zero in this thread; the setting is restored after.

    Atoms far from a sharp distribution have probabilities and gradients below 1e-38, where float32
    becomes denormal and many processors take a hundred cycles a product. No value that matters is
    so small. Torch's worker threads are not reached: ``torch.set_num_threads(1)`` gives the full
    effect. Without effect where the processor has no such mode.
    """
    changes = _SMALL * 0.1 != 0.0 and th.set_flush_denormal(True)
    try:
        yield
    finally:
        if changes:
            th.set_flush_denormal(False)
