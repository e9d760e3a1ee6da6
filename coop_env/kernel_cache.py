"""Keep numba's on-disk cache honest across modules and processes.

numba recompiles a cached kernel when its own file changes, but not when a kernel that it calls from
another file does, so an edited formula would go on living in its callers' caches.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock


def drop_stale_kernels(folder: Path, sources: Path) -> int:
    """Delete the cache indices below ``folder`` that are older than a kernel below ``sources``.

    Safe beside other processes: numba takes a missing cache file for a kernel never compiled.

    Returns:
        The number of indices deleted.
    """
    newest = max(
        (
            f.stat().st_mtime
            for f in sources.rglob("*.py")
            if re.search(r"^from .* import .*\bnjit$", f.read_text("utf-8"), re.MULTILINE)
        ),
        default=0.0,
    )
    dropped = 0
    for index in folder.rglob("__pycache__/*.nbi"):
        with suppress(OSError):  # another process may have deleted it first, or it is read-only
            if index.stat().st_mtime < newest:
                index.unlink()
                dropped += 1
    return dropped


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
