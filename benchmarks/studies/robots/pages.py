"""What the studies of the machines share: a table here, its block in the docs, and their check."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.reporting.pages import blocks
from benchmarks.reporting.verify import Report, check_file


def check_tables(
    report: Report, path: Path, tell: Callable[[Any], str], page: Path, block: str
) -> None:
    """Verify that the tables beside ``path`` and the block of a page follow from its data."""
    if not path.is_file():
        return
    text = tell(json.loads(path.read_text(encoding="utf-8")))
    found = check_file(path.with_suffix(".md"), text + "\n", f"the data in {path}")
    if page.is_file():
        shown = blocks.fill(page.read_text(encoding="utf-8"), block, lambda _: text)
        found += check_file(page, shown, f"the data in {path}")
    report.add(f"{path.parent}: tables, and their block in {page.parent}", found)
