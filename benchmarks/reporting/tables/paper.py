"""The paper's tables from stored data alone: its values beside ours, controls and ceiling in all.

Nothing is trained or re-evaluated here, and torch is not imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.metrics import EXTRA_METRICS, HOLES, METRICS, OWN_MASKS, PAPER_METRICS
from benchmarks.protocol.plan import LEARNERS
from benchmarks.reporting.compared import SCORED
from benchmarks.reporting.results import Group, Level, Results
from benchmarks.reporting.rows import KNOWS, Row, complete, control_of, row_of, rows
from benchmarks.reporting.stats import (
    Value,
    interquartile_mean,
    mean_interval,
    stratified_bootstrap,
)
from benchmarks.reporting.tables.geometric import design
from benchmarks.reporting.tables.leaderboard import leaderboard
from benchmarks.reporting.tables.notes import failure_notes, interval_note, of_rows, seeds_notes
from benchmarks.reporting.tables.significance import signed, significance
from benchmarks.reporting.tables.table import FLAG_NOTE, Cell, Number, Table
from benchmarks.reporting.tables.team import team
from benchmarks.reporting.tables.uncertain import uncertain
from benchmarks.runs.store import Store

# those that a run prints; the others are written beside them
PRINTED: Final = (
    *("design", "performance", "ablation", "geometry", "robustness", "uncertain", "team"),
)
NOISE: Final = 0.01  # the level of the paper's section "Robustness"
NOISY: Final = (*LEARNERS, "greedy_observed", "lookahead_observed")  # what sees the observation
ENDS: Final = ("initial", "optimized")
IQM: Final = "Success rate, IQM over seeds [95 % interval]"


def build_tables(store: Store) -> list[Table]:
    """All tables of a store, in the paper's order."""
    results = Results(store)
    return [
        design(results),
        performance(results),
        significance(results),
        ablation(results),
        geometry(results),
        robustness(results),
        uncertain(results),
        leaderboard(store, results),
        *team(results),
    ]


def write_tables(store: Store, tables: list[Table] | None = None) -> list[Path]:
    """Write every table as CSV, Markdown and LaTeX."""
    built = build_tables(store) if tables is None else tables
    return [path for table in built for path in table.write(store.tables)]


def _paper_head(method: str) -> list[Cell]:
    """The first cells of a row of the paper's own figures."""
    masks = "paper's" if method == "rainbow" else "not given"
    memory = "none" if method in LEARNERS else "its plan"
    return [f"{labels.METHODS[method]}, paper", masks, memory]


def performance(results: Results) -> Table:
    """Table "performance": the paper's six metrics and ours beyond them, a row per method."""
    metrics = (*PAPER_METRICS, *EXTRA_METRICS)
    header = ["Method", *KNOWS, *(metric.label for metric in metrics)]
    header += ["Moves to first insertion over the optimum (%)", IQM]
    made: list[list[Cell]] = []
    for method in paper_values.PERFORMANCE["success"]:
        printed = [paper_values.PERFORMANCE.get(metric.key, {}) for metric in metrics]
        made.append([*_paper_head(method), *(each.get(method, "-") for each in printed), "-", "-"])
    found = rows(results)
    for row in found:
        cells = [
            row.cell(
                row.value(metric),
                metric.digits,
                paper_values.PERFORMANCE.get(metric.key, {}).get(row.method, ""),
            )
            for metric in metrics
        ]
        made.append([*row.head, *cells, row.cell(row.excess(results)), _iqm(row)])
    notes = [*seeds_notes(of_rows(found)), *failure_notes(results), FLAG_NOTE]
    title = "Performance on the test episodes"
    return Table("performance", title, header, made, notes, left=(0, 1, 2))


def _iqm(row: Row) -> str:
    if row.group.n < 2:
        return "-"
    rates = [[100.0 * float(run.test(row.level)["success"].mean())] for run in row.group.runs]
    low, high = stratified_bootstrap(rates)
    return f"{interquartile_mean(rates):.1f} [{low:.1f}, {high:.1f}]"


def ablation(results: Results) -> Table:
    """Table "ablation": success rate with one component removed at a time; control and optimum."""
    header = ["Configuration", *KNOWS, "Success (%), paper", "Success (%)", "95 % interval"]
    header += [HOLES.label, "Steps to 75 % (1e5)", "Moves over the optimum (%)"]
    made: list[list[Cell]] = []
    groups: dict[str, Group] = {}

    def add(name: str, row: Row, paper: str, steps: Cell) -> None:
        success = row.success()
        made.append([
            name, *row.head[1:], paper or "-", row.cell(success, 1, paper),
            success.interval_text(1), row.cell(row.value(HOLES), HOLES.digits), steps,
            row.cell(row.excess(results)),
        ])  # fmt: skip

    for track in ablated(results):
        found = {k: row_of(results, "rainbow", track, ablation=k) for k in labels.ABLATIONS}
        present = [k for k, row in found.items() if row.group.n or row.group.planned]
        if not set(present) - {"full"} or set(present) & paper_values.ABLATION.keys() - {"full"}:
            present += paper_values.ABLATION  # the paper's own study, whole
        for key, title in labels.ABLATIONS.items():
            if key in present:
                name, paper = f"{title}, {labels.track(track)}", paper_values.ABLATION.get(key, "")
                groups[name] = found[key].group
                add(name, found[key], paper, _steps_to_75(found[key].group))
    controls = [control_of(results, row_of(results, "rainbow", t)) for t in ablated(results)]
    for name, control in {row.name: row for row in controls if row is not None}.items():
        add(f"Best control: {name}", control, "", "-")
    optimum = row_of(results, "optimum")
    add(optimum.name, optimum, "", "-")
    notes = [*seeds_notes(groups), interval_note(list(groups.values())), FLAG_NOTE]
    title = "Rainbow with one component removed"
    return Table("ablation", title, header, made, notes, left=(0, 1, 2))


def ablated(results: Results) -> list[str]:
    """Tracks in which any ablation is planned or was run; the scored one where there is none."""
    found = []
    for track in results.tracks():
        groups = [
            results.group("rainbow", track=track, ablation=key)
            for key in labels.ABLATIONS
            if key != "full"
        ]
        if any(group.n or group.planned for group in groups):
            found.append(track)
    return found or [SCORED]


def _steps_to_75(group: Group, paper: str = "") -> Cell:
    """Environment steps to 75 % success, in 1e5; a run that never got there counts as longer."""
    if not group.n:
        return group.absent
    value = group.meta("steps_to_75", 1e-5)
    budgets = [1e-5 * float(run.config["track"]["timesteps"]) for run in group.runs]
    missed = group.n - value.n
    if not value.n:
        bound = Value(math.nan, n=0, low=min(budgets), high=math.inf)
        return Number(bound, 2, paper=paper, shown="not reached")
    reached = [run.meta["training"]["steps_to_75"] for run in group.runs]
    steps = [b if s is None else 1e-5 * s for s, b in zip(reached, budgets, strict=True)]
    low, high = mean_interval(steps)
    value = replace(value, low=low, high=math.inf if missed and group.n > 1 else high)
    return Number(value, 2, f" ({missed} of {group.n} never)" if missed else "", paper)


def geometry(results: Results) -> Table:
    """Table "geo_ablation": Rainbow, the best control and the optimum on either geometry."""
    quantities: list[tuple[str, str, Callable[[Row, str], Cell]]] = [
        ("Steps to 75 % success (1e5)", "steps_to_75",
         lambda row, paper: _steps_to_75(row.group, paper) if row.method in LEARNERS else "-"),
        ("Success (%)", "success", lambda row, paper: row.cell(row.success(), 1, paper)),
        ("Singularity terminations / 1000 training ep.", "singular_per_1000",
         lambda row, paper: row.cell(row.group.singular_per_1000(), 1, paper)),
        ("Singularity terminations / 1000 test ep.", "",
         lambda row, paper: row.cell(row.value(METRICS["singular"]), 1, paper)),
    ]  # fmt: skip
    printed = paper_values.GEOMETRY_ABLATION
    header = ["Method", *KNOWS, *(f"{name}, {end}" for name, _, _ in quantities for end in ENDS)]
    papers: list[Cell] = [
        text or "-" for _, key, _ in quantities for text in printed.get(key, ("", ""))
    ]
    made: list[list[Cell]] = [[*_paper_head("rainbow"), *papers]]
    pairs = []
    for track in [t for t in results.tracks() if not results.uncertain(t)] or [SCORED]:
        ours = row_of(results, "rainbow", track)
        control = control_of(results, ours)
        if any(results.group("rainbow", end, track).planned for end in ENDS) or ours.group.n:
            pairs.append(ours)
        pairs += [control] if control else []
    for row in dict.fromkeys((row.method, row.track) for row in [*pairs, _optimum(results)]):
        method, track = row
        both = [row_of(results, method, track, end) for end in ENDS]
        cells = [
            cell(each, paper if method == "rainbow" else "")
            for _, key, cell in quantities
            for each, paper in zip(both, printed.get(key, ("", "")), strict=True)
        ]
        made.append([*both[0].head, *cells])
    titled = {
        f"{row.name} on the {end} geometry": results.group(row.method, end, row.track)
        for row in pairs
        for end in ENDS
    }
    notes = [*seeds_notes(titled), FLAG_NOTE]
    title = "Before and after the optimization of the 3-RRS"
    return Table("geometry", title, header, made, notes, left=(0, 1, 2))


def _optimum(results: Results) -> Row:
    return row_of(results, "optimum")


def robustness(results: Results) -> Table:
    """Section "Robustness": success under Gaussian noise on the normalized observation."""
    levels = noise_levels(results) or [0.0, NOISE]
    paper = paper_values.ROBUSTNESS
    drop = paper_values.mean(paper[NOISE]) - paper_values.mean(paper[0.0])
    header = ["Method", *KNOWS, *[f"Noise {x:g}" for x in levels]]
    header.append(f"Change at {NOISE:g} (points)")
    printed: list[Cell] = [paper.get(level, "-") for level in levels]
    made: list[list[Cell]] = [[*_paper_head("rainbow"), *printed, signed(drop, 0)]]
    found = [row for row in rows(results, NOISY) if row.level.masks == OWN_MASKS]
    for row in found:
        theirs = paper if row.method == "rainbow" else {}
        cells = [row.cell(row.group.success(Level(x)), 1, theirs.get(x, "")) for x in levels]
        change = row.group.change(NOISE)
        text = change.text(1)
        shown = f"+{text}" if change.mean > 0.0 else text
        printed_drop = signed(drop, 0) if theirs else ""
        last: Cell = Number(change, 1, paper=printed_drop, shown=shown)
        made.append([*row.head, *cells, last if row.group.n else row.group.absent])
    optimum = _optimum(results)
    best = optimum.cell(optimum.success())
    made.append([f"{optimum.name} (true state)", *optimum.head[1:], *[best] * len(levels), "-"])
    notes = [
        *seeds_notes(of_rows(found)),
        "Noise: standard deviation as a share of the normalized range.",
        FLAG_NOTE,
    ]
    title = "Success rate (%) under observation noise"
    return Table("robustness", title, header, made, notes, left=(0, 1, 2))


def noise_levels(results: Results) -> list[float]:
    """Levels of observation noise that a run of a known machine was tested at."""
    tested = [row.group for row in complete(rows(results, NOISY))]
    return sorted({noise for group in tested for run in group.runs for noise, *_ in run.levels})
