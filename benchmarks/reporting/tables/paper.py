"""The paper's tables in the paper's form, its values beside ours, from stored data alone.

Nothing is trained or played here, and torch is not imported.
"""

import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

import pandas as pd

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.metrics import EXTRA_METRICS, JOINTS_TIME, METRICS, PAPER_METRICS, Metric
from benchmarks.protocol.plan import CONTROLS
from benchmarks.reporting.compared import Question, comparisons, find
from benchmarks.reporting.results import MAIN, Group, Level, Results, best, complete
from benchmarks.reporting.stats import Value, t_interval
from benchmarks.reporting.tables.table import FLAG_NOTE, MISSING, Number, Table, TableCell, p_text

NOISY: Final = (*LEARNERS, "greedy_observed", "lookahead_observed")  # what sees the observation
ENDS: Final = ("initial", "optimized")
COMPARED: Final = ("rrt_connect", "dqn", "rainbow")  # the paper's columns
BASELINES: Final = ("rrt_connect", "rrt_lattice")
GREEDILY: Final = "Success rate, greedily (%)"


def performance(results: Results) -> Table:
    """Table "performance": the paper's six metrics, its three methods, paper and ours."""
    track = results.scored
    result = [results.group(m, track if m in LEARNERS else "").as_trained() for m in COMPARED]
    header = ["Metric"]
    for row in result:
        header += [f"{labels.METHODS[row.method]}, paper", "Ours"]
    made = _by_metric(result, PAPER_METRICS, paper_values.PERFORMANCE)
    stages = stage_notes(result, [row.name for row in result])
    notes = [*_how(result), *seeds_notes(result), *stages, *failure_notes(results), FLAG_NOTE]
    return Table("performance", f"Performance, {labels.track(track)}", header, made, notes)


def timed(rows: Iterable[Group]) -> bool:
    """Whether any test episodes have the joints' time; those of older runs lack it."""
    return any(row.value(JOINTS_TIME).n for row in rows)


def _by_metric(
    rows: list[Group], metrics: Iterable[Metric], printed: Mapping[str, Mapping[str, str]]
) -> list[list[TableCell]]:
    """A line for each metric, and one for greedy success if the rows act otherwise.

    The joints' time follows the completion time where it is known. ``printed`` holds the paper's
    values by metric and method, which precede ours.
    """
    metrics = list(metrics)
    if timed(rows):
        metrics.insert(1 + metrics.index(METRICS["time_first"]), JOINTS_TIME)
    made: list[list[TableCell]] = []
    for metric in metrics:
        papers = [printed.get(metric.key, {}).get(row.method, "-") for row in rows]
        ours = [row.measure(metric, paper) for row, paper in zip(rows, papers, strict=True)]
        made.append([metric.label, *(_in_pairs(papers, ours) if printed else ours)])
    if any(row.level != MAIN for row in rows):
        ours = [row.tested(MAIN) for row in rows]
        made.append([GREEDILY, *(_in_pairs(["-"] * len(rows), ours) if printed else ours)])
    return made


def _in_pairs(papers: Iterable[str], ours: Iterable[TableCell]) -> list[TableCell]:
    return [cell for pair in zip(papers, ours, strict=True) for cell in pair]


def controls(results: Results) -> Table:
    """Table "controls": what else learns or plays under the same masks, and the ceiling."""
    track = results.scored
    script = results.control_of(results.group("rainbow", track).as_trained())
    result = [
        results.group("rainbow", track, ablation="none").as_trained(),
        results.group("maskable_ppo", track).as_trained(),
        *([script] if script else []),
        results.group("optimum"),
    ]
    names = [f"Best script: {row.name}" if row is script else row.title for row in result]
    made = _by_metric(result, (*PAPER_METRICS, *EXTRA_METRICS), {})
    notes = [*_how(result), *seeds_notes(result, names)]
    title = f"Beside them, under the same masks, {labels.track(track)}"
    return Table("controls", title, ["Metric", *names], made, notes)


def _how(result: list[Group]) -> list[str]:
    """How each method acts."""
    ways: dict[str, list[str]] = {}
    for row in complete(result):
        if row.method in LEARNERS or row.level != MAIN:
            ways.setdefault(row.acting, []).append(row.name)
    return [f"{way.capitalize()}: {'; '.join(names)}." for way, names in ways.items()]


def ablation(results: Results) -> Table:
    """Table "ablation": success rate with one component removed at a time."""
    track = results.scored
    header = ["Configuration", "Paper (%)", "Ours, as trained (%)", "Greedily (%)"]
    header += ["Difference to all six (points)", "p (Holm)", "Seeds"]
    made: list[list[TableCell]] = []
    compared, shown = comparisons(results), {}
    for key, title in labels.ABLATIONS.items():
        row = results.group("rainbow", track, ablation=key)
        paper = paper_values.ABLATION.get(key, "")
        if not (paper or row.known):
            continue
        shown[title] = row
        trained = row.as_trained()
        each = find(compared, Question.ABLATION, trained) if row.n else None
        both = trained != row
        made.append([
            title, paper or "-",
            trained.cell(trained.success(), 1, paper) if both or not row.n else "-",
            row.cell(row.success(), 1, "" if both else paper),
            each.difference.signed() if each else "-", p_text(each.p_holm) if each else "-",
            str(row.n),
        ])  # fmt: skip
    names = [title.removeprefix("- ") for title in shown]
    notes = [*seeds_notes(shown.values(), names), *stage_notes(shown.values(), names), FLAG_NOTE]
    title = f"Rainbow with one component removed, {labels.track(track)}"
    return Table("ablation", title, header, made, notes)


def _steps_to_75(group: Group, paper: str) -> TableCell:
    """Environment steps to 75 % success, in 1e5; a run that never reached it counts as longer."""
    value = group.steps_to_75()
    missed = group.n - value.n
    if group.n and not value.n:
        budget = min(1e-5 * float(run.config["track"]["timesteps"]) for run in group.runs)
        bound = Value(math.nan, n=0, low=budget, high=math.inf)
        return Number(bound, 2, paper=paper, shown="not reached")
    value = replace(value, high=math.inf if missed else value.high)
    return group.cell(value, 2, paper, f" ({missed} of {group.n} never)" if missed else "")


def geometry(results: Results) -> Table:
    """Table "geo_ablation": Rainbow on either geometry; below it the best script and optimum."""
    track = results.scored
    both = [results.group("rainbow", track, end).as_trained() for end in ENDS]
    scripts = [results.control_of(row, row.geometry) for row in both]

    def line(label: str, key: str, cell: Callable[[Group, str], TableCell]) -> list[TableCell]:
        papers = paper_values.GEOMETRY_ABLATION.get(key, ("-", "-"))
        return [label, *_in_pairs(papers, map(cell, both, papers))]

    def rate(label: str, rows: Iterable[Group | None]) -> list[TableCell]:
        cells = [row.cell(row.success()) if row else "-" for row in rows]
        return [label, *_in_pairs(["-", "-"], cells)]

    made = [
        line("Env. steps to 75 % success (1e5)", "steps_to_75", _steps_to_75),
        line("Final success rate (%)", "success",
             lambda row, paper: row.cell(row.success(), 1, paper)),
        line("Singularity terminations / 1000 training episodes", "singular_per_1000",
             lambda row, paper: row.cell(row.singular_per_1000(), 1, paper)),
        line(GREEDILY, "", lambda row, _: row.tested(MAIN)),
        rate("Best script under the same masks (%)", scripts),
        rate("Exact optimum (%)", [results.group("optimum", geometry=end) for end in ENDS]),
    ]  # fmt: skip
    header = [
        "Metric",
        *(f"{end.capitalize()} geometry, {who}" for end in ENDS for who in ("paper", "ours")),
    ]
    names = [f"Rainbow on the {end} geometry" for end in ENDS]
    notes = [*_how(both[1:]), *seeds_notes(both, names), FLAG_NOTE]
    trained = [run.training for group in both for run in group.runs]
    if trained and all(t.get("steps_to_75") == t.get("curriculum_switch") for t in trained):
        notes.append("Steps to 75 % are of episodes with four holes: there the curriculum goes on.")
    title = f"Effect of the design stage on Rainbow, {labels.track(track)}"
    return Table("geometry", title, header, made, notes)


def design(results: Results) -> Table:
    """Table "results": the geometric optimization, five metrics."""
    header = ["Metric", "Initial, paper", "Initial, ours", "Optimized, paper", "Optimized, ours"]
    notes, stored, runs = [], {}, 0
    absent = MISSING if results.design_planned else "-"
    if results.design is not None:
        runs = int(results.design.config()["design"]["runs"])
        frame = results.design.rows("design").fillna({"note": ""})
        stored = {str(row["metric"]): row for row in frame.to_dict("records")}
        notes = [f"Ours: mean ± std over {runs} Nelder-Mead runs, each with its own jitter."]
        notes += [*filter(None, frame["note"]), FLAG_NOTE]
    rows: list[list[TableCell]] = []
    for key, printed in paper_values.DESIGN.items():
        ours = [
            _design_cell(stored[key], end, runs, paper) if stored else absent
            for end, paper in zip(ENDS, printed, strict=True)
        ]
        rows.append([labels.DESIGN_METRICS[key], *_in_pairs(printed, ours)])
    return Table("design", "Geometric optimization of the 3-RRS", header, rows, notes)


def _design_cell(row: dict[Hashable, Any], end: str, runs: int, paper: str) -> TableCell:
    """A measured design metric; a range differs from the paper's if either of its ends does."""
    mean, std, upper = (float(row[f"{end}_{name}"]) for name in ("mean", "std", "high_mean"))
    low, high = t_interval(mean, std, runs)
    shown = str(row[end])
    digits = len(shown.split()[0].rstrip(",").partition(".")[2])
    number = Number(Value(mean, std, runs, low, high), digits, paper=paper, shown=shown)
    if math.isnan(upper):
        return number
    first, second = paper.strip("[]").split(", ")
    # only the mean of the upper end is kept
    last = Number(Value(upper, low=upper, high=upper), paper=second)
    return replace(number, differs=replace(number, paper=first).flagged or last.flagged)


def best_under_noise(results: Results, track: str) -> Group | None:
    """The script that does best under observation noise, at the level that suits it most."""
    scripts = [results.group(name, track) for name in NOISY if name in CONTROLS]
    levels = [Level(noise) for noise in noise_levels(results) if noise]
    tested = [row.at(level) for level in levels for row in scripts if row.n]
    return best(row for row in tested if row.success().n)


def robustness(results: Results) -> Table:
    """Section "Robustness": greedy success under Gaussian noise on the normalized observation."""
    track, paper = results.scored, paper_values.ROBUSTNESS
    script = best_under_noise(results, track)
    methods = ("dqn", "maskable_ppo", *([script.method] if script else []))
    rainbow, masked = (results.group("rainbow", track, ablation=a) for a in ("full", "none"))
    result = complete([rainbow, masked, *(results.group(method, track) for method in methods)])
    made: list[list[TableCell]] = []
    for x in noise_levels(results) or [0.0, 0.01]:
        cells = [
            row.cell(row.at(Level(x)).success(), 1, paper.get(x, "") if row is rainbow else "")
            for row in result
        ]
        made.append([f"{x:g}", paper.get(x, "-"), *cells])
    notes = [
        *seeds_notes(result),
        "All act greedily. Noise: standard deviation as a share of the normalized range.",
        FLAG_NOTE,
    ]
    header = ["Noise", "Rainbow DQN, paper", *(row.name for row in result)]
    return Table("robustness", "Success rate (%) under observation noise", header, made, notes)


def noise_levels(results: Results) -> list[float]:
    """Levels of observation noise that a run of a known machine was tested at."""
    tested = [run for row in results.rows(NOISY) for run in row.runs]
    return sorted({level.noise for run in tested for level in run.levels})


def seeds_notes(groups: Iterable[Group], names: Iterable[str] | None = None) -> list[str]:
    """Seeds and episodes behind the numbers, and the groups that are not complete."""
    groups = list(groups)
    called = [row.name for row in groups] if names is None else names
    seeds = sorted({group.n for group in groups if group.n})
    lengths = sorted({len(run.test()) for group in groups for run in group.runs})
    if not seeds:
        return ["None of these runs is complete."]
    streams = {run.config["evaluation"].get("stream") for group in groups for run in group.runs}
    kind = "validation" if streams == {"validate"} else "test"  # which chose the scripts' weights
    episodes = f"{'/'.join(map(str, lengths))} {kind} episodes"
    if seeds == [1]:
        first = f"Ours: 1 seed x {episodes}, so no spread can be given."
    else:
        *others, last = map(str, seeds)
        counts = f"{', '.join(others)} or {last}" if others else last
        first = f"Ours: mean ± std over {counts} seeds x {episodes}."
    partial = [
        f"{name} {group.n} of {group.planned} seeds"
        for name, group in zip(called, groups, strict=True)
        if 0 < group.n < group.planned  # "missing" says the rest
    ]
    return [first, *([f"Not complete: {'; '.join(partial)}."] if partial else [])]


def stage_notes(groups: Iterable[Group], names: Iterable[str]) -> list[str]:
    """Groups with seeds that were tested on six holes but never trained on them."""
    stayed = []
    for name, group in zip(names, groups, strict=True):
        never = sum(
            run.training.get("curriculum_switch", 0) is None
            for run in group.runs
            if run.config.get("track", {}).get("curriculum", {}).get("enabled")
        )
        stayed += [f"{name} {never} of {group.n} seeds"] if never else []
    return [f"Trained with four holes to the end: {'; '.join(stayed)}."] if stayed else []


def failure_notes(results: Results) -> list[str]:
    """Why the planners of the paper did not insert, and how long they planned."""
    notes = []
    for group in complete(results.group(method) for method in BASELINES):
        rows = pd.concat(group.tests())
        failed = rows[rows["success"] == 0]
        causes = failed["failure"].value_counts()
        text = ", ".join(f"{cause} {count}" for cause, count in sorted(causes.items()))
        notes.append(
            f"{group.title}: {len(failed)} of {len(rows)} episodes without an insertion"
            + (f" ({text})" if text else "")
            + f"; median planning time {1000 * rows['plan_seconds'].median():.1f} ms."
        )
    return notes
