"""One thread for the compiled kernels' matrix products."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import LibController, ThreadpoolController


@lru_cache(maxsize=1)
def _libraries() -> list[LibController]:
    import scipy.linalg.cython_blas  # noqa: F401  # whose BLAS numba uses: it has to be loaded

    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Keep BLAS, which numba's matrix products use, to one thread.

    The products of a small network are over before a second thread has started, and on a busy
    machine waiting for it takes many times as long as the product. (threadpoolctl's own ``limit``
    asks each library for all that it knows, which takes ten times as long.)
    """
    changed = [(each, n) for each in _libraries() if (n := each.get_num_threads()) != 1]
    for library, _ in changed:
        library.set_num_threads(1)
    try:
        yield
    finally:
        for library, n in changed:
            library.set_num_threads(n)
