"""The house's rules, read from the sources: who may import whom, no paths."""

import ast
import configparser
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
import yaml

import coop_env
import sb3_rainbow
from tests.process import ROOT, tracked

PACKAGES = ("sb3_rainbow", "coop_env", "benchmarks")

# Each floor may import from itself and from those before it, never from those after it.
FLOORS = {
    "benchmarks": "errors protocol methods evaluation runs reporting studies cli __main__",
    "coop_env": (
        "errors compilation geometry kinematics design simulation rendering.scene rendering.modes "
        "env trajectory vector team shield physics rendering exports"
    ),
    "sb3_rainbow": (
        "type_aliases network masking.conventions replay masking policies fast learner settings "
        "resume rainbow export zoo"
    ),
}

# module prefix -> what it must not import
LEARNING = ("torch", "stable_baselines3", "sb3_contrib", "sb3_rainbow")
FORBIDDEN: dict[str, tuple[str, ...]] = {
    "sb3_rainbow": ("coop_env", "benchmarks"),
    "coop_env": ("sb3_rainbow", "benchmarks", "torch", "stable_baselines3"),
    "coop_env.simulation": ("coop_env.design",),
    "benchmarks.reporting": (*LEARNING, "coop_env"),
    "benchmarks.runs.store": (*LEARNING, "coop_env"),
}
ALLOWED = ("coop_env.vector.vec_env", "stable_baselines3")


def _is_within(module: str, prefix: str) -> bool:
    return module == prefix or module.startswith(prefix + ".")


def _sources() -> dict[str, Path]:
    result = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            result[".".join(p for p in parts if p != "__init__")] = path
    return result


SOURCES = _sources()


@cache  # not at the import: every worker collects this file, one runs it
def _imports(name: str) -> frozenset[str]:
    """What a module imports, wherever in it."""
    result: set[str] = set()
    for node in ast.walk(ast.parse(SOURCES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            result.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            result.add(node.module)
            result.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(result)


def _imported_modules(name: str) -> set[str]:
    """Modules of this house that a module imports, wherever in it; not the packages around them."""
    named = {target for target in _imports(name) if target in SOURCES}
    packages = {target for target in named if SOURCES[target].name == "__init__.py"}
    return {
        target
        for target in named - {name}
        if not (target in packages and any(_is_within(t, target) and t != target for t in named))
    }


def _floor(module: str, floors: tuple[str, ...]) -> int | None:
    """The number of the longest prefix that holds the module."""
    held = [prefix for prefix in floors if _is_within(module, prefix)]
    return floors.index(max(held, key=len)) if held else None


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_never_go_up(package: str) -> None:
    floors = tuple(f"{package}.{room}" for room in FLOORS[package].split())
    for prefix in floors:
        assert any(_is_within(name, prefix) for name in SOURCES), f"no {prefix}: has it moved?"
    wrong, homeless = [], []
    for name in SOURCES:
        mine = _floor(name, floors)
        if not _is_within(name, package) or name == package:
            continue
        if mine is None:
            homeless.append(name)
            continue
        for target in _imported_modules(name):
            theirs = _floor(target, floors)
            if theirs is not None and theirs > mine:
                wrong.append(f"{name} imports {target}")
    assert wrong == []
    assert homeless == []


def test_no_circle_of_imports() -> None:
    TopologicalSorter({name: _imported_modules(name) for name in SOURCES}).prepare()


@pytest.mark.parametrize("prefix", sorted(FORBIDDEN))
def test_rooms_keep_to_themselves(prefix: str) -> None:
    modules = [name for name in SOURCES if _is_within(name, prefix)]
    assert modules, f"no module {prefix}: has it moved?"
    wrong = [
        f"{name} imports {target}"
        for name in modules
        for target in sorted(_imports(name))
        for bad in FORBIDDEN[prefix]
        if _is_within(target, bad) and (name, bad) != ALLOWED
    ]
    assert wrong == []


def test_docstrings_have_one_style() -> None:
    """Google's sections; ruff checks their form, but lets fields of reST's pass."""
    field = re.compile(r"^\s*:(?:param|return|raises|rtype)\b.*:", re.MULTILINE)
    assert [name for name, path in SOURCES.items() if field.search(path.read_text("utf-8"))] == []


def test_no_path_of_one_machine() -> None:
    pattern = re.compile(r"(?<![\w.])/(?:work|home|root)/[a-z]")
    wrong = [
        name
        for name in tracked("*.py", "*.md", "*.cfg", "*.toml", "*.yaml", "*.json", "Makefile")
        if (ROOT / name).exists() and pattern.search((ROOT / name).read_text(encoding="utf-8"))
    ]
    assert wrong == []


def test_what_setup_cfg_says_is_the_same_wherever_it_stands() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    meta = setup["metadata"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "citing.md").read_text(encoding="utf-8")
    assert f"version = {{{cited['version']}}}" in page
    assert (
        {cited["version"], meta["version"]} == {coop_env.__version__} == {sb3_rainbow.__version__}
    )
    for name in ("CITATION.cff", "LICENSE", "docs/citing.md"):
        assert meta["author"] in (ROOT / name).read_text(encoding="utf-8"), name
    assert meta["url"] in (ROOT / "examples" / "rainbow.ipynb").read_text(encoding="utf-8")


def test_a_package_lists_what_it_exports_and_has_it() -> None:
    for package in (coop_env, sb3_rainbow):
        assert set(dir(package)) == set(package.__all__)
        assert all(hasattr(package, name) for name in package.__all__)
