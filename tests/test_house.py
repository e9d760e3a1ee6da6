"""The house's rules, read from the sources: who may import whom, how full a room is, no paths."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sb3_rainbow", "coop_env", "benchmarks")

# module prefix -> what it must not import
LEARNING = ("torch", "stable_baselines3", "sb3_contrib", "sb3_rainbow")
FORBIDDEN: dict[str, tuple[str, ...]] = {
    "sb3_rainbow": ("coop_env", "benchmarks"),
    "coop_env": ("sb3_rainbow", "benchmarks"),
    "coop_env.simulation": ("coop_env.design",),
    "benchmarks.reporting": (*LEARNING, "coop_env"),
    "benchmarks.runs.store": (*LEARNING, "coop_env"),
}


def _is_within(module: str, prefix: str) -> bool:
    return module == prefix or module.startswith(prefix + ".")


def _sources() -> dict[str, Path]:
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(p for p in parts if p != "__init__")] = path
    return found


SOURCES = _sources()


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("prefix", sorted(FORBIDDEN))
def test_rooms_keep_to_themselves(prefix: str) -> None:
    modules = [name for name in SOURCES if _is_within(name, prefix)]
    assert modules, f"no module {prefix}: has it moved?"
    wrong = [
        f"{name} imports {target}"
        for name in modules
        for target in _imports(SOURCES[name])
        if any(_is_within(target, bad) for bad in FORBIDDEN[prefix])
    ]
    assert wrong == []


def test_only_the_batched_env_touches_sb3() -> None:
    wrong = [
        f"{name} imports {target}"
        for name, path in SOURCES.items()
        if _is_within(name, "coop_env") and name != "coop_env.vec_env"
        for target in _imports(path)
        if _is_within(target, "torch") or _is_within(target, "stable_baselines3")
    ]
    assert wrong == []


def test_importing_the_env_leaves_torch_alone() -> None:
    code = "import sys, coop_env; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0


def test_no_path_of_one_machine() -> None:
    pattern = re.compile(r"(?<![\w.])/(?:work|home|root)/[a-z]")
    listed = subprocess.run(
        ["git", "ls-files", "*.py", "*.md", "*.cfg", "*.toml", "*.yaml", "*.json", "Makefile"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    wrong = [
        name
        for name in listed.stdout.split()
        if (ROOT / name).exists() and pattern.search((ROOT / name).read_text(encoding="utf-8"))
    ]
    assert wrong == []
