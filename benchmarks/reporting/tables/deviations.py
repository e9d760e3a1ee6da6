"""Every cell where the paper's number lies outside our interval, with the reason if it is known.

Reasons are kept in ``reasons.yaml``, apart from the data: a list of

    - table: performance              # which table
      row: Avg. alignment error (deg) # its row; * and ? stand for anything
      columns: [Rainbow DQN, *]       # its columns (quoted in YAML where they have a comma)
      presets: [quick]                # left out: every preset
      reason: what makes the difference

A reason whose cells are no longer flagged is stale, and :func:`stale_reasons` names it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

import yaml

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.strict import STRICT, build, with_config
from benchmarks.reporting.tables.table import FLAG, Cell, Number, Table

REASONS: Final = Path(__file__).parent / "reasons.yaml"
UNKNOWN: Final = "not explained yet"
FLAG_NOTE: Final = (
    f"{FLAG} no number that rounds to the paper's lies in our 95 % interval; the reasons are in "
    "the table `deviations`."
)


@with_config(STRICT)
@dataclass(frozen=True)
class Reason:
    """Why the paper's number lies outside our interval in some cells of a table."""

    table: str
    row: str
    columns: list[str]
    reason: str
    presets: list[str] = field(default_factory=list)

    def covers(self, preset: str, table: str, row: str, column: str) -> bool:
        """Whether it speaks of that cell."""
        return (
            (not self.presets or preset in self.presets)
            and self.table == table
            and fnmatchcase(row, self.row)
            and any(fnmatchcase(column, pattern) for pattern in self.columns)
        )


@dataclass(frozen=True)
class Compared:
    """A cell of ours that stands against a number of the paper."""

    table: str
    row: str
    column: str
    number: Number
    knows: tuple[str, str]


def load_reasons(path: Path = REASONS) -> list[Reason]:
    """The reasons that are on record.

    Raises:
        BenchmarkError: the file is not valid YAML, or an entry has an unknown or missing key.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise BenchmarkError(f"{path.name}: not valid YAML: {error}") from error
    if not isinstance(data, list):
        raise BenchmarkError(f"{path.name}: expected a list of reasons, found {data!r}")
    return [build(Reason, item, f"{path.name}[{i}]") for i, item in enumerate(data)]


def compared_cells(tables: Sequence[Table]) -> Iterator[Compared]:
    """Cells that could be held against the paper, in the order of the tables."""
    for table in tables:
        for row in table.rows:
            for column, cell in zip(table.header, row, strict=True):
                if isinstance(cell, Number) and cell.judged:
                    named = dict(zip(table.header, row, strict=True))
                    knows = (str(named.get("Masks", "-")), str(named.get("Memory", "-")))
                    yield Compared(table.name, str(row[0]), column, cell, knows)


def deviations(
    tables: Sequence[Table], preset: str, reasons: Sequence[Reason] | None = None
) -> Table:
    """Table "deviations": the flagged cells of the paper's tables, each with its reason."""
    known = load_reasons() if reasons is None else reasons
    cells = list(compared_cells(tables))
    rows: list[list[Cell]] = []
    for cell in cells:
        if not cell.number.flagged:
            continue
        place = (cell.table, cell.row, cell.column)
        reason = next((r.reason for r in known if r.covers(preset, *place)), UNKNOWN)
        interval = cell.number.value.interval_text(cell.number.digits + 1)
        ours = cell.number.plain()
        rows.append([*place[:2], *cell.knows, place[2], cell.number.paper, ours, interval, reason])
    notes = [
        f"{len(cells)} cells of ours have an interval and a number of the paper beside them; in "
        f"{len(rows)} no number that rounds to the paper's lies in the interval."
    ]
    header = ["Table", "Row", "Masks", "Memory", "Column", "Paper", "Ours"]
    header += ["95 % interval", "Reason"]
    title = "Where the paper's number lies outside our interval"
    return Table("deviations", title, header, rows, notes, left=(0, 1, 2, 3, 4), prose=(8,))


def stale_reasons(
    tables: Sequence[Table], preset: str, reasons: Sequence[Reason] | None = None
) -> list[str]:
    """A sentence for each reason that names no cell, or only cells that are not flagged."""
    known = load_reasons() if reasons is None else reasons
    by_name = {table.name: table for table in tables}
    problems = []
    for reason in known:
        if reason.presets and preset not in reason.presets:
            continue
        where = f"{REASONS.name}: {reason.table}, '{reason.row}', {reason.columns}"
        table = by_name.get(reason.table)
        if table is None or not any(fnmatchcase(str(row[0]), reason.row) for row in table.rows):
            problems.append(f"{where}: there is no such table or row")
            continue
        cells = [
            cell
            for cell in compared_cells([table])
            if reason.covers(preset, cell.table, cell.row, cell.column)
        ]
        # a column that this preset does not have, or that is not complete, proves nothing
        if cells and not any(cell.number.flagged for cell in cells):
            problems.append(f"{where}: the paper's number is in our interval now; take it out")
    return problems
