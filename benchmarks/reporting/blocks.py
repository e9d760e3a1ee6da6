"""Generated blocks of pages: what stands between two markers is written from stored data.

    <!-- shield:begin (written by: python -m benchmarks study shield) -->
    <!-- shield:end -->

A block is a function from what its first marker says beside the name to its text; the words of the
marker up to the bracket are its arguments. Pages are the README and ``docs/`` beside the results
folder. `report` and every study fill their blocks, `verify` compares.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.verify import check_file
from benchmarks.runs.store import RunFolder, write_text

Block = Callable[[str], str]
#: by name; one of which the data are missing raises KeyError, and stays as it is
Blocks = Mapping[str, Block]

#: of the gallery: heading, command, pictures; entries of one heading stand together
GALLERY: Final = (
    ("The robots", "study media", "media/*"),
    ("The robots", "study trajectory", "trajectory/*"),
    ("The robots", "study contact --film", "contact/*"),
    ("Design of the 3-RRS", "study design", "design/figures/*"),
    ("Design of the 3-RRS", "study codesign", "codesign/figures/*"),
    ("The paper at its own scale", "figures --preset paper", "paper/figures/*"),
    ("Public suites, contact and teams", "figures --preset PRESET", "classic/*/figures/*"),
    ("Public suites, contact and teams", "figures --preset team", "team/figures/*"),
    ("The first runs, cut short", "figures --preset cut", "cut/figures/*"),
    ("The first runs, cut short", "study failures --preset cut --track safe",
     "cut/failures/*-safe.*"),
    ("The first runs, cut short", "study failures --preset cut --track memory",
     "cut/failures/*-memory.*"),
    ("The first runs, cut short", "study audit", "audit/*"),
)  # fmt: skip
COLUMNS: Final = 5
ENDS: Final = (".png", ".gif")


def pattern(name: str) -> re.Pattern[str]:
    """Matches each block of that name: its first marker, what the marker says, its second one."""
    return re.compile(
        rf"(<!-- {re.escape(name)}:begin ?(.*?) ?-->)\n.*?(<!-- {re.escape(name)}:end -->)",
        re.DOTALL,
    )


def render(page: str, blocks: Blocks) -> str:
    """A page with its blocks written afresh; those of which the data are missing stay."""

    def write(match: re.Match[str], body: Block) -> str:
        try:
            return f"{match[1]}\n\n{body(match[2].partition('(')[0].strip()).strip()}\n\n{match[3]}"
        except KeyError:
            return match[0]

    for name, body in blocks.items():
        page = pattern(name).sub(lambda match, body=body: write(match, body), page)  # type: ignore[misc]
    return page


def pages_of(results: Path) -> list[Path]:
    """The README and the pages of ``docs/`` beside a results folder."""
    root = results.resolve().parent
    return [p for p in (root / "README.md", *sorted((root / "docs").glob("*.md"))) if p.is_file()]


def rewrite(results: Path, blocks: Blocks) -> list[Path]:
    """Fill the blocks of all pages; returns the pages that changed."""
    changed = []
    for path in pages_of(results):
        old = path.read_text(encoding="utf-8")
        if (new := render(old, blocks)) != old:
            write_text(path, new)
            changed.append(path)
    return changed


def check(results: Path, blocks: Blocks) -> Iterator[tuple[str, list[str]]]:
    """For each page with such a block: what was looked at, and what differs."""
    for path in pages_of(results):
        text = path.read_text(encoding="utf-8")
        if any(pattern(name).search(text) for name in blocks):
            try:
                yield f"{path}: its blocks", check_file(path, render(text, blocks), "stored data")
            except BenchmarkError as error:
                yield f"{path}: its blocks", [f"{path}: {error}"]


def include(results: Path) -> Block:
    """The block that holds a Markdown file of ``results/``, named in its marker."""

    def read(said: str) -> str:
        path = results.joinpath(*Path(said).parts[1:])
        if not said.startswith("results/") or ".." in said or not path.is_file():
            raise BenchmarkError(f"{said} is no file of {results}")
        return path.read_text(encoding="utf-8")

    return read


def gallery(results: Path) -> Block:
    """The block of all pictures as thumbnails, below the commands that write them.

    A caption is the picture's folder and name: the pages that show it say more.
    """

    def body(_: str) -> str:
        commands: dict[str, list[str]] = {}
        cells: dict[str, list[str]] = {}
        for title, command, glob in GALLERY:
            for path in sorted(p for p in results.glob(glob) if p.suffix in ENDS):
                name = path.relative_to(results).as_posix()
                folder = next(p for p in path.parents if p.name not in ("figures", "failures"))
                caption = f"{folder.name}: {re.sub('[-_]', ' ', path.stem)}"
                cell = f"[![](../results/{name})<br>{caption}](../results/{name})"
                cells.setdefault(title, []).append(cell)
                known = commands.setdefault(title, [])
                known += [] if command in known else [command]
        sections = []
        for title, result in cells.items():
            result += [""] * (-len(result) % COLUMNS)
            lines = ["|" * (COLUMNS + 1), "|---" * COLUMNS + "|"]
            rows = [result[i : i + COLUMNS] for i in range(0, len(result), COLUMNS)]
            lines += ["|".join(["", *row, ""]) for row in rows]
            said = "\n".join(f"    python -m benchmarks {command}" for command in commands[title])
            sections.append(f"## {title}\n\n{said}\n\n" + "\n".join(lines))
        return "\n\n".join(sections)

    return body


def provenance(preset: str, runs: Sequence[RunFolder], missing: int = 0, controls: int = 0) -> str:
    """How many runs, of which so many of controls, how long, at which commit, on which machine."""
    if not runs:
        return f"Preset `{preset}`: no run is complete."
    metas = [run.meta() for run in runs]
    minutes = sum(run.cpu_seconds() for run in runs) / 60.0
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
