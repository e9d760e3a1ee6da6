"""How much of the figures is the task: success where tolerance, step or holes change.

The paper has no such table.
"""

from __future__ import annotations

from typing import Final

from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import AS_TRAINED, Row, row_of
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.notes import of_rows, seeds_notes
from benchmarks.reporting.tables.table import Table, TableCell

# column -> method, geometry
SHOWN: Final[dict[str, tuple[str, str]]] = {
    "Optimum, initial geometry": ("optimum", "initial"),
    "Optimum": ("optimum", "optimized"),
    "RRT-Connect": ("rrt_connect", "optimized"),
    "Greedy script": ("greedy", "optimized"),
    "Lookahead": ("lookahead", "optimized"),
    "Rainbow": ("rainbow", "optimized"),
}


def tracks_of(results: Results) -> list[str]:
    """Tracks that change the task and nothing else, in the preset's order."""
    return [track for track in results.tracks() if (results.settings(track) or {}).get("task")]


def success(row: Row) -> Value:
    """Of a learner as trained, a script with 5 % of random moves, a planner's one way of acting."""
    exploring = row.group.success(AS_TRAINED)
    return exploring if exploring.n else row.success()


def difficulty(results: Results) -> Table:
    """Table "difficulty": success rate (%) by task, one row for each track that changes it."""
    made: list[list[TableCell]] = []
    result: list[Row] = []
    for track in tracks_of(results):
        rows = [row_of(results, method, track, geometry) for method, geometry in SHOWN.values()]
        result += rows
        cells = [row.cell(success(row)) if row.group.known else "-" for row in rows]
        made.append([track.replace("_", " "), *cells])
    notes = [
        *seeds_notes(of_rows(result)),
        "As stated: 10 mm and 5 degrees, moves of 20 mm and 0.03 rad, holes at 30 degrees, a "
        "collision refuses the move. Each row changes what it names; the best possible step "
        "sequence is the optimum's. Scripts act with 5 % of random moves, Rainbow as trained, all "
        "under the paper's masks.",
    ]
    return Table("difficulty", "Success rate (%) by task", ["Task", *SHOWN], made, notes)
