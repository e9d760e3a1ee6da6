"""Pages hold whole files of ``results/`` in blocks, written by a command.

In a page::

    <!-- include:begin results/audit/scripted.md (written by: python -m benchmarks readme) -->
    <!-- include:end -->

The path is that of a Markdown file below the folder that the page's folder or its parent is in;
what stands between the markers is replaced by it, and `verify` compares the two.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.pages.blocks import fill, pattern, rewrite


def render(page: str, results: Path, where: str) -> str:
    """A page with its included files as they are now.

    Args:
        page: the text.
        results: the folder that stands for ``results/`` in the markers.
        where: the page's name, for errors.

    Raises:
        BenchmarkError: an included file is missing or lies outside ``results/``.
    """

    def read(said: str) -> str:
        name = said.split()[0]
        parts = Path(name).parts
        path = results.joinpath(*parts[1:])
        if parts[0] != "results" or ".." in parts or not path.is_file():
            raise BenchmarkError(f"{where} includes {name}, which is no file of {results}")
        return path.read_text(encoding="utf-8")

    return fill(page, "include", read)


def included(page: str) -> list[str]:
    """The files that a page includes, as its markers name them."""
    return [match[2].split()[0] for match in pattern("include").finditer(page)]


def rewrite_all(docs: Path, results: Path) -> list[Path]:
    """Fill the includes of every page of ``docs``; returns the pages that have one."""
    pages = []
    for path in sorted(docs.glob("*.md")):
        if included(path.read_text(encoding="utf-8")):
            rewrite(path, partial(render, results=results, where=str(path)))
            pages.append(path)
    return pages
