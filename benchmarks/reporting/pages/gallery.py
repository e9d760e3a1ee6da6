"""The gallery: the pictures of ``results``, under the command that writes them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.reporting.figures.learning import pictures
from benchmarks.reporting.pages import blocks
from benchmarks.reporting.results import Results
from benchmarks.runs.store import Store

PICTURES: Final = (
    ("Both robots, and the view", "media", "media/*"),
    ("Geometric optimization", "design", "design/figures/*"),
    ("What rewards pay for", "audit", "audit/*"),
    ("The paper at its own scale", "figures --preset paper", "paper/figures/*"),
    ("The first runs, cut short", "figures --preset cut", "cut/figures/*"),
    ("Failures, safe", "failures --preset cut --track safe", "cut/failures/*-safe.*"),
    ("Failures, memory", "failures --preset cut --track memory", "cut/failures/*-memory.*"),
    ("Design and team", "codesign", "codesign/figures/*"),
    ("Insertion in contact", "contact --film", "contact/*"),
    ("Learners in contact", "classic figures --preset contact", "classic/contact/figures/*"),
    ("A trajectory for a controller", "trajectory", "trajectory/*"),
    ("Two robots at once", "figures --preset team", "team/figures/*"),
    ("Control tasks", "classic figures --preset control", "classic/control/figures/*"),
    (
        "LunarLander for longer",
        "classic figures --preset lunarlander300k",
        "classic/lunarlander300k/figures/*",
    ),
    ("MinAtar", "classic figures --preset minatar", "classic/minatar/figures/*"),
    ("Atari", "classic figures --preset atari100k", "classic/atari100k/figures/*"),
    ("The bare line", "classic figures --preset defaults", "classic/defaults/figures/*"),
    ("Masks and priorities", "classic figures --preset basics", "classic/basics/figures/*"),
)
ENDS: Final = (".png", ".gif")
PAGE: Final = "gallery.md"


def render(page: str, results: Path, others: Iterable[Path]) -> str:
    """A page with its gallery as the pictures below ``results`` are now.

    Args:
        page: the text.
        results: the folder that stands for ``results/``.
        others: pages whose words for a picture are its caption, where its maker has none.
    """
    return blocks.fill(page, "gallery", lambda _: _body(results, others))


def others_of(path: Path) -> list[Path]:
    """The pages beside the gallery's, and the README above them."""
    return [path.parent.parent / "README.md", *sorted({*path.parent.glob("*.md")} - {path})]


def rewrite(path: Path, results: Path) -> bool:
    """Write the gallery of a page afresh; returns whether it changed."""
    return blocks.rewrite(path, partial(render, results=results, others=others_of(path)))


def _body(results: Path, others: Iterable[Path]) -> str:
    captions = _captions(results, others)
    sections = []
    for title, command, pattern in PICTURES:
        cells = []
        for path in sorted(p for p in results.glob(pattern) if p.suffix in ENDS):
            name = path.relative_to(results).as_posix()
            caption = captions.get(name) or re.sub(r"\W|_", " ", path.stem).capitalize()
            cells.append(f"![{caption}](../results/{name})<br>{caption}")
        if not cells:
            continue
        cells += [""] * (len(cells) % 2)
        rows = [f"| {a} | {b} |" for a, b in zip(cells[::2], cells[1::2], strict=True)]
        table = "\n".join(["| | |", "|---|---|", *rows])
        sections.append(f"## {title}\n\n    python -m benchmarks {command}\n\n{table}")
    return "\n\n".join(sections)


def _captions(results: Path, others: Iterable[Path]) -> dict[str, str]:
    """By path below ``results``."""
    found: dict[str, str] = {}
    for page in others:
        shown = re.findall(r"!\[([^\]]+)\]\([./]*results/([^)]+)\)", page.read_text("utf-8"))
        found |= {name: text for text, name in shown}
    for name in {pattern.split("/")[0] for *_, pattern in PICTURES}:
        if (results / name / "store.json").is_file():
            for picture in pictures(Results(Store.open(results, name))):
                found[f"{name}/figures/{picture.name}.png"] = picture.caption
    return found
