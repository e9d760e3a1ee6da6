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
from benchmarks.reporting.tables.notes import seeds_notes
from benchmarks.reporting.tables.table import Table, TableCell

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
    result = [("full", row) for row in rows(results)]
    for ablation in _ablations(results)[1:]:
        row = row_of(results, "rainbow", IN_TURN, ablation=ablation)
        result += [(ablation, row)] if row.group.n or row.group.planned else []
    result = sorted([*result, *at_once], key=lambda pair: _order(*pair))
    optimum = results.group(OPTIMUM_AT_ONCE)
    header = ["Method", "Components", "Robots move", "Decided by", "Success (%)"]
    header += [*(metric.label for metric in SHOWN), "Ticks over the optimum at once (%)"]
    made: list[list[TableCell]] = []
    for ablation, row in result:
        cells = [row.cell(row.success())]
        cells += [row.cell(row.value(metric), metric.digits) for metric in SHOWN]
        excess = row.cell(excess_over_optimum(row.group, optimum))
        made.append([*_head(ablation, row), *cells, excess])
    notes = [
        *seeds_notes({f"{row.name}, {ablation}": row.group for ablation, row in result}),
        "In turn a tick moves one robot, at once both. Ticks over the optimum: up to the first "
        "insertion, on starts that both solved.",
        *(answer for ablation in _ablations(results) for answer in _answers(results, ablation)),
    ]
    title = "Two robots: both at once or in turn, one agent or two"
    return [Table("team", title, header, made, notes, left=(0, 1, 2, 3))]


def _ablations(results: Results) -> list[str]:
    """Those of Rainbow that a team has or is to have, the full one first."""
    result = [
        ablation
        for ablation in labels.ABLATIONS
        if any(
            group.n or group.planned
            for track in results.teams()
            for group in [results.group("rainbow", track=track, ablation=ablation)]
        )
    ]
    return ["full", *(ablation for ablation in result if ablation != "full")]


def at_once_rows(results: Results) -> list[tuple[str, Row]]:
    """All methods of robots that move at once, each with its ablation."""
    result = [
        (ablation, row_of(results, method, track, ablation=ablation))
        for ablation in _ablations(results)
        for track in results.teams()
        for method in (METHODS if ablation == "full" else ("rainbow",))
    ]
    result.append(("full", row_of(results, OPTIMUM_AT_ONCE)))
    return [(ablation, row) for ablation, row in result if row.group.n or row.group.planned]


def _of(row: Row) -> str:
    return str((row.settings or {}).get("team") or "")


def _at_once(row: Row) -> bool:
    return bool(_of(row)) or row.method == OPTIMUM_AT_ONCE


def _order(ablation: str, row: Row) -> tuple[int, int, bool]:
    """Learners, the components together, then scripts and planners; in turn before at once."""
    names = list(labels.ABLATIONS)
    return METHODS.index(row.method), names.index(ablation), _at_once(row)


def _head(ablation: str, row: Row) -> list[TableCell]:
    """Method, its components, whether both robots move at once, and who decides."""
    kind, learns = _of(row), row.method == "rainbow"
    name = LEARNERS.get(kind, "Rainbow") if learns else labels.METHODS[row.method]
    sees = ", in sight" if (row.settings or {}).get("sight") else ", without sight"
    decided = f"each robot{sees}" if kind not in ("", "central") else "one for both"
    return [
        *(name.removesuffix(", both at once"), labels.ABLATIONS[ablation] if learns else "-"),
        *("at once" if _at_once(row) else "in turn", decided),
    ]


def _answers(results: Results, ablation: str) -> list[str]:
    """What decentralization costs, and what moving at once changes, as far as there are runs."""
    pairs = at_once_rows(results)
    learned = complete(row for a, row in pairs if row.method == "rainbow" and a == ablation)
    central = next((row for row in learned if _of(row) == "central"), None)
    costs = [] if central is None else _costs(central, [r for r in learned if r is not central])
    compared = []
    if ablation == "full":
        optima = results.group("optimum"), results.group(OPTIMUM_AT_ONCE)
        compared.append(("the exact optimum", *optima))
    if central is not None:
        alone = results.group("rainbow", track=IN_TURN, ablation=ablation)
        compared.append(("Rainbow", alone, central.group))
    gains = [
        f"{name} changes its ticks by {_signed(excess_over_optimum(at_once, in_turn), ' %')}, its "
        f"success rate by {_signed(_change(at_once, in_turn), ' points')}"
        for name, in_turn, at_once in compared
        if in_turn.n and at_once.n
    ]
    what = labels.ABLATIONS[ablation]
    answers = {"what decentralization costs": costs, "what moving at once changes": gains}
    return [
        f"{what}, {question}: {'; '.join(parts)}." for question, parts in answers.items() if parts
    ]


def _costs(central: Row, others: list[Row]) -> list[str]:
    """The best decentralized learner with and without sight, beside the central one."""
    parts = [f"the central Rainbow has {central.success().mean:.1f} %"]
    for sight, words in ((True, "in sight"), (False, "without sight")):
        seen = [row for row in others if bool((row.settings or {}).get("sight")) == sight]
        if seen:
            best = max(seen, key=lambda row: row.success().mean)
            change = _signed(_change(best.group, central.group), " points")
            parts.append(f"{words} {LEARNERS[_of(best)]}, the best, changes that by {change}")
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
    if not value.n:
        return "-"
    interval = "" if math.isnan(value.low) else f" {value.interval_text(1)}"
    return f"{value.mean:+.1f}{unit}{interval}"
