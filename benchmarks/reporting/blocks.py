"""Generated blocks of pages: what stands between two markers is written by a command.

    <!-- shield:begin (written by: python -m benchmarks study shield) -->
    <!-- shield:end -->

A block is a function that returns the text; its argument is what the first marker says between the
name and the bracket. Pages are the README and ``docs/`` beside the folder
``results``; a folder of another name has none. `report` and every study fill their blocks, `verify`
compares.
"""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.verify import check_file
from benchmarks.runs.store import RunFolder, write_text

Block = Callable[[str], str]
#: blocks by name; a block whose data are missing raises KeyError and stays as it is
Blocks = Mapping[str, Block]


def pattern(name: str) -> re.Pattern[str]:
    """Matches each block of that name: first marker, the marker's argument, second marker."""
    return re.compile(
        rf"(<!-- {re.escape(name)}:begin ?(.*?) ?-->)\n.*?(<!-- {re.escape(name)}:end -->)",
        re.DOTALL,
    )


def render(page: str, blocks: Blocks) -> str:
    """A page with its blocks written anew; blocks whose data are missing stay."""
    for name, block in blocks.items():
        page = pattern(name).sub(partial(_written, block), page)
    return page


def _written(block: Block, match: re.Match[str]) -> str:
    try:
        return f"{match[1]}\n\n{block(match[2].partition('(')[0].strip()).strip()}\n\n{match[3]}"
    except KeyError:
        return match[0]


def pages_of(results: Path) -> list[Path]:
    """The README and the pages of ``docs/`` beside a folder ``results``, which they report."""
    folder = results.resolve()
    if folder.name != "results":
        return []
    pages = (folder.parent / "README.md", *sorted((folder.parent / "docs").glob("*.md")))
    return [page for page in pages if page.is_file()]


def rewrite(results: Path, blocks: Blocks) -> list[Path]:
    """Fill the blocks of all pages; returns the pages that changed."""
    changed = []
    for path in pages_of(results):
        old = path.read_text(encoding="utf-8")
        try:
            new = render(old, blocks)
        except BenchmarkError as error:
            raise BenchmarkError(f"{path}: {error}") from error
        if new != old:
            write_text(path, new)
            changed.append(path)
    return changed


def check(results: Path, blocks: Blocks) -> Iterator[tuple[str, list[str]]]:
    """For each page with such a block: its name, and what differs."""
    for path in pages_of(results):
        text = path.read_text(encoding="utf-8")
        if any(pattern(name).search(text) for name in blocks):
            try:
                yield f"{path}: its blocks", check_file(path, render(text, blocks), "stored data")
            except BenchmarkError as error:
                yield f"{path}: its blocks", [f"{path}: {error}"]


def include(results: Path) -> Block:
    """The block that holds a Markdown file of ``results/``, named in its marker."""

    def read(argument: str) -> str:
        path = results.joinpath(*Path(argument).parts[1:])
        if not argument.startswith("results/") or ".." in argument or not path.is_file():
            raise BenchmarkError(f"{argument} is no file of {results}")
        return path.read_text(encoding="utf-8")

    return read


def docstring(owner: object) -> Block:
    """The block that holds a section of an object's docstring, as Markdown."""

    def read(title: str) -> str:
        _, found, text = str(inspect.getdoc(owner)).partition(f"**{title}**\n")
        if not found:
            raise BenchmarkError(f"the docstring has no section {title!r}")
        table = r"^(=[= ]+)\n(.*)\n\1\n((?:.+\n)+?)\1$"
        text = re.sub(table, _as_markdown, text.partition("\n**")[0], flags=re.MULTILINE)
        text = text.replace("``", "`").replace("::\n", ":\n")
        return re.sub(r":\w+:`[~.\w]*?(\w+)`", r"`\1`", text)

    return read


def _as_markdown(table: re.Match[str]) -> str:
    """A simple table of reStructuredText."""
    starts = [column.start() for column in re.finditer("=+", table[1])]
    spans = [slice(*ends) for ends in zip(starts, [*starts[1:], None], strict=True)]
    rows = [[line[span].strip() for span in spans] for line in (table[2], *table[3].splitlines())]
    rows.insert(1, ["---"] * len(spans))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def provenance(preset: str, runs: Sequence[RunFolder], missing: int = 0, controls: int = 0) -> str:
    """The runs behind a page: how many, how many of controls, how long, commit, machine."""
    if not runs:
        return f"Preset `{preset}`: no run is complete."
    metas = [run.meta() for run in runs]
    minutes = sum(run.seconds("cpu") for run in runs) / 60.0
    commits = sorted({str(meta["commit"])[:9] for meta in metas})
    dirty = " with uncommitted changes" if any(meta["dirty"] for meta in metas) else ""
    at = f"commit {', '.join(commits)}" if len(commits) < 3 else f"{len(commits)} commits"
    machines = sorted({str(meta["machine"]["processor"]) for meta in metas})
    lacking = f" ({missing} are missing)" if missing else ""
    trained = f"{len(runs) - controls} runs" + (f" and {controls} of controls" if controls else "")
    return (
        f"Preset `{preset}`: {trained}{lacking}, {minutes:.0f} CPU minutes, at {at}"
        f"{dirty}, on {'; '.join(machines)}."
    )
