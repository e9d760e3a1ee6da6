"""The paper's tables in the paper's form, its values beside ours, from stored data alone.

Nothing is trained or played again here, and torch is not imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.protocol.plan import LEARNERS
from benchmarks.reporting.compared import ABLATION, comparisons, find
from benchmarks.reporting.results import Group, Level, Results
from benchmarks.reporting.rows import Row, complete, control_of, row_of, rows, scored
from benchmarks.reporting.stats import Value, t_interval
from benchmarks.reporting.tables.difficulty import difficulty, tracks_of
from benchmarks.reporting.tables.geometric import design
from benchmarks.reporting.tables.leaderboard import leaderboard
from benchmarks.reporting.tables.notes import failure_notes, of_rows, seeds_notes
from benchmarks.reporting.tables.significance import acting, difference, p_text, significance
from benchmarks.reporting.tables.table import FLAG_NOTE, Number, Table, TableCell
from benchmarks.reporting.tables.team import team
from benchmarks.reporting.tables.uncertain import uncertain
from benchmarks.runs.store import Store

NOISY: Final = (*LEARNERS, "greedy_observed", "lookahead_observed")  # what sees the observation
ENDS: Final = ("initial", "optimized")
COMPARED: Final = ("rrt_connect", "dqn", "rainbow")  # the paper's columns
GREEDILY: Final = "Success rate, greedily (%)"


def build_tables(store: Store) -> list[Table]:
    """All tables of a store, the paper's first."""
    results = Results(store)
    if tracks_of(results):  # a preset about the task has no headline
        return [difficulty(results)]
    return [
        performance(results),
        controls(results),
        ablation(results),
        geometry(results),
        design(results),
        leaderboard(store, results),
        significance(results),
        robustness(results),
        uncertain(results),
        *team(results),
    ]


def performance(results: Results) -> Table:
    """Table "performance": the paper's six metrics, its three methods, paper and ours."""
    track = scored(results)
    result = [row_of(results, m, track if m in LEARNERS else "").as_trained() for m in COMPARED]
    header = ["Metric"]
    for row in result:
        header += [f"{labels.METHODS[row.method]}, paper", "Ours"]
    made: list[list[TableCell]] = []
    for metric in PAPER_METRICS:
        printed = paper_values.PERFORMANCE[metric.key]
        cells: list[TableCell] = []
        for row in result:
            paper = printed[row.method]
            cells += [paper, row.cell(row.value(metric), metric.digits, paper)]
        made.append([metric.label, *cells])
    made += _greedily([(row, "-") for row in result])
    notes = [*_how(result), *seeds_notes(of_rows(result)), *failure_notes(results), FLAG_NOTE]
    return Table("performance", f"Performance, {labels.track(track)}", header, made, notes)


def controls(results: Results) -> Table:
    """Table "controls": what else learns or plays under the same masks, and the ceiling."""
    track = scored(results)
    learners = [
        row_of(results, "rainbow", track, ablation="none").as_trained(),
        row_of(results, "maskable_ppo", track).as_trained(),
    ]
    script = control_of(results, row_of(results, "rainbow", track).as_trained())
    result = [*learners, *([script] if script else []), row_of(results, "optimum")]
    header = ["Metric", labels.MASKED_DQN, labels.METHODS["maskable_ppo"]]
    header += [f"Best script: {script.name}"] if script else []
    header += [labels.METHODS["optimum"]]
    made: list[list[TableCell]] = [
        [metric.label, *(row.cell(row.value(metric), metric.digits) for row in result)]
        for metric in (*PAPER_METRICS, *EXTRA_METRICS[:2])
    ]
    made += _greedily([(row, "") for row in result])
    notes = [
        *_how(result),
        *seeds_notes({name: row.group for name, row in zip(header[1:], result, strict=True)}),
    ]
    title = f"Beside them, under the same masks, {labels.track(track)}"
    return Table("controls", title, header, made, notes)


def _greedily(result: list[tuple[Row, str]]) -> list[list[TableCell]]:
    """A row of success rates of greedy acting, where any of the methods was tested in both ways."""
    if all(row.level == Level() for row, _ in result):
        return []
    cells: list[TableCell] = []
    for row, paper in result:
        cells += [*([paper] if paper else []), replace(row, level=Level()).tested(Level())]
    return [[GREEDILY, *cells]]


def _how(result: list[Row]) -> list[str]:
    """In which way each method acts."""
    ways: dict[str, list[str]] = {}
    for row in complete(result):
        if row.method in LEARNERS or row.level != Level():
            ways.setdefault(acting(row), []).append(row.name)
    parts = [f"{', '.join(names)}: {way}" for way, names in ways.items()]
    return [f"Acting: {'; '.join(parts)}."] if parts else []


def ablation(results: Results) -> Table:
    """Table "ablation": success rate with one component removed at a time."""
    track = scored(results)
    header = ["Configuration", "Paper (%)", "Ours, as trained (%)", "Greedily (%)"]
    header += ["Difference to all six (points)", "p (Holm)", "Seeds"]
    made: list[list[TableCell]] = []
    compared, groups = comparisons(results), {}
    for key, title in labels.ABLATIONS.items():
        row = row_of(results, "rainbow", track, ablation=key)
        paper = paper_values.ABLATION.get(key, "")
        if not (paper or row.group.known):
            continue
        groups[title] = row.group
        trained = row.as_trained()
        each = find(compared, ABLATION, trained) if row.group.n else None
        both = trained != row
        made.append([
            title, paper or "-",
            trained.cell(trained.success(), 1, paper) if both or not row.group.n else "-",
            row.cell(row.success(), 1, "" if both else paper),
            difference(each.difference) if each else "-", p_text(each.p_holm) if each else "-",
            str(row.group.n),
        ])  # fmt: skip
    notes = [*seeds_notes(groups), FLAG_NOTE]
    title = f"Rainbow with one component removed, {labels.track(track)}"
    return Table("ablation", title, header, made, notes)


def _steps_to_75(group: Group, paper: str = "") -> TableCell:
    """Environment steps to 75 % success, in 1e5; a run that never got there counts as longer."""
    if not group.n:
        return group.absent
    value = group.meta("steps_to_75", 1e-5)
    budgets = [1e-5 * float(run.config["track"]["timesteps"]) for run in group.runs]
    missed = group.n - value.n
    if not value.n:
        bound = Value(math.nan, n=0, low=min(budgets), high=math.inf)
        return Number(bound, 2, paper=paper, shown="not reached")
    low, high = t_interval(value.mean, value.std, value.n)
    value = replace(value, low=low, high=math.inf if missed else high)
    return Number(value, 2, f" ({missed} of {group.n} never)" if missed else "", paper)


def geometry(results: Results) -> Table:
    """Table "geo_ablation": Rainbow on either geometry; below it the best script and optimum."""
    track = scored(results)
    both = {end: row_of(results, "rainbow", track, end).as_trained() for end in ENDS}
    scripts = {end: control_of(results, both[end], end) for end in ENDS}
    optima = {end: row_of(results, "optimum", geometry=end) for end in ENDS}
    printed = paper_values.GEOMETRY_ABLATION

    def line(label: str, key: str, cell: Callable[[str, str], TableCell]) -> list[TableCell]:
        papers = dict(zip(ENDS, printed.get(key, ("-", "-")), strict=True))
        cells = [
            (papers[end], cell(end, papers[end] if key in printed else "")) for end in ENDS
        ]  # fmt: skip
        return [label, *(text for pair in cells for text in pair)]

    def script(end: str, _: str) -> TableCell:
        row = scripts[end]
        return row.cell(row.success()) if row else "-"

    made = [
        line("Env. steps to 75 % success (1e5)", "steps_to_75",
             lambda end, paper: _steps_to_75(both[end].group, paper)),
        line("Final success rate (%)", "success",
             lambda end, paper: both[end].cell(both[end].success(), 1, paper)),
        line("Singularity terminations / 1000 training episodes", "singular_per_1000",
             lambda end, paper: both[end].cell(both[end].group.singular_per_1000(), 1, paper)),
        line("Success rate, greedily (%)", "", lambda end, _: both[end].tested(Level())),
        line("Best script under the same masks (%)", "", script),
        line("Exact optimum (%)", "", lambda end, _: optima[end].cell(optima[end].success())),
    ]  # fmt: skip
    header = [
        "Metric",
        *(f"{end.capitalize()} geometry, {who}" for end in ENDS for who in ("paper", "ours")),
    ]
    named = {f"Rainbow on the {end} geometry": both[end].group for end in ENDS}
    notes = [*_how([both["optimized"]]), *seeds_notes(named), FLAG_NOTE]
    title = f"Effect of the design stage on Rainbow, {labels.track(track)}"
    return Table("geometry", title, header, made, notes)


def robustness(results: Results) -> Table:
    """Section "Robustness": greedy success under Gaussian noise on the normalized observation."""
    track = scored(results)
    levels = noise_levels(results) or [0.0, 0.01]
    candidates = [
        row_of(results, "rainbow", track),
        row_of(results, "rainbow", track, ablation="none"),
    ]
    candidates += [row_of(results, m, track) for m in ("dqn", "maskable_ppo", "lookahead_observed")]
    result = complete(candidates)
    header = ["Noise", "Rainbow DQN, paper", *(row.name for row in result)]
    paper = paper_values.ROBUSTNESS
    made: list[list[TableCell]] = []
    for x in levels:
        cells = [
            row.cell(
                row.group.success(Level(x)), 1, paper.get(x, "") if row.method == "rainbow" else ""
            )
            for row in result
        ]
        made.append([f"{x:g}", paper.get(x, "-"), *cells])
    notes = [
        *seeds_notes(of_rows(result)),
        "All act greedily. Noise: standard deviation as a share of the normalized range.",
        FLAG_NOTE,
    ]
    return Table("robustness", "Success rate (%) under observation noise", header, made, notes)


def noise_levels(results: Results) -> list[float]:
    """Levels of observation noise that a run of a known machine was tested at."""
    tested = [row.group for row in complete(rows(results, NOISY))]
    return sorted({level[0] for group in tested for run in group.runs for level in run.levels})
