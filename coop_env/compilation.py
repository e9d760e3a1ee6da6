"""numba's ``njit`` for this package's kernels."""

from cached_njit import njit_of

njit = njit_of("coop_env")
