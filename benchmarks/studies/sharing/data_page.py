"""The table of the datasets, from what was measured when they were made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.reporting.pages import blocks
from benchmarks.reporting.tables.table import Cell, Table
from benchmarks.reporting.verify import Report, check_file
from benchmarks.runs.store import write_text

BLOCK: Final = "data"
PAGE: Final = "data.md"


def tell(records: Sequence[Mapping[str, Any]]) -> str:
    """The table as Markdown."""
    rows: list[list[Cell]] = [
        [
            f"`{record['id']}`",
            record["behaviour"],
            f"{record['steps']:,}",
            f"{record['starts']:,}",
            f"{100.0 * record['success']:.1f}",
            f"{record['holes']:.2f}",
            f"{100.0 * record['all_holes']:.1f}",
            f"{record['return']:.1f} ± {record['return_std']:.1f}",
            f"{record['megabytes']:.1f}",
        ]
        for record in records
    ]
    notes = [
        "Success: episodes with an insertion, of all starts; return: mean ± std of the episodes.",
        "Nothing inserts from more starts than the exact optimum: its rows are the ceiling.",
    ]
    header = ["Dataset", "Behaviour", "Steps", "Starts", "Success (%)", "Holes (of 6)",
              "All six (%)", "Return", "MB"]  # fmt: skip
    return Table("data", "Datasets of the insertion task", header, rows, notes, (0, 1)).markdown()


def write(results: Path, docs: Path, records: Sequence[Mapping[str, Any]]) -> str:
    """Store the records and their table, and fill the block of the docs; returns the table."""
    text = tell(records)
    write_text(results / "data" / "data.json", json.dumps(records, indent=1) + "\n")
    write_text(results / "data" / "data.md", text)
    if (docs / PAGE).is_file():
        blocks.rewrite(docs / PAGE, lambda page: blocks.refill(page, BLOCK, lambda _: text))
    return text


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the table, here and in the docs, follows from what was measured."""
    path = results / "data" / "data.json"
    if not path.is_file():
        return
    text = tell(json.loads(path.read_text(encoding="utf-8")))
    found = check_file(path.with_suffix(".md"), text, f"the records of {path.name}")
    page = docs / PAGE
    if page.is_file():
        shown = blocks.fill(page.read_text(encoding="utf-8"), BLOCK, lambda _: text)
        found += check_file(page, shown, f"the records of {path.name}")
    report.add(f"{path.parent}: table of the datasets, and its block in {docs}", found)
