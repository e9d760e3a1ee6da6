"""The shortcuts can be deleted, as processes of their own show, and run on one thread."""

import shutil
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from sb3_rainbow.fast.mlp_update import blas_libraries, single_blas_thread
from tests.process import ROOT, python

_PROGRAM = """
import sys
# An installation for development would look for what is missing here in its own folder.
sys.meta_path[:] = [f for f in sys.meta_path if "editable" not in getattr(f, "__module__", "")]
import sb3_rainbow
settings = {"buffer_size": 500, "batch_size": 8, "device": "cpu"}
model = sb3_rainbow.Rainbow("MlpPolicy", "CartPole-v1", **settings).learn(140)
assert model._learner.shortcuts is None
model.save("model")
sb3_rainbow.Rainbow.load("model", env=model.get_env()).learn(140)
print(sb3_rainbow.__file__, model._n_updates)
"""


@pytest.mark.slow
def test_without_the_folder(tmp_path: Path) -> None:
    package = tmp_path / "sb3_rainbow"
    without = shutil.ignore_patterns("fast", "__pycache__")
    shutil.copytree(ROOT / "sb3_rainbow", package, ignore=without)
    shutil.copy(ROOT / "cached_njit.py", tmp_path)
    places = {"PYTHONPATH": str(tmp_path), "NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1"}
    done = python("-c", _PROGRAM, cwd=tmp_path, env=places)
    assert done.stdout.split() == [str(package / "__init__.py"), "40"]


def test_one_thread_inside_and_the_old_number_after() -> None:
    def threads() -> list[int]:
        return [library.get_num_threads() for library in blas_libraries()]

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with single_blas_thread():
            inside = threads()
        assert set(inside) == {1}
        assert threads() == before
