"""One thread for the compiled kernels' matrix products."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import scipy


@lru_cache(maxsize=1)
def _thread_controls() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Getter and setter of the thread count of SciPy's own OpenBLAS; None where it has another."""
    folder = Path(scipy.__file__).resolve().parent
    for path in [*folder.parent.glob("scipy.libs/*openblas*"), *folder.glob(".dylibs/*openblas*")]:
        try:
            library = ctypes.CDLL(str(path))
        except OSError:
            continue
        for prefix in ("scipy_", ""):
            getter = getattr(library, f"{prefix}openblas_get_num_threads", None)
            setter = getattr(library, f"{prefix}openblas_set_num_threads", None)
            if getter is not None and setter is not None:
                return getter, setter
    return None


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """
    Keep SciPy's BLAS, which numba's matrix products use, to one thread.

    The products of a small network are over before a second thread has started, and on a busy
    machine waiting for it takes many times as long as the product.
    """
    controls = _thread_controls()
    if controls is None:
        yield
        return
    getter, setter = controls
    before = getter()
    if before == 1:
        yield
        return
    setter(1)
    try:
        yield
    finally:
        setter(before)
