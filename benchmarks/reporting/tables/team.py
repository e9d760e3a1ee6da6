"""Both robots at once: central, decentralized and in turn, over the exact optimum at once."""

from __future__ import annotations

import math
from typing import Final

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, METRICS
from benchmarks.protocol.plan import METHODS, OPTIMUM_AT_ONCE
from benchmarks.reporting.results import Group, Results, excess_over_optimum
from benchmarks.reporting.rows import Row, complete, row_of, rows
from benchmarks.reporting.stats import Value, mean_interval, measured
from benchmarks.reporting.tables.notes import of_rows, seeds_notes
from benchmarks.reporting.tables.table import Cell, Table

IN_TURN: Final = "in_turn"  # the track of one robot at a time with the settings of the teams
SHOWN: Final = (METRICS["time_first"], HOLES, METRICS["collisions"])
LEARNERS: Final = {
    "central": "Rainbow on 49 joint moves",
    "vdn": "VDN, a sum of two Rainbows",
    "shared": "Rainbow with shared parameters",
    "independent": "Independent Rainbows",
}


def team(results: Results) -> list[Table]:
    """Table "team", where a store has such runs: who moves, who decides in sight of what."""
    at_once = at_once_rows(results)
    if not at_once:
        return []
    found = [*rows(results), *at_once]
    optimum = results.group(OPTIMUM_AT_ONCE)
    header = ["Method", "Robots move", "Decided by", "Success (%)", "95 % interval"]
    header += [*(metric.label for metric in SHOWN), "Ticks over the optimum at once (%)"]
    made: list[list[Cell]] = []
    for row in found:
        success = row.success()
        cells = [row.cell(success), success.interval_text(1)]
        cells += [row.cell(row.value(metric), metric.digits) for metric in SHOWN]
        made.append([*_head(row), *cells, row.cell(excess_over_optimum(row.group, optimum))])
    notes = [
        *seeds_notes(of_rows(found)),
        "In turn a tick moves one robot, at once both. Ticks over the optimum: up to the first "
        "insertion, on starts that both solved.",
        *_answers(results),
    ]
    title = "Two robots: both at once or in turn, one agent or two"
    return [Table("team", title, header, made, notes, left=(0, 1, 2))]


def at_once_rows(results: Results) -> list[Row]:
    """All methods of robots that move at once, the ceiling last."""
    found = [
        row_of(results, method, track)
        for track in results.teams()
        for method, _ in results.methods(track)
    ]
    found.sort(key=lambda row: METHODS.index(row.method))
    ceiling = [row_of(results, method) for method, _ in results.methods("", (OPTIMUM_AT_ONCE,))]
    return found + ceiling


def _of(row: Row) -> str:
    return str((row.settings or {}).get("team") or "")


def _head(row: Row) -> list[Cell]:
    """Method, whether both robots move at once, and who decides."""
    kind = _of(row)
    at_once = bool(kind) or row.method == OPTIMUM_AT_ONCE
    name = LEARNERS.get(kind, "Rainbow") if row.method == "rainbow" else labels.METHODS[row.method]
    sees = ", in sight" if (row.settings or {}).get("sight") else ", without sight"
    decided = f"each robot{sees}" if kind not in ("", "central") else "one for both"
    return [name.removesuffix(", both at once"), "at once" if at_once else "in turn", decided]


def _answers(results: Results) -> list[str]:
    """What decentralization costs, and what moving at once gains, as far as there are runs."""
    learned = complete(row for row in at_once_rows(results) if row.method == "rainbow")
    central = next((row for row in learned if _of(row) == "central"), None)
    costs = [] if central is None else _costs(central, [r for r in learned if r is not central])
    pairs = [("the exact optimum", results.group("optimum"), results.group(OPTIMUM_AT_ONCE))]
    if central is not None:
        pairs.append(("Rainbow", results.group("rainbow", track=IN_TURN), central.group))
    gains = [
        f"{name} takes {_signed(excess_over_optimum(at_once, in_turn), ' %')} ticks to the first "
        f"insertion, on starts that it solved both ways, and its success rate changes by "
        f"{_signed(_change(at_once, in_turn), ' points')}"
        for name, in_turn, at_once in pairs
        if in_turn.n and at_once.n
    ]
    told = {"What decentralization costs": costs, "What moving at once changes": gains}
    return [f"{what}: {'; '.join(parts)}." for what, parts in told.items() if parts]


def _costs(central: Row, others: list[Row]) -> list[str]:
    """The best decentralized learner with and without sight, beside the central one."""
    parts = [f"the central Rainbow inserts in {central.success().mean:.1f} % of the episodes"]
    for sight, words in ((True, "in sight of each other"), (False, "without sight")):
        seen = [row for row in others if bool((row.settings or {}).get("sight")) == sight]
        if seen:
            best = max(seen, key=lambda row: row.success().mean)
            change = _signed(_change(best.group, central.group), " points")
            parts.append(f"{words} the best of the others, {LEARNERS[_of(best)]}, in {change}")
    return parts if len(parts) > 1 else []


def _change(ours: Group, theirs: Group) -> Value:
    """Difference of the success rates on the same starts, in points, over the seeds of both."""
    before = {run.seed: run.test()["success"].to_numpy(float) for run in theirs.runs}
    changes = [
        100.0 * (run.test()["success"].to_numpy(float) - before[run.seed])
        for run in ours.runs
        if run.seed in before and len(run.test()) == len(before[run.seed])
    ]
    return measured([each.mean() for each in changes], lambda: mean_interval(changes[0]))


def _signed(value: Value, unit: str) -> str:
    interval = "" if math.isnan(value.low) else f" {value.interval_text(1)}"
    return f"{value.mean:+.1f}{unit}{interval}"
