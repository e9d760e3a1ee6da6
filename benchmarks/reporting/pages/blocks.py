"""Generated blocks of pages: what stands between two markers is written by a command.

<!-- design-table:begin (written by: python -m benchmarks design) -->
<!-- design-table:end -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.errors import BenchmarkError
from benchmarks.runs.store import RunFolder, write_text


def pattern(name: str) -> re.Pattern[str]:
    """Matches each block of that name: its first marker, what the marker says, its second one."""
    return re.compile(
        rf"(<!-- {re.escape(name)}:begin ?(.*?) ?-->)\n.*?(<!-- {re.escape(name)}:end -->)",
        re.DOTALL,
    )


def fill(page: str, name: str, body: Callable[[str], str], begin: str = "") -> str:
    """A page with its blocks of that name written afresh.

    Args:
        page: the text.
        name: of the blocks.
        body: what belongs into a block, by what its first marker says beside the name.
        begin: stands in place of the first marker.
    """

    def write(match: re.Match[str]) -> str:
        return f"{begin or match[1]}\n\n{body(match[2]).strip()}\n\n{match[3]}"

    return pattern(name).sub(write, page)


def refill(page: str, name: str, body: Callable[[str], str], begin: str = "") -> str:
    """As :func:`fill`.

    Raises:
        BenchmarkError: the page has no such block.
    """
    if not pattern(name).search(page):
        raise BenchmarkError(
            f"the page has no block between <!-- {name}:begin --> and <!-- {name}:end -->; add "
            "both lines"
        )
    return fill(page, name, body, begin)


def rewrite(path: Path, render: Callable[[str], str]) -> bool:
    """Put what ``render`` makes of a page in its place; returns whether it changed.

    Raises:
        BenchmarkError: the page is missing.
    """
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; it needs the two lines around a block")
    old = path.read_text(encoding="utf-8")
    new = render(old)
    if new != old:
        write_text(path, new)
    return new != old


def provenance(preset: str, runs: Sequence[RunFolder], missing: int = 0, controls: int = 0) -> str:
    """How many runs, of which so many of controls, how long, at which commit, on which machine."""
    if not runs:
        return f"Preset `{preset}`: no run is complete."
    metas = [run.meta() for run in runs]
    minutes = sum(run.cpu_seconds() for run in runs) / 60.0
    commits = sorted({str(meta["commit"])[:9] for meta in metas})
    dirty = " with uncommitted changes" if any(meta["dirty"] for meta in metas) else ""
    machines = sorted({str(meta["machine"]["processor"]) for meta in metas})
    lacking = f" ({missing} are missing)" if missing else ""
    trained = f"{len(runs) - controls} runs" + (f" and {controls} of controls" if controls else "")
    return (
        f"Preset `{preset}`: {trained}{lacking}, {minutes:.0f} CPU minutes, at commit "
        f"{', '.join(commits)}{dirty}, on {'; '.join(machines)}."
    )
