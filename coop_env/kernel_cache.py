"""Keep numba's on-disk cache honest across modules.

numba recompiles a cached kernel when its own file changes, but not when a kernel that it calls from
another file does, so an edited formula would go on living in its callers' caches.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


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
            if "from numba import" in f.read_text("utf-8")
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
