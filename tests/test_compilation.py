"""Both packages right after an install, and where nothing can be written."""

import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numba
import pytest
from numba.core import event

import cached_njit
import coop_env
import sb3_rainbow
from coop_env.compilation import njit
from tests.process import ROOT, python

# Says when numba compiles for the first time.
BEGINS = """
import sys
from numba.core import dispatcher
compile = dispatcher._FunctionCompiler.compile
def told(*arguments):
    dispatcher._FunctionCompiler.compile = compile
    print("numba begins compiling", file=sys.stderr)
    return compile(*arguments)
dispatcher._FunctionCompiler.compile = told
"""
KINEMATICS = """
import numpy as np
import coop_env.env
from coop_env.kinematics import delta
print(delta.inverse(np.array([0.0, 0.0, -0.5])).theta.sum().round(9))
"""


def run(*argv: str, **environment: str) -> CompletedProcess[str]:
    """A process that knows no cache but the one it is told of, and compiles faster."""
    unset = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    kept = {name: value for name, value in os.environ.items() if name not in unset}
    places = {"PYTHONPATH": str(ROOT), "NUMBA_OPT": "1", **environment}
    return python(*argv, env={**kept, **places}, cwd="/")  # not where this clone is


def announcements(done: CompletedProcess[str]) -> list[str]:
    """What a process says about compilation."""
    return [line for line in done.stderr.splitlines() if "compiling" in line]


def test_a_cold_cache_is_announced_once_and_first_and_is_sound(tmp_path: Path) -> None:
    """Also where two processes fill it at once; one that starts late may find it filled."""

    def start(code: str) -> CompletedProcess[str]:
        return run("-c", code, NUMBA_CACHE_DIR=str(tmp_path))

    with ThreadPoolExecutor(2) as pool:
        cold = [*pool.map(start, [BEGINS + KINEMATICS] * 2)]
    warm = start(KINEMATICS)
    announced = [lines for done in cold if (lines := announcements(done))]
    assert announced
    for report, begins in announced:
        assert report.startswith("coop_env: compiling kernels (")
        assert report.endswith(
            " of a processor core), once after an install: then they come from numba's cache"
        )
        assert begins == "numba begins compiling"
    assert {done.stdout for done in cold} == {warm.stdout}
    assert announcements(warm) == []


@pytest.mark.parametrize("archived", [False, True])
def test_where_nothing_can_be_written(tmp_path: Path, archived: bool) -> None:
    # Root may write into every folder, but not into an archive, nor below a file.
    place = tmp_path / "packages"
    without = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "coop_env", place / "coop_env", ignore=without)
    for source in [*place.rglob("*.py")]:
        (source.parent / "__pycache__").touch()
    if archived:
        place = Path(shutil.make_archive(str(place), "zip", place))
    (report,) = announcements(run("-c", KINEMATICS, PYTHONPATH=str(place), HOME=os.devnull))
    assert report.startswith("coop_env: compiling kernels (")
    assert report.endswith("set NUMBA_CACHE_DIR to one that can")


def test_other_errors_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: object) -> None:
        raise RuntimeError("something else")

    monkeypatch.setattr(numba.core.dispatcher.Dispatcher, "enable_caching", fail)
    with pytest.raises(RuntimeError, match="something else"):
        njit(cache=True)(lambda x: x)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_cached_kernel_does_not_outlive_a_change_of_one_that_it_calls(
    elsewhere: bool, tmp_path: Path
) -> None:
    """Neither beside its source nor where NUMBA_CACHE_DIR says; what did not change is kept."""
    called, caller = tmp_path / "called.py", tmp_path / "caller.py"
    called.write_text(
        "from coop_env.compilation import njit\n@njit(cache=True)\ndef f(): return 1\n"
    )
    caller.write_text(
        "from called import f\nfrom coop_env.compilation import njit\n@njit(cache=True)\n"
        "def g(): return f()\nprint(g(), sum(g.stats.cache_hits.values()))\n"
    )
    places = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")} if elsewhere else {}

    def report() -> list[str]:
        return run(str(caller), **places).stdout.split()

    assert report() == ["1", "0"]
    assert report() == ["1", "1"]
    called.write_text(called.read_text().replace("return 1", "return 2"))
    assert report() == ["2", "0"]


def test_functions_without_a_module_compile_beside_the_package() -> None:
    """Which listens to whatever numba compiles."""
    names: dict[str, object] = {}
    exec("def double(x): return 2 * x", names)
    compiled: Any = numba.njit(names["double"])
    assert compiled(3) == 6


def test_a_kernel_compiles_once_for_all_constants_that_others_pass_to_it() -> None:
    def inner(x: float, k: int) -> float:
        return x * k

    compiled: Any = njit()(inner)

    def outer(x: float) -> Any:
        return compiled(x, 0) + compiled(x, 1) + compiled(x, k=2)

    calls: Any = numba.njit(outer)
    with event.install_recorder("numba:compile") as recorder:
        assert calls(3.0) == 9.0
    begun = [e.data["dispatcher"].py_func for _, e in recorder.buffer if e.is_start]
    assert begun.count(inner) == 1
    assert compiled(3.0, 2) == 6.0  # and from Python


def test_both_packages_say_what_their_kernels_cost() -> None:
    """What is announced asks them for it, and is tried above with one of them."""
    assert all(re.search(r": .*(s|minute)$", p._KERNELS) for p in (coop_env, sb3_rainbow))


def test_what_kernels_inline_is_looked_at_for_changes_too() -> None:
    """An intrinsic lives on in its callers' caches as a kernel does."""
    sources = ROOT / "coop_env" / "simulation"
    assert cached_njit._newest_kernel(sources, "task.py") > 0.0
    assert cached_njit._newest_kernel(sources, "insertion_task.py") == 0.0
