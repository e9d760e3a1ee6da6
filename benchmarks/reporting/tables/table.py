"""A table as CSV (numbers apart), Markdown and LaTeX (booktabs)."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from benchmarks.reporting.stats import Value
from benchmarks.runs.store import write_text

FLAG: Final = "†"
FLAG_NOTE: Final = f"{FLAG} no number that rounds to the paper's lies in our 95 % interval."
_NUMBER: Final = re.compile(r"-?\d+(?:\.(\d+))?")
NARROW: Final = 5  # columns of a table that fits one column of a paper


@dataclass(frozen=True)
class Number:
    """A cell with a value of ours.

    Attributes:
        value: the number, its spread and its interval.
        digits: after the point.
        suffix: printed behind it.
        paper: what the paper prints for it, if anything.
        shown: printed in place of the value, where that is no plain number.
        differs: whether it disagrees with the paper, where the interval alone cannot tell.
    """

    value: Value
    digits: int = 1
    suffix: str = ""
    paper: str = ""
    shown: str = ""
    differs: bool | None = None

    @property
    def flagged(self) -> bool:
        """Whether the paper's number lies outside our interval."""
        if self.differs is not None:
            return self.differs
        printed = printed_range(self.paper)
        if printed is None or math.isnan(self.value.low):
            return False
        return printed[1] < self.value.low or printed[0] > self.value.high

    def plain(self) -> str:
        """The value as printed, without a flag."""
        return self.shown or self.value.text(self.digits) + (self.suffix if self.value.n else "")

    def text(self) -> str:
        """The value as printed, with a flag if the paper's number lies outside our interval."""
        return f"{self.plain()} {FLAG}" if self.flagged else self.plain()


TableCell = str | Number


def printed_range(text: str) -> tuple[float, float] | None:
    """The numbers that round to what is printed: half a unit of the last digit to either side.

    >>> printed_range("1.16 ± 0.05")
    (1.155, 1.165)

    Returns:
        Lower and upper end, or None where nothing is printed.
    """
    match = _NUMBER.match(text)
    if match is None:
        return None
    digits, number = len(match[1] or ""), float(match[0])
    half = 0.5 * 10.0**-digits
    return round(number - half, digits + 1), round(number + half, digits + 1)


@dataclass(frozen=True)
class Table:
    """A table of the report: header, rows, and notes that belong under it.

    ``left`` are the columns set flush left.
    """

    name: str
    title: str
    header: list[str]
    rows: list[list[TableCell]]
    notes: list[str] = field(default_factory=list)
    left: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"table {self.name}: row {row!r} does not fit {self.header!r}")

    def texts(self) -> list[list[str]]:
        """All cells as printed."""
        return [[cell if isinstance(cell, str) else cell.text() for cell in r] for r in self.rows]

    def markdown(self) -> str:
        """GitHub-flavoured Markdown with the title above and the notes below."""
        grid = [[_escape_markdown(text) for text in row] for row in self.texts()]
        head = [_escape_markdown(text) for text in self.header]
        widths = [max(len(r[i]) for r in [head, *grid]) for i in range(len(head))]
        left = {*self.left}
        lines = [f"**{self.title}**", ""]
        lines.append(_pipe(head, widths, left))
        align = ["-" * w if i in left else "-" * (w - 1) + ":" for i, w in enumerate(widths)]
        lines.append("| " + " | ".join(align) + " |")
        lines += [_pipe(row, widths, left) for row in grid]
        if self.notes:
            lines += ["", *[f"- {note}" for note in self.notes]]
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        """A booktabs ``table``, across both columns if wide; needs ``\\usepackage{booktabs}``."""
        environment = "table" if len(self.header) <= NARROW else "table*"
        columns = "".join("l" if i in self.left else "c" for i in range(len(self.header)))
        lines = [
            r"% needs \usepackage{booktabs}",
            rf"\begin{{{environment}}}[t]",
            rf"    \caption{{{_escape_latex(self.title)}}}",
            rf"    \label{{tab:{self.name}}}",
            r"    \centering",
            rf"    \begin{{tabular}}{{{columns}}}",
            r"        \toprule",
            "        " + " & ".join(_escape_latex(t) for t in self.header) + r" \\",
            r"        \midrule",
        ]
        lines += [
            "        " + " & ".join(_escape_latex(t) for t in row) + r" \\" for row in self.texts()
        ]
        lines += [r"        \bottomrule", r"    \end{tabular}"]
        lines += [rf"    \par\footnotesize {_escape_latex(note)}" for note in self.notes]
        lines.append(rf"\end{{{environment}}}")
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """CSV: a column of numbers becomes mean, std, n, low and high."""
        wide = [
            any(isinstance(row[i], Number) for row in self.rows) for i in range(len(self.header))
        ]
        header: list[str] = []
        for name, numeric in zip(self.header, wide, strict=True):
            header += [name, *([f"{name} | {p}" for p in _PARTS] if numeric else [])]
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for row in self.rows:
            record: list[str] = []
            for cell, numeric in zip(row, wide, strict=True):
                record.append(cell if isinstance(cell, str) else cell.text())
                if numeric:
                    record += _parts(cell)
            writer.writerow(record)
        return stream.getvalue()

    def write(self, folder: Path) -> list[Path]:
        """Write all three forms, atomically."""
        paths = []
        for suffix, text in self.forms().items():
            path = folder / f"{self.name}{suffix}"
            write_text(path, text)
            paths.append(path)
        return paths

    def forms(self) -> dict[str, str]:
        """File suffix to contents."""
        return {".csv": self.csv(), ".md": self.markdown(), ".tex": self.latex()}


def plain(title: str, header: str, rows: Iterable[Iterable[str]]) -> str:
    """A table of texts as Markdown, the header's columns parted by `` | ``."""
    return Table("", title, header.split(" | "), [list(row) for row in rows]).markdown().strip()


def p_text(value: float) -> str:
    """A p, or a dash."""
    return "-" if math.isnan(value) else "< 0.001" if value < 0.001 else f"{value:.2g}"


_PARTS = ("mean", "std", "n", "low", "high")


def _parts(cell: TableCell) -> list[str]:
    if isinstance(cell, str):
        return [""] * len(_PARTS)
    v = cell.value
    numbers = (v.mean, v.std, float(v.n), v.low, v.high)
    return ["" if math.isnan(x) else f"{x:.7g}" for x in numbers]


def _pipe(cells: list[str], widths: list[int], left: set[int]) -> str:
    padded = [
        c.ljust(w) if i in left else c.rjust(w)
        for i, (c, w) in enumerate(zip(cells, widths, strict=True))
    ]
    return "| " + " | ".join(padded) + " |"


def _escape_markdown(text: str) -> str:
    return text.replace("|", r"\|")


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "†": r"$^\dagger$",
    "→": r"$\to$",
    "°": r"$^\circ$",
    "²": r"$^2$",
    "<": "$<$",
    ">": "$>$",
}


def _escape_latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
