"""numba's ``njit``, announced on stderr, with a cache that is never stale and never needed.

numba compiles a cached kernel anew when its own file changes, but not when a kernel that it calls
from another file does. This file stands in both packages; a test holds that it is the same.
"""

import os
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event, types
from numba.core.caching import IndexDataCacheFile

PACKAGE = __name__.partition(".")[0]
_DECLARES = re.compile(r"^from .* import .*\b(njit|intrinsic)$", re.MULTILINE)


class _Announcer(event.Listener):
    """Says, once a process, that this package's kernels begin to compile."""

    again = "once after an install: then they come from numba's cache"

    def on_start(self, event: Any) -> None:
        # A function made by exec, as numba makes some itself, has no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if self.again and module.startswith(f"{PACKAGE}."):
            cost = f"compiling kernels ({sys.modules[PACKAGE]._KERNELS} of a processor core)"
            print(f"{PACKAGE}: {cost}, {self.again}", file=sys.stderr, flush=True)
            self.again = ""

    def on_end(self, event: Any) -> None:
        pass


_announcer = _Announcer()
event.register("numba:compile", _announcer)


@cache
def _newest_kernel(folder: Path, pattern: str) -> float:
    """When the last of a folder's files that declare kernels was changed."""
    kernels = (f for f in folder.glob(pattern) if re.search(_DECLARES, f.read_text("utf-8")))
    return max((f.stat().st_mtime for f in kernels), default=0.0)


def _dispatcher(function: Callable, options: dict[str, Any], suffix: str = "") -> Any:
    """numba's, whose cache is of now: older than no kernel that this one may call.

    Those are its neighbours and this package's. ``suffix`` goes to the names of the cache's files.
    """
    try:
        compiled = numba.njit(**options)(function)
        stats = getattr(compiled, "stats", None)  # none under NUMBA_DISABLE_JIT
        if stats and stats.cache_path:
            # for sources in an archive numba looks later
            os.makedirs(stats.cache_path, exist_ok=True)
            own = _newest_kernel(Path(function.__code__.co_filename).parent, "*.py")
            package = Path(str(sys.modules[PACKAGE].__file__)).parent
            kept = compiled._cache
            stamp = kept._cache_file._source_stamp, own, _newest_kernel(package, "**/*.py")
            base = kept._impl.filename_base + suffix
            kept._cache_file = IndexDataCacheFile(stats.cache_path, base, stamp)
        return compiled
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "no locator available" not in str(error):
            raise
        if _announcer.again:  # has not been said
            _announcer.again = (
                "in every process anew, as no folder for numba's cache can be written: set "
                "NUMBA_CACHE_DIR to one that can"
            )
        return numba.njit(**{**options, "cache": False})(function)


def njit(**options: Any) -> Callable[[Callable], Any]:
    """numba's, cached where a folder for that can be written; one signature for all constants.

    Other kernels call a twin that Python cannot call. An entry from Python takes long to compile,
    and most kernels never need one.
    """
    options["no_cfunc_wrapper"] = True  # an entry from C, which nobody needs

    def decorate(function: Callable) -> Any:
        compiled = _dispatcher(function, options)

        @cache
        def twin() -> Any:
            return _dispatcher(function, {**options, "no_cpython_wrapper": True}, ".inner")

        def get_call_template(args: Any, kws: Any) -> Any:
            named = {name: types.unliteral(kind) for name, kind in dict(kws).items()}
            return twin().get_call_template([types.unliteral(kind) for kind in args], named)

        # of what numba asks a kernel for where another one calls it
        compiled.get_call_template = get_call_template
        compiled.get_overload = lambda kinds: twin().get_overload(kinds)
        return compiled

    return decorate
