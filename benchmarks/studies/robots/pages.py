"""What the studies of the machines share: a table here, its block in the docs, and their check."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.reporting.pages import blocks
from benchmarks.reporting.verify import Report, check_file
from benchmarks.runs.store import write_text


def kept(path: Path, asked: dict[str, Any], empty: dict[str, Any]) -> dict[str, Any]:
    """What ``path`` holds already if the same was asked for, or else what is ``empty``."""
    if path.is_file():
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if found["asked"] == asked:
            return found
    return {"asked": asked, **empty}


def publish(path: Path, text: str, page: Path, block: str, console: Console) -> None:
    """Write a study's tables beside its data and into its block of a page, and print them."""
    write_text(path.with_suffix(".md"), text + "\n")
    if page.is_file():
        blocks.rewrite(page, lambda old: blocks.fill(old, block, lambda _: text))
    console.print(text, markup=False)
    console.print(f"Written to {path.parent}", markup=False)


def check_tables(
    report: Report, path: Path, tell: Callable[[Any], str], page: Path, block: str
) -> None:
    """Verify that the tables beside ``path`` and the block of a page follow from its data."""
    if not path.is_file():
        return
    try:
        text = tell(json.loads(path.read_text(encoding="utf-8")))
    except KeyError as missing:
        report.add(str(path), [f"{path} has no {missing}: go on measuring"])
        return
    found = check_file(path.with_suffix(".md"), text + "\n", f"the data in {path}")
    if page.is_file():
        shown = blocks.fill(page.read_text(encoding="utf-8"), block, lambda _: text)
        found += check_file(page, shown, f"the data in {path}")
    report.add(f"{path.parent}: tables, and their block in {page.parent}", found)
