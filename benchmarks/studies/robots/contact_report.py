"""What learners did on the contact task's tests, beside the scripts: tables and a figure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.protocol.labels import of_suite
from benchmarks.protocol.presets import CONTACT
from benchmarks.reporting.figures.style import METHOD_COLOURS, PALETTE, canvas, legend_below
from benchmarks.reporting.tables.table import Table
from benchmarks.studies.base import read_stored
from benchmarks.studies.classic.results import SuiteResults, student
from benchmarks.studies.robots import trials
from benchmarks.studies.robots.trials import CONDITIONS, DRAWN, in_cell, medians, shown


class Entry(NamedTuple):
    """A method's episodes under each error, the last as the task draws it."""

    level: str
    name: str
    seeds: str
    errors: list[dict[str, Any]]
    success: str
    look: dict[str, Any]


def levels(results: SuiteResults) -> dict[str, str]:
    """The preset's contact tasks on the scripts' machine, which does not err: key and level."""
    return {
        key: task.env_kwargs["level"]
        for key, task in results.preset.tasks.items()
        if task.env == CONTACT and "sim_to_real" not in task.env_kwargs
    }


def _of(rows: pd.DataFrame, error: float | None) -> dict[str, Any]:
    """The episodes under an error, as the scripts' are kept."""
    rows = rows[rows["error"].isna() if error is None else rows["error"] == error]
    return {str(k): v for k, v in rows.fillna({"failure": ""}).to_dict("list").items()}


def _entries(results: SuiteResults) -> Iterator[Entry]:
    """Learners, level by level, and the scripts that the study ``contact`` has stored."""
    path = results.root / "contact" / "scripts.json"
    stored = read_stored(path)["parts"] if path.is_file() else {}
    for task, level in levels(results).items():
        for method in results.preset.methods:
            if not (runs := [run.folder.rows("contact") for run in results.runs(task, method)]):
                continue
            value = student([medians(_of(rows, DRAWN))[0] for rows in runs])
            interval = ""
            if not math.isnan(value.low):
                interval = f" [{max(value.low, 0.0):.1f}, {min(value.high, 100.0):.1f}]"
            rows = pd.concat(runs)
            yield Entry(
                *(level, of_suite(method), str(len(runs))),
                [_of(rows, error) for error in CONDITIONS],
                f"{value.mean:.1f}{interval}",
                {"color": METHOD_COLOURS.get(method, PALETTE[-1])},
            )
        for number, (name, one) in enumerate(stored.get(level, {}).items()):
            success = f"{medians(one['errors'][-1])[0]:.1f}"
            look = {"color": str(0.15 + 0.2 * number), "linestyle": "--"}
            yield Entry(level, name, "-", one["errors"], success, look)


def build_contact_tables(results: SuiteResults) -> list[Table]:
    """Success, time and force over the hole's error; none without such a task."""
    if not (entries := list(_entries(results))):
        return []
    head, size = ["Level", "Method", "Seeds"], f"{trials.TRAINED:g} mm"
    same = "The same test episodes for all; medians over the episodes of all seeds. "
    return [
        Table(
            "contact",
            f"Contact task, the hole displaced as the task draws it, {shown(DRAWN)}",
            [*head, "Success (%) [95 %]", "Time (s)", "Peak force (N)"],
            [[*e[:3], e.success, *in_cell(e.errors[-1]).split(" / ")[1:]] for e in entries],
            [f"{same}Time of successes. Rainbow and DQN act in twelve moves."],
            left=(0, 1),
        ),
        Table(
            "displacement",
            f"Contact task over the hole's displacement: {trials.WHAT}",
            [*head, *map(shown, CONDITIONS)],
            [[*e[:3], *map(in_cell, e.errors)] for e in entries],
            [f"{same}Beyond {size} is outside of training."],
            left=(0, 1),
        ),
    ]


def draw(results: SuiteResults) -> Figure:
    """Success, time and force over the hole's error: learners solid, scripts dashed."""
    shown_levels = [*levels(results).values()]
    size = (3.6 * len(shown_levels), 6.4)
    figure, axes = canvas(3, len(shown_levels), size, sharex=True, sharey=False)
    grid = np.array(axes).reshape(3, len(shown_levels))
    for entry in _entries(results):
        column = grid[:, shown_levels.index(entry.level)]
        values = zip(*map(medians, entry.errors[: len(trials.ERRORS)]), strict=True)
        for each, line in zip(column, values, strict=True):
            each.plot(trials.ERRORS, line, label=entry.name, linewidth=1.2, **entry.look)
    for level, column in zip(shown_levels, grid.T, strict=True):
        column[0].set_title(f"level {level}")
        column[-1].set_xlabel("displacement of the hole (mm)")
    for each, what in zip(grid[:, 0], ("success (%)", "time (s)", "peak force (N)"), strict=True):
        each.set_ylabel(what)
    legend_below(figure, axes)
    return figure
