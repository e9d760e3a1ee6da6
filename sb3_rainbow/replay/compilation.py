"""How kernels compile: without a cache on disk where none can be kept, and never unsaid."""

import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numba
from numba.core import event

_PACKAGE = __name__.partition(".")[0]
# Nobody wonders about less, in seconds.
_NOTICED = 1.5


class _Stopwatch(event.Listener):
    """Seconds in which this package's kernels compiled; to load them from the cache is none."""

    seconds = 0.0
    cached = True
    _depth = 0
    _started = 0.0

    def notify(self, event: Any) -> None:
        if event.data["dispatcher"].py_func.__module__.startswith(f"{_PACKAGE}."):
            super().notify(event)

    def on_start(self, event: Any) -> None:
        # A kernel compiles those that it calls on the way: the outermost counts.
        if self._depth == 0:
            self._started = perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += perf_counter() - self._started


_stopwatch = _Stopwatch()
event.register("numba:compile", _stopwatch)


def njit(**options: Any) -> Callable[[Callable], Any]:
    """numba's ``njit``, which alone would raise where no folder for its cache can be written."""

    def decorate(function: Callable) -> Any:
        try:
            compiled = numba.njit(**options)(function)
            if hasattr(compiled, "stats"):
                # For sources in an archive numba itself does not look before the first call.
                os.makedirs(compiled.stats.cache_path, exist_ok=True)
            return compiled
        except (OSError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "no locator available" not in str(error):
                raise
            _stopwatch.cached = False
            return numba.njit(**{**options, "cache": False})(function)

    return decorate


def report_compilation() -> None:
    """Say on stderr how long kernels have compiled since the last report, if anyone noticed."""
    if _stopwatch.seconds < _NOTICED:
        return
    again = (
        "once after an install: from now on they come from numba's cache"
        if _stopwatch.cached
        else "in every process anew, as no folder for numba's cache can be written: set "
        "NUMBA_CACHE_DIR to one that can"
    )
    seconds, _stopwatch.seconds = _stopwatch.seconds, 0.0
    print(f"{_PACKAGE}: compiled kernels in {seconds:.1f} s, {again}", file=sys.stderr)
