"""What an install brings: the two packages, and what the README and the pages need besides."""

import configparser
import importlib.metadata as metadata
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from benchmarks.runs.backends import spawn
from tests.process import ROOT, python
from tests.test_docs import python_blocks

SHIPPED = ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "cached_njit.py")
PACKAGES = ("sb3_rainbow", "coop_env", "benchmarks")
README = (ROOT / "README.md").read_text(encoding="utf-8")
WITHOUT_THEM = """
import sys
class Without:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, *where):
        return None if name.split(".")[0] in MISSING else self.finder.find_spec(name, *where)
sys.meta_path[:] = map(Without, sys.meta_path)
"""
# What a page's install line brings runs the page's commands: nothing else can be imported here.
# Without an extra that is every module but those for pictures (`render`), MuJoCo (`physics`),
# PettingZoo (`team`), `trajectory` and `zoo`, and then the README's blocks.
ON_EXTRAS = {
    "": """
import importlib, pkgutil
import coop_env, sb3_rainbow
for package in (sb3_rainbow, coop_env):
    # a package that needs an extra says so when it is imported, and is left out below
    walked = pkgutil.walk_packages(package.__path__, package.__name__ + ".", lambda name: None)
    for module in walked:
        extras = ("coop_env.rendering.", "coop_env.physics.", "coop_env.exports", "coop_env.team.p")
        if not module.name.startswith((*extras, "sb3_rainbow.zoo.")):
            importlib.import_module(module.name)
for block in BLOCKS:
    exec(block, {})
""",
    "benchmarks": """
from benchmarks.cli import main
for cell in ("rainbow-optimized-safe-s0", "rrt_connect-optimized-s0"):
    assert main(["train", "--preset", "smoke", "--results", OUT, "--cell", cell]) == 0
assert main(["tables", "--preset", "smoke", "--results", OUT]) == 0
""",
    "benchmarks,classic": """
from benchmarks.protocol.presets import load_suite
from benchmarks.studies.classic.train import build_model
for preset in ("control", "minatar", "changes", "atari100k"):
    tasks = load_suite(preset).tasks.values()
    for task in {task.env.partition("/")[0]: task for task in tasks}.values():  # one of a package
        build_model(task, "rainbow", 0)
""",
    "zoo": """
import gymnasium
import sb3_rainbow.zoo.registration
env = gymnasium.make("CartPole-v1", render_mode="rgb_array")  # which `enjoy` shows
env.reset()
env.render()
""",
}


def test_all_say_the_same_pythons() -> None:
    metadata_text = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    named = re.findall(r"Python :: 3\.(\d+)", metadata_text)
    allowed: Any = re.search(r"python_requires = (.*)", metadata_text)
    assert named == [str(n) for n in range(30) if f"3.{n}.1" in SpecifierSet(allowed[1])]
    first, last = named[0], named[-1]
    assert f"Python 3.{first} to 3.{last}" in README
    for text in ("setup.cfg", "Makefile"):
        assert re.search(rf"3\D+{first}\D", (ROOT / text).read_text("utf-8"))


def test_make_refuses_another_python_in_one_line(tmp_path: Path) -> None:
    """A python that is too new by its own word: make has nothing else to go by."""
    pretender = tmp_path / "python3.14"
    code = "import sys; sys.version_info = 3, 14, 0; exec(sys.argv[1])"
    pretender.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{code}' \"$2\"\n", "utf-8")
    pretender.chmod(0o755)
    argv = ["make", "env", f"PYTHON={pretender}", f"VENV={tmp_path / 'venv'}"]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if not line.startswith("make")]
    assert len(lines) == 1
    assert "Python 3.11 to 3.13 is needed" in lines[0]
    assert "is 3.14" in lines[0]
    assert not (tmp_path / "venv").exists()


def test_the_env_needs_nothing_that_draws_or_learns() -> None:
    """Matplotlib and Pillow are of the extra ``render``; without it there are no pictures alone."""
    heavy = {"matplotlib", "PIL", "torch"}
    python("-c", f"import sys, coop_env.env; assert not {heavy} & {{*sys.modules}}", cwd=ROOT)


def needed(requirements: list[str]) -> set[str]:
    """Names of the distributions that these requirements come to, extras only where asked for."""
    seen: set[tuple[str, ...]] = set()
    left = [(Requirement(text), {""}) for text in requirements]
    while left:
        need, extras = left.pop()
        applies = not need.marker or any(need.marker.evaluate({"extra": e}) for e in extras)
        if applies and (need.name, *need.extras) not in seen:
            seen.add((need.name, *need.extras))
            asked = need.extras or {""}
            left += [(Requirement(text), asked) for text in metadata.requires(need.name) or []]
    return {canonicalize_name(name) for name, *_ in seen}


def not_brought_by(extras: str) -> set[str]:
    """The modules installed here that an install of those extras alone would not bring."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    lists = [setup["options"]["install_requires"]]
    lists += [setup["options.extras_require"][extra] for extra in extras.split(",") if extra]
    brought = needed("".join(lists).split()) | {"sb3-rainbow-coop"}
    modules = metadata.packages_distributions().items()
    return {module for module, of in modules if not {*map(canonicalize_name, of)} & brought}


@pytest.mark.slow
@pytest.mark.parametrize("extras", ON_EXTRAS)
def test_an_install_brings_all_that_its_commands_need(extras: str, tmp_path: Path) -> None:
    missing = not_brought_by(extras)
    assert {"mujoco", "pytest"} <= missing
    blocks = [block for block, reason in python_blocks(README) if not reason]
    assert len(blocks) == 2
    given = f"MISSING, BLOCKS, OUT = {missing}, {blocks}, 'out'"
    program = f"{given}{WITHOUT_THEM}{ON_EXTRAS[extras]}"
    python("-c", program, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert {path.name for path in tmp_path.iterdir()} <= ({"out"} if extras else set())


def test_a_run_finds_the_harness_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An install brings none, and a node of a cluster starts its processes where it likes."""
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log.txt"
    assert spawn(["train", "--help"], log).wait() == 0, log.read_text()
    assert "usage: python -m benchmarks" in log.read_text(encoding="utf-8")


def test_the_wheel_holds_the_two_packages_and_what_both_import(tmp_path: Path) -> None:
    """Built from a copy: a build leaves folders behind, and takes in what an earlier one left."""
    sources, out = tmp_path / "sources", tmp_path / "dist"
    for name in PACKAGES:
        without = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, sources / name, ignore=without)
    for name in SHIPPED:
        shutil.copy(ROOT / name, sources)
    build = ("pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    options = ("--disable-pip-version-check", "--wheel-dir", str(out), str(sources))
    python("-m", *build, *options)
    (path,) = out.glob("*.whl")
    names = zipfile.ZipFile(path).namelist()
    assert {name for name in names if ".dist-info" not in name} == {"cached_njit.py"} | {
        str(path.relative_to(ROOT))
        for package in ("sb3_rainbow", "coop_env")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.parent.name != "__pycache__"
    }
