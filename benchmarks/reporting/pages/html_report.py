"""The report: every table and picture of a preset on one HTML page that needs no other file."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import jinja2
from markupsafe import Markup, escape
from PIL import Image

from benchmarks.reporting.figures.style import Picture, flat_png
from benchmarks.reporting.pages.readme import provenance
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.deviations import UNKNOWN, Reason, load_reasons
from benchmarks.reporting.tables.table import FLAG, Cell, Number, Table
from benchmarks.runs.store import Store, write_text

TEMPLATE: Final = Path(__file__).parent / "report.html.j2"
WIDE: Final = 40  # characters of a cell that may wrap
KINDS: Final = {".csv": ("CSV", "text/csv"), ".md": ("Markdown", "text/markdown"),
                ".tex": ("LaTeX", "application/x-tex")}  # fmt: skip
GROUPS: Final = {
    "The paper's tables": (
        *("hyperparameters", "design", "performance", "ablation", "geometry", "robustness"),
        "uncertain",
    ),
    "Leaderboard": ("leaderboard",),
    "Statistics": ("deviations", "significance"),
}
# of the design study, if it was run: file, caption, what it shows
DESIGN: Final = (
    ("singularity_loci", "Singularity loci at home heave.",
     "Contour charts of signed sigma_min over roll and pitch, initial and optimized design."),
    ("manipulability_3d", "Manipulability over roll, pitch and heave.",
     "Three-dimensional charts of the manipulability of both designs."),
    ("atlas", "Atlas of the workspace area over the design parameters.",
     "Map of the singularity-free area over lambda1 and lambda2 with the optimizer's paths."),
    ("joint_trajectories", "Joint angles along the test trajectory.",
     "Line charts of the three actuated angles of both designs along one trajectory."),
)  # fmt: skip


@dataclass(frozen=True)
class Embedded:
    """A picture as the page holds it."""

    name: str
    caption: str
    alt: str
    png: bytes

    def fields(self) -> dict[str, Any]:
        """What the template needs."""
        width, height = Image.open(io.BytesIO(self.png)).size
        return {
            "name": self.name,
            "caption": self.caption,
            "alt": self.alt,
            "data": _data_uri("image/png", self.png),
            "width": width,
            "height": height,
        }


def report_path(store: Store) -> Path:
    """Where a store's report lies."""
    return store.folder / "report.html"


def write_report(
    store: Store, tables: Sequence[Table], drawn: Sequence[tuple[Picture, Path]]
) -> Path:
    """Write the report of a store from its tables and from figures that were just drawn.

    Args:
        store: the results.
        tables: all of :func:`benchmarks.reporting.tables.paper.build_tables`.
        drawn: pictures and the files they are in.

    Returns:
        The page's path.
    """
    preset = store.folder.name
    sections: dict[str, list[Embedded]] = {}
    for picture, path in drawn:
        page = Embedded(picture.name, picture.caption, picture.alt, path.read_bytes())
        sections.setdefault(picture.section, []).append(page)
    design = _design_pictures(store.folder.parent / "design" / "figures")
    if design:
        sections["Geometric optimization"] = design
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, keep_trailing_newline=True
    )
    environment.filters["code"] = _code
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    reasons = [r for r in load_reasons() if not r.presets or preset in r.presets]
    text = template.render(
        title=f"Benchmarks of preset {preset}",
        provenance=provenance(Results(store), preset),
        command=f"python -m benchmarks report --preset {preset}",
        flag=FLAG,
        groups=_groups(tables, reasons, preset),
        sections=[
            {"title": title, "id": f"figures-{i}", "pictures": [each.fields() for each in pages]}
            for i, (title, pages) in enumerate(sections.items())
        ],
    )
    write_text(report_path(store), text)
    return report_path(store)


def _design_pictures(folder: Path) -> list[Embedded]:
    return [
        Embedded(f"design_{name}", caption, alt, flat_png((folder / f"{name}.png").read_bytes()))
        for name, caption, alt in DESIGN
        if (folder / f"{name}.png").is_file()
    ]


def _groups(
    tables: Sequence[Table], reasons: Sequence[Reason], preset: str
) -> list[dict[str, Any]]:
    by_name = {table.name: table for table in tables}
    placed = {name for names in GROUPS.values() for name in names}
    layout = {title: [by_name[n] for n in names if n in by_name] for title, names in GROUPS.items()}
    layout["Statistics"] += [table for table in tables if table.name not in placed]
    return [
        {"title": title, "tables": [_fields(table, reasons, preset) for table in group]}
        for title, group in layout.items()
        if group
    ]


def _fields(table: Table, reasons: Sequence[Reason], preset: str) -> dict[str, Any]:
    left = {*table.left, *table.prose}
    return {
        "name": table.name,
        "title": table.title,
        "header": [{"text": t, "left": i in left} for i, t in enumerate(table.header)],
        "rows": [
            [_cell(table, row, i, reasons, preset) for i in range(len(row))] for row in table.rows
        ],
        "notes": table.notes,
        "files": [
            {
                "name": f"{table.name}{suffix}",
                "kind": KINDS[suffix][0],
                "data": _data_uri(KINDS[suffix][1], text.encode()),
            }
            for suffix, text in table.forms().items()
        ],
    }


def _cell(
    table: Table, row: Sequence[Cell], i: int, reasons: Sequence[Reason], preset: str
) -> dict[str, str]:
    cell, classes, hint = row[i], [], ""
    if i in table.prose:
        classes.append("prose")
    elif i in table.left:
        classes.append("left")
    if "paper" in table.header[i].lower().split() or ", paper" in table.header[i]:
        classes.append("paper")
    if isinstance(cell, Number) and cell.flagged:
        classes.append("flagged")
        place = (table.name, str(row[0]), table.header[i])
        reason = next((r.reason for r in reasons if r.covers(preset, *place)), UNKNOWN)
        hint = f"The paper: {cell.paper}. {reason}"
    text = cell if isinstance(cell, str) else cell.text()
    if len(text) > WIDE:
        classes.append("wide")
    return {"text": text, "classes": " ".join(classes), "hint": hint}


def _code(text: str) -> Markup:
    """What stands between backticks as code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
