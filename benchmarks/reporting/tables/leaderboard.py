"""The leaderboard: every method of a store, and what others brought, on the same test episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from benchmarks.protocol.metrics import HOLES, METRICS
from benchmarks.reporting.results import Group, Result, Results, excess_over_optimum
from benchmarks.reporting.tables.statistics import configurations
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
    group: Group
    models: int  # trained networks behind the seeds; 0 for a planner


def places(store: Store, results: Results) -> list[Place]:
    """All methods, the best success rate first; the optimum above them all."""
    found = []
    for name, group in configurations(results):
        learns = bool(group.runs[0].config["cell"]["track"])
        found.append(Place(name, "learner" if learns else "planner", group, learns * group.n))
    brought: dict[str, list[Result]] = {}
    for folder in store.entered():
        config = folder.config()
        result = Result(
            config["cell"]["seed"], config, folder.meta(), folder, folder.rows("episodes")
        )
        brought.setdefault(config["cell"]["method"], []).append(result)
    for name, runs in brought.items():
        entry = runs[0].config["entry"]
        models = len({run.config["entry"]["sha256"] for run in runs} - {""})
        group = Group(tuple(sorted(runs, key=lambda run: run.seed)))
        found.append(Place(name, f"brought: {entry['algorithm']}", group, models))
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
            Number(success, 1),
            success.interval_text(1),
            Number(group.value(HOLES), HOLES.digits),
            Number(group.value(all_holes), all_holes.digits),
            Number(group.value(time_first), time_first.digits),
            Number(excess_over_optimum(group, optimum), 1),
            Number(group.success(NOISE), 1),
            str(group.n),
            str(place.models) if place.models else "-",
        ])  # fmt: skip
    header = [
        *("Rank", "Method", "Kind", "Success (%)", "95 % interval", "Holes (of 6)"),
        *("All six (%)", "First insertion (s)", "Moves over the optimum (%)"),
        *(f"Success (%), noise {NOISE:g}", "Seeds", "Models"),
    ]
    notes = [
        "Optimized geometry, all methods on the same initial states. Models: trained networks "
        "behind the seeds; where there is one, the spread is that of the test episodes alone.",
        "Join with one command: python -m benchmarks evaluate --model FILE --name NAME",
    ]
    return Table("leaderboard", "Leaderboard", header, rows, notes, left=(0, 1, 2))
