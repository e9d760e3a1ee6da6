"""What stands under a table: how many runs are behind it, and why planners failed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from benchmarks.protocol import labels
from benchmarks.reporting.results import Group, Results
from benchmarks.reporting.rows import Row

BASELINES: Final = ("rrt_connect", "rrt_lattice")


def of_rows(result: Iterable[Row]) -> dict[str, Group]:
    """The runs behind rows, by the rows' names."""
    return {row.name: row.group for row in result}


def seeds_notes(groups: dict[str, Group]) -> list[str]:
    """How many seeds and episodes are behind the numbers, and which groups are not complete."""
    seeds = sorted({group.n for group in groups.values() if group.n})
    lengths = sorted({len(run.test()) for group in groups.values() for run in group.runs})
    if not seeds:
        return ["No run of this preset is complete."]
    episodes = "/".join(str(n) for n in lengths)
    if seeds == [1]:
        first = f"Ours: n = 1 seed x {episodes} test episodes, so no spread can be given."
    else:
        counts = "/".join(str(n) for n in seeds)
        first = f"Ours: mean ± std over n = {counts} seeds x {episodes} test episodes."
    partial = [
        f"{name} {group.n} of {group.planned} seeds"
        for name, group in groups.items()
        if group.n < group.planned
    ]
    return [first, *([f"Not complete: {'; '.join(partial)}."] if partial else [])]


def failure_notes(results: Results) -> list[str]:
    """Why the planners of the paper did not insert, and how long they planned."""
    notes = []
    for method in BASELINES:
        pooled = results.group(method).pooled()
        if not len(pooled) or "failure" not in pooled:
            continue
        failed = pooled[pooled["success"] == 0]
        causes = failed["failure"].value_counts()
        text = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items()))
        notes.append(
            f"{labels.METHODS[method]}: {len(failed)} of {len(pooled)} episodes without an "
            "insertion"
            + (f" ({text})" if text else "")
            + f"; median planning time {1000 * pooled['plan_seconds'].median():.1f} ms."
        )
    return notes
