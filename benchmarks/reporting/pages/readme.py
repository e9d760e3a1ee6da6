"""The results section of README.md, written by a command, and the check that it is up to date."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from benchmarks.reporting.pages import blocks
from benchmarks.reporting.pages.summary import sentences
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.paper import PRINTED, build_tables
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import Store

BEGIN: Final = "<!-- results:begin -->"
END: Final = "<!-- results:end -->"


def render(page: str, store: Store, tables: list[Table] | None = None) -> str:
    """A page with what came out in sentences, the printed tables, and their origin.

    Raises:
        BenchmarkError: the page has no block for it.
    """
    built = build_tables(store) if tables is None else tables
    results, preset = Results(store), store.folder.name
    parts = [provenance(results, preset)]
    parts.append("\n".join(f"- {sentence}" for sentence in sentences(results)))
    parts += [table.markdown().rstrip() for table in built if table.name in PRINTED]
    begin = f"{BEGIN}\n<!-- written by: python -m benchmarks readme --preset {preset} -->"
    return blocks.refill(page, "results", lambda _: "\n\n".join(parts), begin)


def provenance(results: Results, preset: str) -> str:
    """How many runs, how long, at which commit and on which machine."""
    origin = blocks.provenance(preset, [run.folder for run in results.all()])
    if not results.all():
        return origin
    return (
        f"{origin} Every number below is recomputed from `results/{preset}` by "
        "`python -m benchmarks verify`."
    )


def rewrite(path: Path, store: Store) -> bool:
    """Rewrite the block of the README at ``path``; returns whether it changed.

    Raises:
        BenchmarkError: the file or its markers are missing.
    """
    return blocks.rewrite(path, lambda page: render(page, store))
