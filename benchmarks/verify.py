"""Check that stored tables and the README agree with the stored episodes they come from."""

from __future__ import annotations

from pathlib import Path

from benchmarks.readme import BEGIN, END, results_block, split
from benchmarks.store import Store
from benchmarks.tables import build_tables


def verify(store: Store, readme: Path | None = None) -> list[str]:
    """Recompute every table; returns one sentence for each thing that disagrees.

    Args:
        store: the results to check.
        readme: a README whose results block is checked too, if it was made from this store.
    """
    tables = build_tables(store)
    problems = []
    for table in tables:
        for suffix, text in table.forms().items():
            path = store.tables / f"{table.name}{suffix}"
            if not path.is_file():
                problems.append(f"{path} is missing")
            elif path.read_text(encoding="utf-8") != text:
                problems.append(f"{path} differs from the stored episodes{_first(path, text)}")
    if readme is not None and readme.is_file():
        text = readme.read_text(encoding="utf-8")
        if BEGIN in text and END in text and f"--preset {store.folder.name} -->" in text:
            _, block, _ = split(text)
            if block != results_block(store, tables):
                problems.append(f"{readme} differs from the stored episodes: rewrite its results")
    return problems


def _first(path: Path, text: str) -> str:
    """The first line that differs, for the message."""
    stored = path.read_text(encoding="utf-8").splitlines()
    wanted = text.splitlines()
    for number, (old, new) in enumerate(zip(stored, wanted, strict=False), start=1):
        if old != new:
            return f" (line {number}: stored {old!r}, recomputed {new!r})"
    return f" ({len(stored)} lines stored, {len(wanted)} recomputed)"
