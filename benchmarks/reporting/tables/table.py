"""A table as CSV (numbers apart), Markdown and LaTeX (booktabs)."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pandas as pd

from benchmarks.reporting.stats import Value
from benchmarks.runs.store import write_text

FLAG: Final = "†"
MISSING: Final = "missing"  # in place of a number whose runs are planned
FLAG_NOTE: Final = f"{FLAG} the paper's value, rounded as printed, is outside our 95 % interval."
_NUMBER: Final = re.compile(r"-?\d+(?:\.(\d+))?")
NARROW: Final = 5  # columns of a table that fits one column of a paper


@dataclass(frozen=True)
class Number:
    """A cell with a value of ours.

    ``paper`` is what the paper prints for it, ``shown`` is printed in place of the value, and
    ``differs`` says whether the two disagree where the interval alone cannot tell.
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

    def text(self) -> str:
        """The value as printed, with a flag if the paper's number lies outside our interval."""
        plain = self.shown or self.value.text(self.digits) + (self.suffix if self.value.n else "")
        return f"{plain} {FLAG}" if self.flagged else plain


TableCell = str | Number


def printed_range(text: str) -> tuple[float, float] | None:
    """The ends of what rounds to what is printed, None where no number is.

    >>> printed_range("1.16 ± 0.05")
    (1.155, 1.165)
    """
    match = _NUMBER.match(text)
    if match is None:
        return None
    digits, number = len(match[1] or ""), float(match[0])
    half = 0.5 * 10.0**-digits
    return round(number - half, digits + 1), round(number + half, digits + 1)


@dataclass(frozen=True)
class Table:
    """A table with the notes under it; ``left`` are the columns set flush left."""

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

    @property
    def holds_results(self) -> bool:
        """Whether a cell has a number of ours, or says that the number is to come."""
        cells = [cell for row in self.rows for cell in row]
        return MISSING in cells or any(isinstance(cell, Number) for cell in cells)

    def texts(self) -> list[list[str]]:
        """All cells as printed."""
        return [[cell if isinstance(cell, str) else cell.text() for cell in r] for r in self.rows]

    def markdown(self) -> str:
        """GitHub-flavoured Markdown with the title above and the notes below."""
        columns = []
        for i, column in enumerate(zip(self.header, *self.texts(), strict=True)):
            texts = [text.replace("|", r"\|") for text in column]
            width, left = max(map(len, texts)), i in self.left
            padded = [text.ljust(width) if left else text.rjust(width) for text in texts]
            padded.insert(1, "-" * width if left else "-" * (width - 1) + ":")
            columns.append(padded)
        lines = [f"| {' | '.join(row)} |" for row in zip(*columns, strict=True)]
        notes = ["", *[f"- {note}" for note in self.notes]] if self.notes else []
        return "\n".join([f"**{self.title}**", "", *lines, *notes]) + "\n"

    def latex(self) -> str:
        """A booktabs ``table``, across both columns if wide; needs ``\\usepackage{booktabs}``."""
        environment = "table" if len(self.header) <= NARROW else "table*"
        columns = "".join("l" if i in self.left else "c" for i in range(len(self.header)))
        head, *body = [
            "        " + " & ".join(text.translate(_LATEX) for text in row) + r" \\"
            for row in (self.header, *self.texts())
        ]
        lines = [
            r"% needs \usepackage{booktabs}",
            rf"\begin{{{environment}}}[t]",
            rf"    \caption{{{self.title.translate(_LATEX)}}}",
            rf"    \label{{tab:{self.name}}}",
            r"    \centering",
            rf"    \begin{{tabular}}{{{columns}}}",
            *(r"        \toprule", head, r"        \midrule", *body, r"        \bottomrule"),
            r"    \end{tabular}",
            *(rf"    \par\footnotesize {note.translate(_LATEX)}" for note in self.notes),
            rf"\end{{{environment}}}",
        ]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """CSV: a column of numbers becomes mean, std, n, low and high."""
        columns: list[list[str]] = []
        for i, texts in enumerate(zip(self.header, *self.texts(), strict=True)):
            columns.append([*texts])
            cells = [row[i] for row in self.rows]
            if any(isinstance(cell, Number) for cell in cells):
                parts = [(part, [_part(cell, part) for cell in cells]) for part in _PARTS]
                columns += [[f"{texts[0]} | {part}", *numbers] for part, numbers in parts]
        lines = pd.DataFrame(zip(*columns, strict=True))
        return lines.to_csv(index=False, header=False, lineterminator="\n")

    def files(self, folder: Path) -> dict[Path, str]:
        """Its three files in a folder, and what is in them."""
        forms = {"csv": self.csv(), "md": self.markdown(), "tex": self.latex()}
        return {folder / f"{self.name}.{suffix}": text for suffix, text in forms.items()}

    def write(self, folder: Path) -> list[Path]:
        """Write all three files, atomically."""
        texts = self.files(folder)
        for path, text in texts.items():
            write_text(path, text)
        return [*texts]


def plain(title: str, header: str, rows: Iterable[Iterable[str]]) -> str:
    """A table of texts as Markdown, the header's columns parted by `` | ``."""
    return Table("", title, header.split(" | "), [list(row) for row in rows]).markdown().strip()


def p_text(value: float) -> str:
    """A p, or a dash."""
    return "-" if math.isnan(value) else "< 0.001" if value < 0.001 else f"{value:.2g}"


_PARTS = ("mean", "std", "n", "low", "high")


def _part(cell: TableCell, part: str) -> str:
    number = math.nan if isinstance(cell, str) else float(getattr(cell.value, part))
    return "" if math.isnan(number) else f"{number:.7g}"


_LATEX: Final = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        **{mark: rf"\{mark}" for mark in "&%#_{}"},
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
)
