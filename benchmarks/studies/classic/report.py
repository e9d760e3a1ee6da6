"""Tables, figures and the page's block of the classic tasks, from stored data alone."""

import math
from collections.abc import Callable, Iterable
from functools import partial
from itertools import product
from typing import Any, Final

from matplotlib.figure import Figure

from benchmarks.protocol.labels import of_suite
from benchmarks.protocol.presets import load_suite
from benchmarks.reporting import stats
from benchmarks.reporting.blocks import provenance
from benchmarks.reporting.figures import style
from benchmarks.reporting.figures.learning import draw
from benchmarks.reporting.stats import Array, Value, over_seeds
from benchmarks.reporting.tables.table import Number, Table, TableCell
from benchmarks.runs.store import Store
from benchmarks.studies.classic.envs import MASKED_IDENTITY
from benchmarks.studies.classic.results import SuiteResults, with_interval
from benchmarks.studies.robots import contact

# tables of the page, each with its figure
SHOWN: Final = {"scores": "curves", "controls": "", "together": "", "contact": "contact"}
_CURVES = "Return of greedy evaluations during training, with Student's 95 % interval over seeds"
_INTERVAL = "Student's 95 % interval, of three seeds or more"
_MASKS = (
    "The masked identity task: only Rainbow reads masks; to DQN and QR-DQN an action that is not "
    "allowed is one more wrong answer."
)

_CONTROLS = {
    "random": "Random: allowed actions, uniformly.",
    "held": "One action: the best constant one on the episodes that test during training.",
    "script": "Script: a few lines by hand (`benchmarks/studies/classic/controls.py`).",
}


def build_tables(results: SuiteResults) -> list[Table]:
    """All tables that the stored runs can fill."""
    if results.preset.search:
        return [_search(results)]
    tables = [_scores(results)]
    if results.preset.controls:
        tables.append(_controls(results))
    # learners with masks beside learners without are not compared
    tasks = [k for k, task in results.preset.tasks.items() if task.env != MASKED_IDENTITY]
    if len(tasks) > 1 and len(results.preset.methods) > 1:
        tables.append(_together(results, tasks))
    return [*tables, *contact.learner_tables(results), _speed(results)]


def page(store: Store) -> str:
    """The block of a store: where its runs come from, the main tables, each with its figure."""
    results = SuiteResults(load_suite(store.folder.name), store)
    root = f"../results/classic/{store.folder.name}"
    folders = [run.folder for run in results.all.values()]
    controls = sum(not cell.learns for cell in results.all)
    parts = [provenance(store.folder.name, folders, results.missing, controls)]
    tables = {table.name: table for table in build_tables(results)}
    for name, figure in SHOWN.items():
        if name in tables:
            parts.append(tables[name].markdown().rstrip())
            if figure and not results.preset.search:
                shows = _CURVES if figure == "curves" else tables[name].title
                parts.append(f"![{shows}]({root}/figures/{figure}.png)")
    if others := [f"[{name}]({root}/tables/{name}.md)" for name in tables if name not in SHOWN]:
        parts.append("More: " + ", ".join(others) + ".")
    return "\n\n".join(parts)


def _scores(results: SuiteResults) -> Table:
    preset, tasks = results.preset, results.preset.tasks
    header = ["Task", "Steps", "Goal", "Seeds", *map(of_suite, preset.methods)]
    notes = [f"Mean over seeds [{_INTERVAL}]; the run's seed determines its test episodes."]
    if marks := dict.fromkeys(who for task in tasks.values() for who in task.published):
        header.append("Published")
        notes.append(f"Published, in this order and by protocols of their own: {'; '.join(marks)}.")
    if any(task.env == MASKED_IDENTITY for task in tasks.values()):
        notes.append(_MASKS)
    rows: list[list[TableCell]] = []
    for key, task in tasks.items():
        counts = [str(len(results.runs(key, method))) for method in preset.methods]
        counts = counts[:1] if len(set(counts)) == 1 else counts
        goal = "-" if task.goal is None else f"{task.goal:g}"
        row: list[TableCell] = [task.title, f"{task.timesteps:,}", goal, "/".join(counts)]
        row += _shown(results, [key], preset.methods)
        if marks:
            row.append(", ".join(f"{value:g}" for value in task.published.values()) or "-")
        rows.append(row)
    title = f"Return of the last greedy policy, {preset.final_episodes} test episodes per seed"
    return Table("scores", title, header, rows, notes)


def _controls(results: SuiteResults) -> Table:
    """The controls' scores on the test episodes of each seed, which are also a learner's."""
    tasks, controls = results.preset.tasks, results.preset.controls
    return Table(
        "controls",
        "Without learning, on test episodes of the preset's seeds",
        ["Task", *map(of_suite, controls)],
        [[task.title, *_shown(results, [key], controls)] for key, task in tasks.items()],
        [" ".join(_CONTROLS[name] for name in controls)],
    )


def _search(results: SuiteResults) -> Table:
    """A row for each variant: its score on each task, and the number of seeds."""
    preset = results.preset
    header, tried = ["Variant"], []
    for key, task in preset.tasks.items():
        if counts := {len(results.runs(key, method)) for method in preset.methods} - {0}:
            header.append(f"{task.title}, seeds: {'/'.join(map(str, sorted(counts)))}")
            tried.append(key)
    rows = [[of_suite(method), *_shown(results, tried, [method])] for method in preset.methods]
    rows = [row for row in rows if {*row[1:]} - {"-"}]
    title = f"Return of the last greedy policy, {preset.final_episodes} episodes per seed"
    note = (
        f"Mean over seeds [{_INTERVAL}]; one seed is only a hint. Tasks and variants without a "
        "run are left out."
    )
    return Table("scores", title, header, rows, [note])


def _together(results: SuiteResults, tasks: list[str]) -> Table:
    """All tasks at once, and the probability that a run of the first method is the better."""
    preset = results.preset
    scores = {method: results.scores(method, tasks) for method in preset.methods}
    ours = preset.methods[0]
    rows: list[list[TableCell]] = []
    for method, theirs in scores.items():
        middle = better = Value(math.nan)
        if len(theirs):
            middle = _by_tasks(theirs.T, stats.interquartile_mean)
        if method != ours and len(theirs) and len(scores[ours]):
            better = _by_tasks([*scores[ours].T, *theirs.T], stats.improvement)
        shown = [with_interval(value, 2) for value in (middle, better)]
        rows.append([of_suite(method), str(len(theirs)), *shown])
    return Table(
        "together",
        f"All {len(tasks)} tasks together",
        ["Method", "Seeds", "Interquartile mean", f"P({of_suite(ours)} is better)"],
        rows,
        [
            "On each task the worst run of any method scores 0, the best 1; where all tie, 0. "
            "A method counts the seeds that it has on all tasks. Measures of Agarwal et al. 2021 "
            "[95 % stratified bootstrap interval over seeds].",
        ],
    )


def _by_tasks(tasks: Iterable[Array], statistic: Callable[..., Any]) -> Value:
    samples = list(tasks)
    low, high = stats.bootstrap(samples, statistic)
    return Value(float(statistic(*samples)), low=low, high=high)


def _shown(results: SuiteResults, tasks: Iterable[str], methods: Iterable[str]) -> list[TableCell]:
    """Scores with their intervals, of one task or of one method."""
    return [with_interval(results.score(*pair)) for pair in product(tasks, methods)]


def _speed(results: SuiteResults) -> Table:
    rows: list[list[TableCell]] = []
    for key, task in results.preset.tasks.items():
        for method in results.preset.methods:
            runs = results.runs(key, method)
            there: list[TableCell] = ["-", "-"]
            if task.goal is not None:
                steps = over_seeds([run.steps_to(task.goal) for run in runs])
                there = [Number(steps, 0), f"{steps.n} of {len(runs)}"]
            updates = Number(over_seeds([run.training["updates"] for run in runs]), 0)
            minutes = over_seeds([run.training["cpu_seconds"] / 60.0 for run in runs])
            rows.append([task.title, of_suite(method), *there, updates, Number(minutes, 1)])
    return Table(
        "steps",
        "Environment steps to the goal, updates and time",
        ["Task", "Method", "Steps to goal", "Seeds there", "Updates", "CPU minutes"],
        rows,
        [
            "Steps at the first evaluation whose mean return is at the goal, over the seeds that "
            "got there (mean ± standard deviation).",
        ],
    )


def pictures(results: SuiteResults) -> list[style.Picture]:
    """The figures for which there are runs."""
    result = []
    # a search has too many curves to tell apart
    if not results.preset.search:
        result.append(style.Picture("curves", partial(_curves, results)))
    if contact.levels(results):
        result.append(style.Picture("contact", partial(contact.draw_learners, results)))
    return result


def _curves(results: SuiteResults) -> Figure:
    tasks = results.preset.tasks
    columns = min(4, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure, grid = style.canvas(rows, columns, (2.6 * columns, 2.2 * rows + 0.4))
    for axes in grid[len(tasks) :]:
        axes.set_visible(False)
    for axes, (key, task) in zip(grid, tasks.items(), strict=False):
        for number, method in enumerate(results.preset.methods):
            curves = (run.curve for run in results.runs(key, method))
            frames = [curve.assign(timesteps=curve["timesteps"] / 1e3) for curve in curves]
            other = style.PALETTE[(3 + number) % len(style.PALETTE)]
            colour = style.METHOD_COLOURS.get(method, other)
            draw(axes, frames, "return_mean", of_suite(method), colour)
        if task.goal is not None:
            axes.axhline(task.goal, color="0.5", linestyle=":", linewidth=1.0)
        axes.set_title(task.title)
    for axes in grid[max(0, len(tasks) - columns) : len(tasks)]:
        axes.set_xlabel("environment steps (1000)")
    for axes in grid[::columns]:
        axes.set_ylabel("return")
    return style.legend_below(figure, grid)
