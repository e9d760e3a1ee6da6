"""Pages hold whole files of ``results/`` between two markers, written by a command.

In a page::

    <!-- include:begin results/audit/scripted.md (written by: python -m benchmarks readme) -->
    <!-- include:end -->

The path is that of a Markdown file below the folder that the page's folder or its parent is in;
what stands between the markers is replaced by it, and `verify` compares the two.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.runs.store import write_text

_BLOCK: Final = re.compile(
    r"(<!-- include:begin (\S+) \(written by: python -m benchmarks readme\) -->\n)"
    r"(.*?)(<!-- include:end -->)",
    re.DOTALL,
)


def render(page: str, results: Path, where: str) -> str:
    """A page with its included files as they are now.

    Args:
        page: the text.
        results: the folder that stands for ``results/`` in the markers.
        where: the page's name, for errors.

    Raises:
        BenchmarkError: an included file is missing or lies outside ``results/``.
    """

    def fill(match: re.Match[str]) -> str:
        begin, name, _, end = match.groups()
        parts = Path(name).parts
        path = results.joinpath(*parts[1:])
        if parts[0] != "results" or ".." in parts or not path.is_file():
            raise BenchmarkError(f"{where} includes {name}, which is no file of {results}")
        return f"{begin}\n{path.read_text(encoding='utf-8').strip()}\n\n{end}"

    return _BLOCK.sub(fill, page)


def included(page: str) -> list[str]:
    """The files that a page includes, as its markers name them."""
    return [match.group(2) for match in _BLOCK.finditer(page)]


def rewrite_all(docs: Path, results: Path) -> list[Path]:
    """Fill the includes of every page of ``docs``; returns the pages that have one."""
    pages = []
    for path in sorted(docs.glob("*.md")):
        old = path.read_text(encoding="utf-8")
        if not included(old):
            continue
        pages.append(path)
        new = render(old, results, str(path))
        if new != old:
            write_text(path, new)
    return pages
