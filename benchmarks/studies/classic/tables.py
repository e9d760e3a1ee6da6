"""Tables of the classic tasks, from stored data alone."""

from __future__ import annotations

import math

from benchmarks.reporting.stats import (
    interquartile_mean,
    over_seeds,
    probability_of_improvement,
    stratified_bootstrap,
)
from benchmarks.reporting.tables.table import Cell, Number, Table
from benchmarks.studies.classic.environments.named import MASKED_IDENTITY
from benchmarks.studies.classic.presets import Preset, label
from benchmarks.studies.classic.results import Ratio, Results
from benchmarks.studies.robots.contact_report import build_contact_tables

_INTERVAL = "Student's 95 % interval, of three seeds or more"
_MASKS = (
    "The masked identity task: only Rainbow reads masks; to DQN and QR-DQN an action that is not "
    "allowed is one more wrong answer."
)

_CONTROLS = {
    "random": "Random: every allowed action as likely.",
    "held": "One action: all the time the one that is best on the episodes by which a learner is "
    "tested during training.",
    "script": "Script: a few lines by hand on a learner's observation "
    "(`benchmarks/studies/classic/environments/controls.py`).",
}


def build_tables(results: Results) -> list[Table]:
    """All tables that the stored runs can fill."""
    if results.preset.search:
        return [_search(results), _settings(results.preset)]
    tables = []
    if results.preset.tasks:
        tables.append(_scores(results))
        if results.preset.controls:
            tables.append(_controls(results))
        if any(task.human is not None for task in results.preset.tasks.values()):
            tables.append(_normalized(results))
        # who reads masks beside who does not is no comparison of learners
        tasks = [k for k, task in results.preset.tasks.items() if task.env != MASKED_IDENTITY]
        if len(tasks) > 1 and len(results.preset.methods) > 1:
            tables.append(_together(results, tasks))
        tables += [*build_contact_tables(results), _speed(results), _settings(results.preset)]
    if results.preset.cliff:
        tables.append(_cliff(results))
    return tables


def _scores(results: Results) -> Table:
    preset = results.preset
    published = ["Published"] if any(task.published for task in preset.tasks.values()) else []
    rows: list[list[Cell]] = []
    for key, task in preset.tasks.items():
        values = [results.score(key, method) for method in preset.methods]
        counts = [str(len(results.runs(key, method))) for method in preset.methods]
        if len(set(counts)) == 1:
            counts = counts[:1]
        goal = "-" if task.goal is None else f"{task.goal:g}"
        row: list[Cell] = [task.title, f"{task.timesteps:,}", goal, "/".join(counts)]
        row += [_with_interval(v.mean, v.low, v.high) for v in values]
        if published:
            row.append(", ".join(f"{task.published[who]:g}" for who in task.published) or "-")
        rows.append(row)
    marks = dict.fromkeys(who for task in preset.tasks.values() for who in task.published)
    notes = [f"Published, in this order and by protocols of their own: {'; '.join(marks)}."]
    return Table(
        "scores",
        f"Return of the last greedy policy, {preset.final_episodes} test episodes per seed",
        ["Task", "Steps", "Goal", "Seeds", *(label(m) for m in preset.methods), *published],
        rows,
        [
            f"Mean over seeds [{_INTERVAL}]; test episodes begin from seeds that neither training "
            "nor the evaluations during training use.",
            *(notes if published else []),
            *([_MASKS] if any(t.env == MASKED_IDENTITY for t in preset.tasks.values()) else []),
        ],
    )


def _controls(results: Results) -> Table:
    """What plays without learning, on the learners' test episodes, beside the first method."""
    preset = results.preset
    columns = [preset.methods[0], *preset.controls]
    rows: list[list[Cell]] = []
    for key, task in preset.tasks.items():
        values = [results.score(key, name) for name in columns]
        rows.append([task.title, *(_with_interval(v.mean, v.low, v.high) for v in values)])
    return Table(
        "controls",
        "Without learning, on the same test episodes",
        ["Task", *map(label, columns)],
        rows,
        [" ".join(_CONTROLS[name] for name in preset.controls)],
    )


def _search(results: Results) -> Table:
    """Variants by row: what each scored, and how many seeds of it were run."""
    preset = results.preset
    rows: list[list[Cell]] = []
    for method in preset.methods:
        row: list[Cell] = [label(method)]
        for key in preset.tasks:
            value = results.score(key, method)
            row += [str(value.n), _with_interval(value.mean, value.low, value.high)]
        rows.append(row)
    header = [word for task in preset.tasks.values() for word in ("Seeds", task.title)]
    return Table(
        "scores",
        f"Return of the last greedy policy, {preset.final_episodes} episodes per seed",
        ["Variant", *header],
        rows,
        [f"Mean over seeds [{_INTERVAL}]; of one seed it is a lead."],
    )


def _normalized(results: Results) -> Table:
    """Scores in which a random player has 0 and a human one 1."""
    rows: list[list[Cell]] = []
    for key, task in results.preset.tasks.items():
        if task.human is None or task.random is None:
            continue
        base, scale = task.random, task.human - task.random
        row: list[Cell] = [task.title, f"{task.random:g}", f"{task.human:g}"]
        for method in results.preset.methods:
            v = results.score(key, method)
            mean, low, high = ((value - base) / scale for value in (v.mean, v.low, v.high))
            row.append(_with_interval(mean, low, high, 3))
        marks = ((value - base) / scale for value in task.published.values())
        rows.append([*row, ", ".join(f"{mark:.3f}" for mark in marks) or "-"])
    methods = [label(method) for method in results.preset.methods]
    return Table(
        "normalized",
        "Human-normalized: a random player has 0, a human 1",
        ["Task", "Random", "Human", *methods, "Published"],
        rows,
    )


def _together(results: Results, tasks: list[str]) -> Table:
    """All tasks at once, and how likely a run of the first method is better than another."""
    preset = results.preset
    scores = {method: results.scores(method, tasks) for method in preset.methods}
    ours = preset.methods[0]
    rows: list[list[Cell]] = []
    for method, theirs in scores.items():
        low, high = stratified_bootstrap(theirs) if len(theirs) else (math.nan, math.nan)
        mean = interquartile_mean(theirs) if len(theirs) else math.nan
        better = "-"
        if method != ours:
            value = probability_of_improvement(scores[ours], theirs)
            better = _with_interval(value.mean, value.low, value.high, 2)
        row: list[Cell] = [label(method), str(len(theirs)), _with_interval(mean, low, high, 2)]
        rows.append([*row, better])
    return Table(
        "together",
        f"All {len(tasks)} tasks together",
        ["Method", "Seeds", "Interquartile mean", f"P({label(ours)} is better)"],
        rows,
        [
            "Scores are scaled so that on each task the worst run of any method is 0 and the best "
            "is 1. Interquartile mean and probability of improvement as Agarwal et al. 2021 define "
            "them, [95 % stratified bootstrap interval over seeds].",
        ],
    )


def _with_interval(mean: float, low: float, high: float, digits: int | None = None) -> str:
    if math.isnan(mean):
        return "-"
    if digits is None:
        digits = 0 if abs(mean) >= 100 else 1
    text = f"{mean:.{digits}f}"
    return text if math.isnan(low) else f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


def _speed(results: Results) -> Table:
    rows: list[list[Cell]] = []
    for key, task in results.preset.tasks.items():
        for method in results.preset.methods:
            runs = results.runs(key, method)
            there: list[Cell] = ["-", "-"]
            if task.goal is not None:
                steps = over_seeds([run.steps_to(task.goal) for run in runs])
                there = [Number(steps, 0), f"{steps.n} of {len(runs)}"]
            trained = [run.meta["training"] for run in runs]
            updates = Number(over_seeds([training["updates"] for training in trained]), 0)
            minutes = over_seeds([training["cpu_seconds"] / 60.0 for training in trained])
            rows.append([task.title, label(method), *there, updates, Number(minutes, 1)])
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


def _settings(preset: Preset) -> Table:
    rows: list[list[Cell]] = []
    for task in preset.tasks.values():
        for method in preset.methods:
            arguments = task.methods[method]
            words = [f"{key}={_value(value)}" for key, value in sorted(arguments.items())]
            if task.n_envs > 1:
                words.append(f"(n_envs={task.n_envs})")
            rows.append([task.title, label(method), ", ".join(words)])
    return Table(
        "settings",
        "Settings: what differs from each constructor's defaults",
        ["Task", "Method", "Arguments"],
        rows,
    )


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "dict(" + ", ".join(f"{k}={_value(v)}" for k, v in value.items()) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _cliff(results: Results) -> Table:
    rows: list[list[Cell]] = []
    for key, variant in results.preset.cliff.items():
        for states in variant.states:
            ratio = results.ratio(key, states)
            if ratio is not None:
                rows.append(_cliff_row(variant.title, ratio))
    return Table(
        "cliff",
        "Blind cliff walk: updates until it is learned, uniform and prioritized replay",
        ["Learner", "States", "Transitions", "Uniform", "Prioritized", "Ratio", "Seeds"],
        rows,
        [
            "Medians over seeds; ratio of the medians [95 % bootstrap interval over seeds]. Runs "
            "that hit the limit of updates count with it: with uniform replay the ratio is then a "
            "lower bound (>), with prioritized replay an upper one (<), with both neither (~).",
            "Learned: mean squared error of all Q-values below 0.001 (of PER alone); the greedy "
            "policy right in every state, for good (of all of Rainbow, whose n-step returns of a "
            "random policy are not the optimal ones).",
        ],
    )


def _cliff_row(title: str, ratio: Ratio) -> list[Cell]:
    late = bool(ratio.censored["uniform"]), bool(ratio.censored["prioritized"])
    mark = {(True, True): "~", (True, False): ">", (False, True): "<"}.get(late, "")
    value = ratio.ratio
    often = {replay: ">" if 2 * n >= ratio.n else "" for replay, n in ratio.censored.items()}
    return [
        title,
        str(ratio.states),
        f"{2 ** (ratio.states + 1) - 2:,}",
        f"{often['uniform']}{ratio.uniform:,.0f}",
        f"{often['prioritized']}{ratio.prioritized:,.0f}",
        f"{mark}{value.mean:.1f} [{value.low:.1f}, {value.high:.1f}]",
        str(ratio.n),
    ]
