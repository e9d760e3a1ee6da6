"""The shortcuts can be deleted, as processes of their own show, and run on one thread."""

import shutil
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import sb3_rainbow
from sb3_rainbow.fast.mlp_update import blas_libraries, single_blas_thread
from tests.process import python

_PROGRAM = """
import sys
# An installation for development would look for what is missing here in its own folder.
sys.meta_path[:] = [f for f in sys.meta_path if "editable" not in getattr(f, "__module__", "")]
import numpy as np, torch as th
import sb3_rainbow
from sb3_rainbow import Rainbow
model = Rainbow(
    "MlpPolicy", "CartPole-v1", learning_starts=20, train_freq=4, gradient_steps=1, batch_size=8,
    buffer_size=500, learning_rate=1e-4,
    policy_kwargs={"net_arch": [24, 16], "optimizer_kwargs": {"eps": 1e-2}}, seed=0, device="cpu",
).learn(80)
assert model._n_updates == 15
print(sb3_rainbow.__file__, model._learner.shortcuts is None)
weights = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().numpy()
model.save(sys.argv[1] + ".zip")
Rainbow.load(sys.argv[1] + ".zip", env=model.get_env()).learn(40)
np.save(sys.argv[1], weights)
"""


def test_without_the_folder(tmp_path: Path) -> None:
    package = Path(sb3_rainbow.__file__).parent
    shutil.copytree(package, tmp_path / "sb3_rainbow", ignore=lambda *_: ["fast", "__pycache__"])
    weights = []
    for root, without in ((tmp_path, True), (package.parent, False)):
        file = str(tmp_path / f"{without}.npy")
        places = {"PYTHONPATH": str(root), "NUMBA_DISABLE_JIT": str(int(without))}
        done = python("-c", _PROGRAM, file, cwd=root, env=places)
        assert done.stdout.split() == [str(root / "sb3_rainbow/__init__.py"), str(without)]
        weights.append(np.load(tmp_path / f"{without}.npy"))
    np.testing.assert_allclose(weights[0], weights[1], rtol=1e-4, atol=1e-5)


def test_one_thread_inside_and_the_old_number_after() -> None:
    def threads() -> list[int]:
        return [library.get_num_threads() for library in blas_libraries()]

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with single_blas_thread():
            inside = threads()
        assert set(inside) == {1}
        assert threads() == before
