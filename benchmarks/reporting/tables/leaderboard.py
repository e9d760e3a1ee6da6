"""The leaderboard: every method of a store, and what others brought, on the same test episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from benchmarks.protocol.knowledge import Knowledge, knowledge
from benchmarks.protocol.metrics import HOLES
from benchmarks.reporting.results import Group, Result, Results
from benchmarks.reporting.rows import AS_TRAINED, KNOWS, complete, rows
from benchmarks.reporting.tables.table import Number, Table, TableCell
from benchmarks.runs.store import Store

OPTIMUM: Final = "Exact optimum"


@dataclass(frozen=True)
class Place:
    """A method on the board."""

    name: str
    knows: Knowledge
    group: Group


def places(store: Store, results: Results) -> list[Place]:
    """All methods on the nominal machine, the best success first; the optimum above them all."""
    found = [Place(row.name, row.knows, row.group) for row in complete(rows(results))]
    brought: dict[str, list[Result]] = {}
    for folder in store.entered():
        result = Result.read(folder)
        brought.setdefault(result.config["cell"]["method"], []).append(result)
    for name, runs in brought.items():
        entry = runs[0].config["entry"]
        group = Group(tuple(sorted(runs, key=lambda run: run.seed)))
        knows = knowledge("", entry) if entry["sha256"] else knowledge("", None)
        found.append(Place(name, knows, group))
    return sorted(found, key=_order)


def brought_notes(store: Store) -> list[str]:
    """Who was brought, and how many trained networks are behind the seeds."""
    found: dict[str, tuple[str, set[str]]] = {}
    for folder in store.entered():
        config = folder.config()
        algorithm, models = config["entry"]["algorithm"], {config["entry"]["sha256"]} - {""}
        name = config["cell"]["method"]
        found[name] = (algorithm, found.get(name, ("", set()))[1] | models)
    report = [
        f"{name} ({algorithm}" + (f", models: {len(models)})" if models else ")")
        for name, (algorithm, models) in found.items()
    ]
    return [f"Brought: {', '.join(report)}."] if report else []


def _order(place: Place) -> tuple[bool, float, float, str]:
    success = place.group.success().mean
    return place.name != OPTIMUM, -success, -place.group.value(HOLES).mean, place.name


def leaderboard(store: Store, results: Results) -> Table:
    """Table "leaderboard": a row per method, ranked by greedy success rate, then by holes."""
    made: list[list[TableCell]] = []
    rank = 0
    for place in places(store, results):
        group, ceiling = place.group, place.name == OPTIMUM
        rank += not ceiling
        trained = group.success(AS_TRAINED)
        made.append([
            "-" if ceiling else str(rank), place.name, place.knows.masks, place.knows.memory,
            Number(group.success(), 1), Number(trained, 1) if trained.n else "-",
            Number(group.value(HOLES), HOLES.digits),
        ])  # fmt: skip
    header = ["Rank", "Method", *KNOWS, "Success (%)", "Exploring (%)", HOLES.label]
    notes = [
        "Optimized geometry, all methods on the same initial states; success and holes of greedy "
        "acting. Exploring: learners as they were trained, scripts with 5 % of random moves.",
        *brought_notes(store),
        "Join with one command: python -m benchmarks evaluate --model FILE --name NAME",
    ]
    return Table("leaderboard", "Leaderboard", header, made, notes, left=(1, 2, 3))
