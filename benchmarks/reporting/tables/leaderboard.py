"""The leaderboard: every method of a store, and what others brought, on the same test episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from benchmarks.protocol.knowledge import Knowledge, knowledge
from benchmarks.protocol.metrics import HOLES, METRICS
from benchmarks.protocol.plan import CONTROLS, LEARNERS
from benchmarks.reporting.results import MAIN, Group, Level, Result, Results, excess_over_optimum
from benchmarks.reporting.rows import KNOWS, complete, rows
from benchmarks.reporting.tables.table import Cell, Number, Table
from benchmarks.runs.store import Store

GEOMETRY: Final = "optimized"
OPTIMUM: Final = "Exact optimum"
NOISE: Final = 0.01


@dataclass(frozen=True)
class Place:
    """A method on the board."""

    name: str
    kind: str
    knows: Knowledge
    group: Group
    models: int  # trained networks behind the seeds; 0 for a planner or a control


def places(store: Store, results: Results) -> list[Place]:
    """All methods on the nominal machine, the best success first; the optimum above them all."""
    found = []
    for row in complete(rows(results)):
        if row.level != MAIN:
            continue
        learns = row.method in LEARNERS
        kind = "learner" if learns else "control" if row.method in CONTROLS else "planner"
        found.append(Place(row.name, kind, row.knows, row.group, learns * row.group.n))
    brought: dict[str, list[Result]] = {}
    for folder in store.entered():
        result = Result.read(folder)
        brought.setdefault(result.config["cell"]["method"], []).append(result)
    for name, runs in brought.items():
        entry = runs[0].config["entry"]
        models = len({run.config["entry"]["sha256"] for run in runs} - {""})
        group = Group(tuple(sorted(runs, key=lambda run: run.seed)))
        knows = knowledge("", entry) if entry["sha256"] else knowledge("", None)
        found.append(Place(name, f"brought: {entry['algorithm']}", knows, group, models))
    return sorted(found, key=_order)


def _order(place: Place) -> tuple[bool, float, float, str]:
    success = place.group.success().mean
    return place.name != OPTIMUM, -success, -place.group.value(HOLES).mean, place.name


def leaderboard(store: Store, results: Results) -> Table:
    """Table "leaderboard": a row per method, ranked by success rate, then by holes filled."""
    optimum = results.group("optimum", GEOMETRY)
    all_holes, time_first = METRICS["all_holes"], METRICS["time_first"]
    rows: list[list[Cell]] = []
    rank = 0
    for place in places(store, results):
        group = place.group
        ceiling = place.name == OPTIMUM
        rank += not ceiling
        success = group.success()
        rows.append([
            "-" if ceiling else str(rank),
            place.name,
            "ceiling" if ceiling else place.kind,
            place.knows.masks,
            place.knows.memory,
            Number(success, 1),
            success.interval_text(1),
            Number(group.value(HOLES), HOLES.digits),
            Number(group.value(all_holes), all_holes.digits),
            Number(group.value(time_first), time_first.digits),
            Number(excess_over_optimum(group, optimum), 1),
            Number(group.success(Level(NOISE)), 1),
            str(group.n),
            str(place.models) if place.models else "-",
        ])  # fmt: skip
    header = [
        *("Rank", "Method", "Kind", *KNOWS, "Success (%)", "95 % interval"),
        *("Holes (of 6)", "All six (%)", "First insertion (s)", "Moves over the optimum (%)"),
        *(f"Success (%), noise {NOISE:g}", "Seeds", "Models"),
    ]
    notes = [
        "Optimized geometry, all methods on the same initial states. Models: trained networks "
        "behind the seeds; where there is one, the spread is that of the test episodes alone.",
        "Join with one command: python -m benchmarks evaluate --model FILE --name NAME",
    ]
    return Table("leaderboard", "Leaderboard", header, rows, notes, left=(0, 1, 2, 3, 4))
