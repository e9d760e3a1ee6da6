"""The kernels' matrix products run on one thread, and leave the setting as they found it."""

import subprocess
import sys

_PROGRAM = """
from sb3_rainbow.fast.blas import _libraries, single_blas_thread
for library in _libraries():
    library.set_num_threads(2)
before = [library.get_num_threads() for library in _libraries()]
with single_blas_thread():
    inside = [library.get_num_threads() for library in _libraries()]
print(set(inside) <= {1}, before == [library.get_num_threads() for library in _libraries()])
"""


def test_one_thread_inside_and_the_old_number_after() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout.split()[:2] == ["True", "True"]
