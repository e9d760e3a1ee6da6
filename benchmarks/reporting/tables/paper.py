"""The paper's tables from stored data alone: the paper's value beside ours and the optimum's.

Nothing is trained or re-evaluated here, and torch is not imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.metrics import EXTRA_METRICS, METRICS, PAPER_METRICS
from benchmarks.reporting.results import Group, Results, excess_over_optimum
from benchmarks.reporting.stats import (
    Value,
    interquartile_mean,
    mean_interval,
    stratified_bootstrap,
)
from benchmarks.reporting.tables.deviations import FLAG_NOTE, deviations
from benchmarks.reporting.tables.geometric import design
from benchmarks.reporting.tables.hyperparameters import hyperparameters
from benchmarks.reporting.tables.leaderboard import leaderboard
from benchmarks.reporting.tables.statistics import aggregates, improvement, signed, significance
from benchmarks.reporting.tables.table import Cell, Number, Table
from benchmarks.runs.store import Store

# the five that a run prints; the others are written beside them
PRINTED: Final = ("design", "performance", "ablation", "geometry", "robustness")
BASELINES: Final = ("rrt_connect", "rrt_lattice")
NOISE: Final = 0.01  # the level of the paper's section "Robustness"


def build_tables(store: Store) -> list[Table]:
    """All tables of a store, in the paper's order."""
    results = Results(store)
    compared = [
        design(results),
        performance(results),
        ablation(results),
        geometry(results),
        robustness(results),
    ]
    return [
        hyperparameters(results),
        *compared[:2],
        significance(results),
        aggregates(results),
        improvement(results),
        *compared[2:],
        leaderboard(store, results),
        deviations(compared, store.folder.name),
    ]


def write_tables(store: Store, tables: list[Table] | None = None) -> list[Path]:
    """Write every table as CSV, Markdown and LaTeX."""
    built = build_tables(store) if tables is None else tables
    return [path for table in built for path in table.write(store.tables)]


def _cell(group: Group, value: Value, digits: int, paper: str = "", suffix: str = "") -> Cell:
    """A value of a group, or the word for its absence."""
    return Number(value, digits, suffix, paper) if group.n else group.absent


Layout = list[tuple[str, str, Group | None]]


def _layout(results: Results) -> Layout:
    """(header, method, runs) of the performance table's columns; the paper's own have no runs."""
    ours = [("RRT-Connect", "rrt_connect", results.group("rrt_connect"))]
    closed = results.group("rrt_lattice")
    if closed.n or closed.planned:
        ours.append((labels.METHODS["rrt_lattice"], "rrt_lattice", closed))
    learners = [
        (f"{labels.METHODS[method]}, {labels.track(track)}", method, group)
        for track in results.tracks()
        for method, group in results.learners(track)
    ]
    for name in dict.fromkeys(method for _, method, _ in learners):
        ours += [column for column in learners if column[1] == name]
    ours.append((labels.METHODS["optimum"], "optimum", results.group("optimum")))
    found: Layout = []
    for title, method, group in ours:
        printed = method in paper_values.PERFORMANCE["success"]
        if printed and all(method != before for _, before, _ in found):
            found.append((f"{labels.METHODS[method]}, paper", method, None))
        found.append((title, method, group))
    return found


def performance(results: Results) -> Table:
    """Table "performance": the paper's six metrics and ours beyond them, per method."""
    layout = _layout(results)
    rows: list[list[Cell]] = []
    for metric in (*PAPER_METRICS, *EXTRA_METRICS):
        printed = paper_values.PERFORMANCE.get(metric.key, {})
        row: list[Cell] = [metric.label]
        for _, method, group in layout:
            if group is None:
                row.append(printed.get(method, "-"))
            else:
                paper = printed.get(method, "")
                row.append(_cell(group, group.value(metric), metric.digits, paper))
        rows.append(row)
    groups = {title: group for title, _, group in layout if group is not None}
    rows.append(_excess_row(results, layout))
    if any(group.n > 1 for group in groups.values()):
        rows.append(_iqm_row(layout))
    notes = [*_seeds_notes(groups), *_failure_notes(results), FLAG_NOTE]
    header = ["Metric", *(title for title, _, _ in layout)]
    return Table("performance", "Performance on the test episodes", header, rows, notes)


def _excess_row(results: Results, layout: Layout) -> list[Cell]:
    optimum = results.group("optimum")
    row: list[Cell] = ["Moves to first insertion over the optimum (%)"]
    for _, _, group in layout:
        row.append("-" if group is None else _cell(group, excess_over_optimum(group, optimum), 1))
    return row


def _iqm_row(layout: Layout) -> list[Cell]:
    row: list[Cell] = ["Success rate, IQM over seeds [95 % interval]"]
    for _, _, group in layout:
        if group is None or group.n < 2:
            row.append("-")
            continue
        rates = [[100.0 * float(run.test()["success"].mean())] for run in group.runs]
        low, high = stratified_bootstrap(rates)
        row.append(f"{interquartile_mean(rates):.1f} [{low:.1f}, {high:.1f}]")
    return row


def _seeds_notes(groups: dict[str, Group]) -> list[str]:
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


def _failure_notes(results: Results) -> list[str]:
    notes = []
    for method in BASELINES:
        rows = results.group(method).pooled()
        if not len(rows) or "failure" not in rows:
            continue
        failed = rows[rows["success"] == 0]
        causes = failed["failure"].value_counts()
        text = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items()))
        notes.append(
            f"{labels.METHODS[method]}: {len(failed)} of {len(rows)} episodes without an insertion"
            + (f" ({text})" if text else "")
            + f"; median planning time {1000 * rows['plan_seconds'].median():.1f} ms."
        )
    return notes


def ablation(results: Results) -> Table:
    """Table "ablation": success rate with one component removed at a time."""
    tracks = _tracks_with(results, [key for key in labels.ABLATIONS if key != "full"])
    header = ["Configuration", "Success (%), paper"]
    for track in tracks:
        name = labels.track(track)
        header += [f"Success (%), {name}", "95 % interval", f"Steps to 75 % (1e5), {name}"]
        header.append(f"Moves over the optimum (%), {name}")
    rows: list[list[Cell]] = []
    groups: dict[str, Group] = {}
    optimum = results.group("optimum")
    for key, title in labels.ABLATIONS.items():
        paper = paper_values.ABLATION.get(key, "")
        mine = [results.group("rainbow", track=track, ablation=key) for track in tracks]
        if not paper and not any(group.n or group.planned for group in mine):
            continue
        row: list[Cell] = [title, paper or "-"]
        for track, group in zip(tracks, mine, strict=True):
            groups[f"{title}, {labels.track(track)}"] = group
            success = group.success()
            row += [_cell(group, success, 1, paper), success.interval_text(1), _steps_to_75(group)]
            row.append(_cell(group, excess_over_optimum(group, optimum), 1))
        rows.append(row)
    best = optimum.success()
    last: list[Cell] = [labels.METHODS["optimum"], "-"]
    for _ in tracks:
        last += [_cell(optimum, best, 1), best.interval_text(1), "-", "-"]
    rows.append(last)
    notes = [*_seeds_notes(groups), _interval_note(list(groups.values())), FLAG_NOTE]
    return Table("ablation", "Rainbow with one component removed", header, rows, notes)


def _tracks_with(results: Results, ablations: list[str]) -> list[str]:
    """Tracks in which any of these ablations is planned or was run; all where there is none."""
    tracks = results.tracks() or ["tuned"]
    found = []
    for track in tracks:
        groups = [results.group("rainbow", track=track, ablation=key) for key in ablations]
        if any(group.n or group.planned for group in groups):
            found.append(track)
    return found or tracks


def _interval_note(groups: list[Group]) -> str:
    if max((group.n for group in groups), default=0) > 1:
        return "Intervals: stratified bootstrap over seeds."
    return "Intervals: Wilson's, over the test episodes of the one seed."


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
    """Table "geo_ablation": the full Rainbow on the initial and on the optimized geometry."""
    tracks = results.tracks() or ["tuned"]
    names = ("initial", "optimized")
    header = ["Metric"]
    for name in names:
        title = name.capitalize()
        header += [f"{title}, paper", *[f"{title}, {labels.track(t)}" for t in tracks]]
    groups = {name: [results.group("rainbow", name, track) for track in tracks] for name in names}

    def row(label: str, key: str, cell: Callable[[Group, str], Cell]) -> list[Cell]:
        made: list[Cell] = [label]
        printed = paper_values.GEOMETRY_ABLATION.get(key, ("", ""))
        for name, paper in zip(names, printed, strict=True):
            made += [paper or "-", *[cell(group, paper) for group in groups[name]]]
        return made

    rows = [
        row("Env. steps to 75 % success (1e5)", "steps_to_75", _steps_to_75),
        row("Final success rate (%)", "success", lambda g, paper: _cell(g, g.success(), 1, paper)),
        row(
            "Singularity terminations / 1000 training ep.",
            "singular_per_1000",
            lambda g, paper: _cell(g, g.singular_per_1000(), 1, paper),
        ),
        row(
            "Singularity terminations / 1000 test ep.",
            "",
            lambda g, paper: _cell(g, g.value(METRICS["singular"]), 1, paper),
        ),
    ]
    ceiling: list[Cell] = ["Exact optimum's success rate (%)"]
    for name in names:
        optimum = results.group("optimum", name)
        ceiling += ["-", *[_cell(optimum, optimum.success(), 1) for _ in tracks]]
    rows.append(ceiling)
    titled = {
        f"{name} geometry, {labels.track(track)}": group
        for name in names
        for track, group in zip(tracks, groups[name], strict=True)
    }
    notes = [*_seeds_notes(titled), FLAG_NOTE]
    return Table("geometry", "Full Rainbow before and after the optimization", header, rows, notes)


def robustness(results: Results) -> Table:
    """Section "Robustness": success under Gaussian noise on the normalized observation."""
    levels = results.noise_levels() or [0.0, NOISE]
    paper = paper_values.ROBUSTNESS
    drop = paper_values.mean(paper[NOISE]) - paper_values.mean(paper[0.0])
    header = ["Method", *[f"Noise {x:g}" for x in levels], f"Change at {NOISE:g} (points)"]
    rows: list[list[Cell]] = [
        ["Rainbow DQN, paper", *[paper.get(level, "-") for level in levels], signed(drop, 0)]
    ]
    groups = {}
    for track in results.tracks():
        for method, group in results.learners(track):
            title = f"{labels.METHODS[method]}, {labels.track(track)}"
            groups[title] = group
            printed = paper if method == "rainbow" else {}
            cells = [_cell(group, group.success(x), 1, printed.get(x, "")) for x in levels]
            change = group.change(NOISE)
            text = change.text(1)
            shown = f"+{text}" if change.mean > 0.0 else text
            printed_drop = signed(drop, 0) if method == "rainbow" else ""
            last: Cell = Number(change, 1, paper=printed_drop, shown=shown)
            rows.append([title, *cells, last if group.n else group.absent])
    optimum = results.group("optimum")
    best = _cell(optimum, optimum.success(), 1)
    rows.append([f"{labels.METHODS['optimum']} (true state)", *[best] * len(levels), "-"])
    notes = [
        *_seeds_notes(groups),
        "Noise: standard deviation as a share of the normalized range.",
        FLAG_NOTE,
    ]
    return Table("robustness", "Success rate (%) under observation noise", header, rows, notes)
