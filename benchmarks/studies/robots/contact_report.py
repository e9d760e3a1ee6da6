"""What learners did on the contact task's tests, beside the scripts: tables and a figure."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.protocol.labels import of_suite
from benchmarks.protocol.presets import CONTACT
from benchmarks.reporting.figures.style import METHOD_COLOURS, PALETTE, canvas, legend_below
from benchmarks.reporting.tables.table import Table, TableCell
from benchmarks.studies.classic.results import SuiteResults, student
from benchmarks.studies.robots.trials import (
    CONDITIONS,
    DRAWN,
    ERRORS,
    FRICTIONS,
    TRAINED,
    causes,
    in_cell,
    shown,
)

#: of a cell of these tables
WHAT: Final = "success (%) / median time of successes (s) / median peak force (N)"
COLUMNS: Final = ("success", "time", "force", "failure")
Found = dict[str, list[Any]]


def levels(results: SuiteResults) -> dict[str, str]:
    """The preset's contact tasks: their keys, and the level of each."""
    tasks = results.preset.tasks.items()
    return {key: task.env_kwargs["level"] for key, task in tasks if task.env == CONTACT}


def _of(rows: pd.DataFrame, error: float | None, friction: float | None) -> Found:
    """The episodes under one condition, as the scripts' are stored."""
    rows = rows.astype({"success": bool})
    same = _equal(rows["error"], error) & _equal(rows["friction"], friction)
    chosen = rows[same].fillna({"failure": ""})
    return {name: chosen[name].tolist() for name in COLUMNS}


def _equal(column: pd.Series[Any], value: float | None) -> pd.Series[bool]:
    return column.isna() if value is None else column == value


def _scripts(results: SuiteResults, level: str) -> dict[str, Any]:
    """The scripts' episodes of a level, where the study ``contact`` has stored them."""
    path = results.root / "contact" / "scripts.json"
    if not path.is_file():
        return {}
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["parts"]
    return result.get(level, {})


def _learned(results: SuiteResults, task: str) -> Iterator[tuple[str, int, pd.DataFrame, str]]:
    """Method, seeds, episodes of all of them, and the interval of the success as trained for."""
    for method in results.preset.methods:
        runs = results.runs(task, method)
        if not runs:
            continue
        each = [_of(run.rows("contact"), DRAWN, None)["success"] for run in runs]
        value = student([100.0 * float(np.mean(won)) for won in each])
        interval = f"{value.mean:.1f}"
        if not math.isnan(value.low):
            interval += f" [{max(value.low, 0.0):.1f}, {min(value.high, 100.0):.1f}]"
        yield method, len(runs), pd.concat([run.rows("contact") for run in runs]), interval


def build_contact_tables(results: SuiteResults) -> list[Table]:
    """Success, time and force over the hole's error and over friction; none without such a task."""
    drawn: list[list[TableCell]] = []
    over_errors: list[list[TableCell]] = []
    over_frictions: list[list[TableCell]] = []
    for task, level in levels(results).items():
        for method, seeds, rows, interval in _learned(results, task):
            result = [_of(rows, error, None) for error in CONDITIONS]  # the last: as drawn
            first: list[TableCell] = [level, of_suite(method), str(seeds)]
            over_errors.append([*first, *map(in_cell, result)])
            drawn.append([*first, over_errors[-1][-1], interval, causes(result)])
            rubbed = [in_cell(_of(rows, TRAINED, friction)) for friction in FRICTIONS]
            over_frictions.append([*first, *rubbed])
        for name, one in _scripts(results, level).items():
            first = [level, name, "-"]
            share = f"{100.0 * np.mean(one['errors'][-1]['success']):.1f}"
            over_errors.append([*first, *map(in_cell, one["errors"])])
            drawn.append([*first, over_errors[-1][-1], share, causes(one["errors"])])
            over_frictions.append([*first, *map(in_cell, one["frictions"])])
    if not over_errors:
        return []
    head, size = ["Level", "Method", "Seeds"], f"{TRAINED:g} mm"
    same = "The same test episodes for all; medians and failures over the episodes of all seeds. "
    return [
        Table(
            "contact",
            f"Contact task, the hole displaced as the task draws it: {WHAT}",
            [*head, shown(DRAWN), "success [95 %]", "failures to 5 mm"],
            drawn,
            [f"{same}Rainbow and DQN act in twelve moves."],
            left=(0, 1),
        ),
        Table(
            "displacement",
            f"Contact task over the hole's displacement: {WHAT}",
            [*head, *map(shown, CONDITIONS)],
            over_errors,
            [f"{same}Beyond {size} is outside of training."],
            left=(0, 1),
        ),
        Table(
            "friction",
            f"Contact task at {size} over friction: {WHAT}",
            [*head, *(f"{f:g}" for f in FRICTIONS)],
            over_frictions,
            left=(0, 1),
        ),
    ]


def draw(results: SuiteResults) -> Figure:
    """Success, time and force over the hole's error: learners solid, scripts dashed."""
    tasks = levels(results)
    figure, axes = canvas(3, len(tasks), (3.6 * len(tasks), 6.4), sharex=True, sharey=False)
    grid = np.array(axes).reshape(3, len(tasks))
    for column, (task, level) in zip(grid.T, tasks.items(), strict=True):
        for method, _, rows, _ in _learned(results, task):
            result = [_of(rows, error, None) for error in ERRORS]
            colour = METHOD_COLOURS.get(method, PALETTE[-1])
            _lines(column, result, of_suite(method), colour, "-")
        for number, (name, one) in enumerate(_scripts(results, level).items()):
            _lines(column, one["errors"][: len(ERRORS)], name, str(0.15 + 0.2 * number), "--")
        column[0].set_title(f"level {level}")
        column[-1].set_xlabel("displacement of the hole (mm)")
    for axes_, what in zip(grid[:, 0], ("success (%)", "time (s)", "peak force (N)"), strict=True):
        axes_.set_ylabel(what)
    legend_below(figure, axes)
    return figure


def _lines(column: Any, result: list[Found], name: str, colour: str, style: str) -> None:
    won = [np.array(one["success"], bool) for one in result]
    times = [np.array(one["time"])[w] for one, w in zip(result, won, strict=True)]
    time = [np.median(each) if len(each) else np.nan for each in times]
    force = [np.median(one["force"]) for one in result]
    for axes, values in zip(column, ([100.0 * w.mean() for w in won], time, force), strict=True):
        axes.plot(ERRORS, values, style, color=colour, label=name, linewidth=1.2)
