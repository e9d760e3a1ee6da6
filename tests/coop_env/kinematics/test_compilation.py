"""A cached kernel must not outlive a change of a kernel that it calls."""

from __future__ import annotations

import os
from pathlib import Path

from coop_env.compilation import drop_stale_kernels


def test_indices_older_than_a_kernel_are_dropped(tmp_path: Path) -> None:
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    kernel, plain = tmp_path / "kernel.py", tmp_path / "plain.py"
    kernel.write_text("from numba import njit\n")
    plain.write_text("x = 1\n")
    old, new = cache / "old.nbi", cache / "new.nbi"
    for path, time in ((old, 100), (kernel, 200), (new, 300), (plain, 400)):
        path.touch()
        os.utime(path, (time, time))
    assert drop_stale_kernels(tmp_path, tmp_path) == 1
    assert not old.exists()
    assert new.exists()
    assert drop_stale_kernels(tmp_path, tmp_path) == 0
