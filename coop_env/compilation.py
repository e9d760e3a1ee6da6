"""How kernels compile: never unsaid, with an honest cache on disk, or without where none can be.

numba recompiles a cached kernel when its own file changes, but not when a kernel that it calls from
another file does, so an edited formula would go on living in its callers' caches.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba.core import event, types

_DECLARES = re.compile(r"^from .* import .*\b(njit|intrinsic)$", re.MULTILINE)
# What compiles, and how long that takes
_WHAT = "kinematics, collisions, moves: up to a minute of a processor core"


class _Announcer(event.Listener):
    """Says on stderr that this package's kernels begin to compile, once a process.

    numba tells of compilations alone: what comes from its cache is none.
    """

    cached = True
    _said = False

    def on_start(self, event: Any) -> None:
        # A function made by exec, such as numba's own constructors of jitclasses, has no module.
        module = event.data["dispatcher"].py_func.__module__ or ""
        if self._said or not module.startswith(f"{__package__}."):
            return
        self._said = True
        again = (
            "once after an install: then they come from numba's cache"
            if self.cached
            else "in every process anew, as no folder for numba's cache can be written: set "
            "NUMBA_CACHE_DIR to one that can"
        )
        print(f"{__package__}: compiling kernels ({_WHAT}), {again}", file=sys.stderr, flush=True)

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
    folder, package = Path(function.__code__.co_filename).parent, Path(__file__).parent
    if folder in _looked:
        return
    _looked.add(folder)
    with suppress(OSError, RuntimeError):  # no folder can be written, so none is read
        # which of its places numba takes depends on the environment, HOME and permissions
        kept = Path(str(numba.njit(cache=True)(function).stats.cache_path))
        newest = max(_newest_kernel(package, "**/*.py"), _newest_kernel(folder, "*.py"))
        for index in kept.glob("*.nbi"):
            with suppress(FileNotFoundError):  # another process was first
                if index.stat().st_mtime < newest:
                    index.unlink()


def _cached_where_possible(decorator: Any) -> Any:
    """One of numba's, which alone would raise where no folder for its cache can be written."""

    def with_options(*arguments: Any, **options: Any) -> Callable[[Callable], Any]:
        def decorate(function: Callable) -> Any:
            _drop_stale_beside(function)
            try:
                compiled = decorator(*arguments, **options)(function)
                if hasattr(compiled, "stats"):
                    # For sources in an archive numba itself does not look before the first call.
                    os.makedirs(compiled.stats.cache_path, exist_ok=True)
                return compiled
            except (OSError, RuntimeError) as error:
                if isinstance(error, RuntimeError) and "no locator available" not in str(error):
                    raise
                _announcer.cached = False
                return decorator(*arguments, **{**options, "cache": False})(function)

        return decorate

    return with_options


def _njit(**options: Any) -> Callable[[Callable], Any]:
    """numba's, but kernels do not compile anew for each constant that one passes to another."""

    def decorate(function: Callable) -> Any:
        compiled = numba.njit(**options)(function)
        template = compiled.get_call_template

        def get_call_template(args: Any, kws: Any) -> Any:
            named = {name: types.unliteral(kind) for name, kind in dict(kws).items()}
            return template([types.unliteral(kind) for kind in args], named)

        compiled.get_call_template = get_call_template
        return compiled

    return decorate


njit = _cached_where_possible(_njit)
guvectorize = _cached_where_possible(numba.guvectorize)


@contextmanager
def compiling_alone() -> Iterator[None]:
    """Let one process at a time import the modules that compile gufuncs.

    numba caches a gufunc in two files, kernel and wrapper, written one after the other. Of two
    processes that compile it at once, one may leave the kernel and the other the wrapper, and
    whoever loads that pair crashes, until the cache is deleted by hand.
    """
    user = os.getuid() if hasattr(os, "getuid") else getpass.getuser()
    owner = f"{user}:{Path(__file__).resolve()}"
    name = hashlib.sha256(owner.encode()).hexdigest()[:16]
    with FileLock(Path(tempfile.gettempdir()) / f"coop_env-{name}.lock"):
        yield
