"""The kernels' matrix products run on one thread, and leave the setting as they found it."""

import subprocess
import sys

_PROGRAM = """
import scipy.linalg
from sb3_rainbow.fast.blas import _thread_controls, single_blas_thread
controls = _thread_controls()
if controls is None:
    print("no OpenBLAS of SciPy's own")
else:
    getter, setter = controls
    setter(2)
    with single_blas_thread():
        inside = getter()
    print(inside, getter())
"""


def test_one_thread_inside_and_the_old_number_after() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() in ("1 2", "no OpenBLAS of SciPy's own")
