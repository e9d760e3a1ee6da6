"""Several processes may start at once with nothing compiled yet."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CALL = """
import numpy as np
from coop_env.geometry import OPTIMIZED
from coop_env.kinematics import delta, rrs
print(delta.jacobian(np.array([0.0, 0.0, -0.5])).sum().round(9))
print(rrs.signed_sigma_min(np.array([0.1, 0.2, 0.22]), OPTIMIZED).round(9))
"""


def _start(cache: Path) -> subprocess.Popen[str]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "NUMBA_OPT": "1"}  # compiles faster
    return subprocess.Popen(
        [sys.executable, "-c", CALL], env=environment, stdout=subprocess.PIPE, text=True
    )


def test_processes_that_compile_at_once_leave_a_sound_cache(tmp_path: Path) -> None:
    """numba keeps a gufunc's kernel and its wrapper in two files: mixed up, they crash."""
    first = [_start(tmp_path) for _ in range(2)]
    printed = [process.communicate(timeout=200)[0] for process in first]
    later = _start(tmp_path)
    printed.append(later.communicate(timeout=200)[0])
    assert [process.returncode for process in [*first, later]] == [0, 0, 0]
    assert len(set(printed)) == 1
