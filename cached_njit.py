"""numba's ``njit``, announced on stderr, with a cache that is never stale and never needed.

numba compiles a cached kernel anew when its own file changes, but not when a kernel that it calls
from another file does. ``coop_env`` and ``sb3_rainbow`` use this module, and not each other.
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

_DECLARES = re.compile(r"^from .* import .*\b(njit|intrinsic)$", re.MULTILINE)


class _Announcer(event.Listener):
    """Says, once a process, that a package's kernels begin to compile."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.again = "once after an install: then they come from numba's cache"

    def on_start(self, event: Any) -> None:
        # A function made by exec, as numba makes some itself, has no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if self.again and module.startswith(f"{self.package}."):
            cost = f"compiling kernels ({sys.modules[self.package]._KERNELS} of a processor core)"
            print(f"{self.package}: {cost}, {self.again}", file=sys.stderr, flush=True)
            self.again = ""

    def on_end(self, event: Any) -> None:
        pass


@cache
def _newest_kernel(folder: Path, pattern: str) -> float:
    """When the last of a folder's files that declare kernels was changed."""
    kernels = (f for f in folder.glob(pattern) if re.search(_DECLARES, f.read_text("utf-8")))
    return max((f.stat().st_mtime for f in kernels), default=0.0)


def _dispatcher(
    announcer: _Announcer, function: Callable, options: dict[str, Any], suffix: str = ""
) -> Any:
    """numba's, whose cache is of now: older than no kernel that this one may call.

    Those are its neighbours and the package's. ``suffix`` goes to the names of the cache's files.
    """
    try:
        compiled = numba.njit(**options)(function)
        stats = getattr(compiled, "stats", None)  # none under NUMBA_DISABLE_JIT
        if stats and stats.cache_path:
            # for sources in an archive numba looks later
            os.makedirs(stats.cache_path, exist_ok=True)
            own = _newest_kernel(Path(function.__code__.co_filename).parent, "*.py")
            package = Path(str(sys.modules[announcer.package].__file__)).parent
            kept = compiled._cache
            stamp = kept._cache_file._source_stamp, own, _newest_kernel(package, "**/*.py")
            base = kept._impl.filename_base + suffix
            kept._cache_file = IndexDataCacheFile(stats.cache_path, base, stamp)
        return compiled
    except (OSError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "no locator available" not in str(error):
            raise
        if announcer.again:  # has not been said
            announcer.again = (
                "in every process anew, as no folder for numba's cache can be written: set "
                "NUMBA_CACHE_DIR to one that can"
            )
        return numba.njit(**{**options, "cache": False})(function)


def njit_of(package: str) -> Callable[..., Callable[[Callable], Any]]:
    """numba's ``njit`` for the kernels of a package, and for those that call them.

    They are cached where a folder for that can be written, with one signature for all constants.
    Other kernels call a twin that Python cannot call: an entry from Python takes long to compile,
    and most kernels never need one. The package's ``_KERNELS`` says what compiling them all costs.
    """
    announcer = _Announcer(package)
    event.register("numba:compile", announcer)

    def njit(**options: Any) -> Callable[[Callable], Any]:
        options["no_cfunc_wrapper"] = True  # an entry from C, which nobody needs

        def decorate(function: Callable) -> Any:
            compiled = _dispatcher(announcer, function, options)

            @cache
            def twin() -> Any:
                inner = {**options, "no_cpython_wrapper": True}
                return _dispatcher(announcer, function, inner, ".inner")

            def get_call_template(args: Any, kws: Any) -> Any:
                named = {name: types.unliteral(kind) for name, kind in dict(kws).items()}
                return twin().get_call_template([types.unliteral(kind) for kind in args], named)

            # of what numba asks a kernel for where another one calls it
            compiled.get_call_template = get_call_template
            compiled.get_overload = lambda kinds: twin().get_overload(kinds)
            return compiled

        return decorate

    return njit
