"""The results section of README.md, written by a command, and the check that it is up to date."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.pages.summary import sentences
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.paper import PRINTED, build_tables
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import Store, write_text

BEGIN: Final = "<!-- results:begin -->"
END: Final = "<!-- results:end -->"


def results_block(store: Store, tables: list[Table] | None = None) -> str:
    """What came out in sentences, the printed tables, their origin; between the two markers."""
    built = build_tables(store) if tables is None else tables
    preset = store.folder.name
    parts = [BEGIN, f"<!-- written by: python -m benchmarks readme --preset {preset} -->", ""]
    results = Results(store)
    parts += [provenance(results, preset), ""]
    parts += [f"- {sentence}" for sentence in sentences(results)]
    for table in built:
        if table.name in PRINTED:
            parts += ["", table.markdown().rstrip()]
    return "\n".join([*parts, "", END])


def provenance(results: Results, preset: str) -> str:
    """How many runs, how long, at which commit and on which machine."""
    runs = results.all()
    if not runs:
        return f"Preset `{preset}`: no run is complete."
    minutes = sum(run.meta["wall_seconds"] for run in runs) / 60.0
    commits = sorted({str(run.meta["commit"])[:9] for run in runs})
    dirty = " with uncommitted changes" if any(run.meta["dirty"] for run in runs) else ""
    machines = sorted({str(run.meta["machine"]["processor"]) for run in runs})
    return (
        f"Preset `{preset}`: {len(runs)} runs, {minutes:.0f} minutes on one core each added up, "
        f"at commit {', '.join(commits)}{dirty}, on {'; '.join(machines)}. "
        f"Every number below is recomputed from `{store_name(preset)}` by "
        "`python -m benchmarks verify`."
    )


def store_name(preset: str) -> str:
    """Where a preset's results lie, as the docs name it."""
    return f"results/{preset}"


def split(text: str) -> tuple[str, str, str]:
    """README.md before, in and after the block.

    Raises:
        BenchmarkError: the markers are missing or out of order.
    """
    start, end = text.find(BEGIN), text.find(END)
    if start < 0 or end < start:
        raise BenchmarkError(f"README.md has no block between {BEGIN} and {END}; add both lines")
    return text[:start], text[start : end + len(END)], text[end + len(END) :]


def rewrite(path: Path, store: Store) -> bool:
    """Rewrite the block of the README at ``path``; returns whether it changed.

    Raises:
        BenchmarkError: the file or its markers are missing.
    """
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; it needs the lines {BEGIN} and {END}")
    before, old, after = split(path.read_text(encoding="utf-8"))
    new = results_block(store)
    if new == old:
        return False
    write_text(path, before + new + after)
    return True
