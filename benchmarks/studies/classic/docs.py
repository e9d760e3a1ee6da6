"""The results in docs/rainbow.md, written by a command, and the check that they are up to date."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.verify import Report, check_tables, differs
from benchmarks.runs.store import Store, write_text
from benchmarks.studies.classic.presets import load_preset
from benchmarks.studies.classic.results import Results
from benchmarks.studies.classic.tables import build_tables

END: Final = "<!-- classic:end -->"
SHOWN: Final = {"scores": "curves", "cliff": "cliff"}  # tables of the page, each with its figure


def begin(preset: str) -> str:
    """The line before the block, which names the preset that it shows."""
    return (
        f"<!-- classic:begin (written by: python -m benchmarks classic docs --preset {preset}) -->"
    )


BEGIN: Final = begin("").split("(")[0]


def block(results: Results, root: str) -> str:
    """The block with its two markers.

    Args:
        results: complete runs.
        root: the preset's folder, as a path from the page.
    """
    name = results.preset.name
    tables = {table.name: table for table in build_tables(results)}
    parts = [begin(name), "", provenance(results)]
    for table, figure in SHOWN.items():
        if table in tables:
            parts += ["", tables[table].markdown().rstrip()]
            parts += ["", f"![{tables[table].title}]({root}/figures/{figure}.png)"]
    others = [f"[{table}]({root}/tables/{table}.md)" for table in tables if table not in SHOWN]
    if others:
        parts += ["", "More: " + ", ".join(others) + "."]
    return "\n".join([*parts, "", END])


def provenance(results: Results) -> str:
    """Which runs, at which commit, on which machine."""
    if not results.folders:
        return f"Preset `{results.preset.name}`: no run is complete."
    metas = [folder.meta() for folder in results.folders]
    minutes = sum(folder.seconds() for folder in results.folders) / 60.0
    commits = sorted({str(meta["commit"])[:9] for meta in metas})
    machines = sorted({str(meta["machine"]["processor"]) for meta in metas})
    dirty = " with uncommitted changes" if any(meta["dirty"] for meta in metas) else ""
    missing = f" ({len(results.missing)} are missing)" if results.missing else ""
    return (
        f"Preset `{results.preset.name}`: {len(metas)} runs{missing}, {minutes:.0f} minutes on one "
        f"core each added up, at commit {', '.join(commits)}{dirty}, on {'; '.join(machines)}."
    )


def rewrite(page: str, results: Results, root: str) -> str:
    """The page with its block made anew.

    Raises:
        BenchmarkError: the page has no such block.
    """
    start, end = page.find(BEGIN), page.find(END)
    if start < 0 or end < start:
        raise BenchmarkError(f"the page has no block between {BEGIN}... and {END}; add both lines")
    return page[:start] + block(results, root) + page[end + len(END) :]


def write(path: Path, results: Results, root: str) -> bool:
    """Rewrite the block of the page at ``path``; returns whether it changed.

    Raises:
        BenchmarkError: the page is missing or has no such block.
    """
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; it needs a block from {BEGIN}... to {END}")
    old = path.read_text(encoding="utf-8")
    new = rewrite(old, results, root)
    if new != old:
        write_text(path, new)
    return new != old


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify the tables of each store of the classic tasks, and its block in the docs."""
    for path in sorted((results / "classic").glob("*/store.json")):
        found = check_store(path.parent, docs)
        report.add(f"{path.parent}: tables, and its block in {docs}", found)


def check_store(folder: Path, docs: Path) -> list[str]:
    """What disagrees with the runs in a store of the classic tasks."""
    store = Store.open(folder.parent, folder.name)
    results = Results(load_preset(folder.name), store)
    problems = check_tables(store.tables, build_tables(results))
    for path in sorted(docs.glob("*.md")):
        page = path.read_text(encoding="utf-8")
        if begin(folder.name) in page:
            wanted = rewrite(page, results, Path(os.path.relpath(folder, docs)).as_posix())
            problems += differs(path, page, wanted, f"the runs in {folder}")
    return problems
