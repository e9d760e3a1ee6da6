"""Results on the pages of Rainbow, written by a command, and the check that they are up to date."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.pages import blocks
from benchmarks.reporting.verify import Report, check_file, check_tables
from benchmarks.runs.store import Store
from benchmarks.studies.classic.presets import load_preset, preset_names
from benchmarks.studies.classic.results import Results
from benchmarks.studies.classic.tables import build_tables

# tables of the page, each with its figure
SHOWN: Final = {
    **{"scores": "curves", "controls": "", "normalized": "", "together": "", "cliff": "cliff"},
    **{"contact": "contact", "friction": ""},
}


def begin(preset: str) -> str:
    """The line before the block, which names the preset that it shows."""
    command = f"python -m benchmarks classic docs --preset {preset}"
    return f"<!-- {block_of(preset)}:begin (written by: {command}) -->"


def block_of(preset: str) -> str:
    """The name of a preset's block."""
    return f"classic-{preset}"


def page_of(preset: str, docs: Path) -> Path:
    """The page below ``docs`` that shows a preset.

    Raises:
        BenchmarkError: none does.
    """
    for path in sorted(docs.glob("*.md")):
        if begin(preset) in path.read_text(encoding="utf-8"):
            return path
    raise BenchmarkError(f"no page in {docs} has the line {begin(preset)}; name one with --page")


def rewrite(page: str, results: Results, root: str) -> str:
    """The page with its block made anew.

    Args:
        page: the text.
        results: complete runs.
        root: the preset's folder, as a path from the page.

    Raises:
        BenchmarkError: the page has no such block.
    """
    name = results.preset.name
    tables = {table.name: table for table in build_tables(results)}
    missing = len(results.missing)
    parts = [blocks.provenance(name, results.folders, missing, results.n_controls)]
    for table, figure in SHOWN.items():
        if table in tables:
            parts.append(tables[table].markdown().rstrip())
            if figure and not results.preset.search:
                parts.append(f"![{tables[table].title}]({root}/figures/{figure}.png)")
    others = [f"[{table}]({root}/tables/{table}.md)" for table in tables if table not in SHOWN]
    if others:
        parts.append("More: " + ", ".join(others) + ".")
    return blocks.refill(page, block_of(name), lambda _: "\n\n".join(parts), begin(name))


def write(path: Path, results: Results, root: str) -> bool:
    """Rewrite the block of the page at ``path``; returns whether it changed.

    Raises:
        BenchmarkError: the page is missing or has no such block.
    """
    return blocks.rewrite(path, lambda page: rewrite(page, results, root))


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify the tables of each store of the classic tasks, and its block in the docs."""
    for path in sorted((results / "classic").glob("*/store.json")):
        if path.parent.name not in preset_names():
            report.add(f"{path.parent}: of a preset of one's own, not checked", [])
            continue
        found = check_store(path.parent, docs)
        report.add(f"{path.parent}: runs, tables, and its block in {docs}", found)


def check_store(folder: Path, docs: Path) -> list[str]:
    """What disagrees with the runs in a store of the classic tasks."""
    store = Store.open(folder.parent, folder.name)
    results = Results(load_preset(folder.name), store)
    problems = [*results.problems(), *check_tables(store.tables, build_tables(results))]
    for path in sorted(docs.glob("*.md")):
        page = path.read_text(encoding="utf-8")
        if begin(folder.name) in page:
            wanted = rewrite(page, results, Path(os.path.relpath(folder, docs)).as_posix())
            problems += check_file(path, wanted, f"the runs in {folder}")
    return problems
