"""Checks of a replay buffer's parameters, and of its memory."""

import warnings
from numbers import Integral, Real
from typing import Any


def check_counts(**values: Any) -> None:
    """Raise ``ValueError`` for the first value that is no integer from 1 on, by its name."""
    for name, value in values.items():
        if not isinstance(value, Integral) or value < 1:
            raise ValueError(f"{name} must be an integer, at least 1, got {value!r}")


def check_numbers(**values: Any) -> None:
    """Raise ``ValueError`` for the first value that is no number, by its name."""
    for name, value in values.items():
        if not isinstance(value, Real):
            raise ValueError(f"{name} must be a number, got {value!r}")


def check_shares(**values: Any) -> None:
    """Raise ``ValueError`` for the first value that is no number in [0, 1], by its name."""
    for name, value in values.items():
        if not (isinstance(value, Real) and 0.0 <= float(value) <= 1.0):
            raise ValueError(f"{name} must lie in [0, 1], got {value!r}")


def check_buffer_size(buffer_size: int, n_envs: int, n_steps: int) -> None:
    """Raise ``ValueError`` for a buffer in which not even one window of each env fits."""
    check_counts(buffer_size=buffer_size)
    if buffer_size < smallest_buffer(n_envs, n_steps):
        raise ValueError(
            f"buffer_size={buffer_size} is too small: {n_envs} envs with n_steps={n_steps} need "
            f"at least {smallest_buffer(n_envs, n_steps)}"
        )


def smallest_buffer(n_envs: int, n_steps: int) -> int:
    """Transitions of one window per env, and of the observation that it leads to."""
    return n_envs * (n_steps + 1)


def warn_of_memory(n_bytes: int) -> None:
    """Warn, as SB3's buffers do, where a full buffer of so many bytes exceeds the free memory."""
    try:
        from psutil import virtual_memory
    except ImportError:  # an extra of SB3's, which goes without the warning too
        return
    free = virtual_memory().available
    if n_bytes > free:
        warnings.warn(
            "This system does not have apparently enough memory to store the complete replay "
            f"buffer {n_bytes / 1e9:.2f}GB > {free / 1e9:.2f}GB",
            stacklevel=3,
        )
