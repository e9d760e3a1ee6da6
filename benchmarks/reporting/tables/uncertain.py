"""The machine whose base stands where the model does not know: every method, every size of error.

The paper has no such table; it is the ground of its claim that a learned policy in closed loop
beats a planner.
"""

from __future__ import annotations

from benchmarks.protocol.metrics import HOLES
from benchmarks.reporting.results import Level, Results
from benchmarks.reporting.rows import KNOWS, complete, rows
from benchmarks.reporting.tables.notes import of_rows, seeds_notes
from benchmarks.reporting.tables.table import Table, TableCell


def error_levels(results: Results) -> list[float]:
    """Bounds of the base's displacement, mm, that any run was tested at."""
    tested = [row.group for row in complete(rows(results, uncertain=True))]
    return sorted({error for group in tested for run in group.runs for _, error, _ in run.levels})


def uncertain(results: Results) -> Table:
    """Table "uncertain": each method at its track's own bound, then at the ends."""
    levels = error_levels(results)
    ends = [levels[0], levels[-1]] if levels else []
    header = ["Method", *KNOWS, "Success (%)", HOLES.label]
    header += [f"Success (%) at {level:g} mm" for level in ends]
    made: list[list[TableCell]] = []
    result = rows(results, uncertain=True)
    for row in result:
        cells = [row.cell(row.success()), row.cell(row.value(HOLES), HOLES.digits)]
        cells += [row.cell(row.group.success(Level(error=level))) for level in ends]
        made.append([*row.head, *cells])
    bounds = sorted({run.error for row in result for run in row.group.runs})
    notes = seeds_notes(of_rows(result))
    notes += [
        f"The base of the 3-RRS is displaced by up to {bound:g} mm along each axis and tilted in "
        "proportion, drawn anew each episode; masks, observations and plans are those of the "
        "nominal model."
        for bound in bounds
    ]
    title = "Success on the uncertain machine"
    return Table("uncertain", title, header, made, notes, left=(0, 1, 2))
