"""numba's ``njit`` with an announcement, and a cache on disk that is never stale.

numba recompiles a cached kernel when its own file changes, but not when a kernel that it calls from
another file does.
"""

import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event

_PACKAGE = __name__.partition(".")[0]
_DECLARES = re.compile(r"^from .* import .*\bnjit$", re.MULTILINE)
# What compiles, and how long that takes
_WHAT = "replay, networks and updates: about 10 s of a processor core"


class _Announcer(event.Listener):
    """Says on stderr, once a process, that this package's kernels begin to compile."""

    cached = True
    _said = False

    def on_start(self, event: Any) -> None:
        # A function made by exec, such as numba's own constructors of jitclasses, has no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if self._said or not module.startswith(f"{_PACKAGE}."):
            return
        self._said = True
        again = (
            "once after an install: then they come from numba's cache"
            if self.cached
            else "in every process anew, as no folder for numba's cache can be written: set "
            "NUMBA_CACHE_DIR to one that can"
        )
        print(f"{_PACKAGE}: compiling kernels ({_WHAT}), {again}", file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        pass


_announcer = _Announcer()
event.register("numba:compile", _announcer)


_looked: set[Path] = set()


@cache
def _newest_kernel(folder: Path, pattern: str) -> float:
    kernels = (f for f in folder.glob(pattern) if re.search(_DECLARES, f.read_text("utf-8")))
    return max((f.stat().st_mtime for f in kernels), default=0.0)


def _drop_stale_beside(function: Callable) -> None:
    """Delete the cached kernels of this one's folder older than any that they may call.

    Those are its neighbours and this package's. Safe beside other processes: numba takes a missing
    cache file for a kernel never compiled.
    """
    folder, package = Path(function.__code__.co_filename).parent, Path(__file__).parent.parent
    if folder in _looked:
        return
    _looked.add(folder)
    with suppress(OSError, RuntimeError):  # no folder can be written, so none is read
        # which of its places numba takes depends on the environment, HOME and permissions
        cached = Path(str(numba.njit(cache=True)(function).stats.cache_path))
        newest = max(_newest_kernel(package, "**/*.py"), _newest_kernel(folder, "*.py"))
        for index in cached.glob("*.nbi"):
            with suppress(FileNotFoundError):  # another process was first
                if index.stat().st_mtime < newest:
                    index.unlink()


def njit(**options: Any) -> Callable[[Callable], Any]:
    """numba's ``njit``, which alone would raise where no folder for its cache can be written."""

    def decorate(function: Callable) -> Any:
        _drop_stale_beside(function)
        try:
            compiled = numba.njit(**options)(function)
            if hasattr(compiled, "stats"):
                # For sources in an archive numba itself does not look before the first call.
                os.makedirs(compiled.stats.cache_path, exist_ok=True)
            return compiled
        except (OSError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and "no locator available" not in str(error):
                raise
            _announcer.cached = False
            return numba.njit(**{**options, "cache": False})(function)

    return decorate
