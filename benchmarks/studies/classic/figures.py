"""Learning curves, from stored data alone."""

from __future__ import annotations

import math
from typing import Final

from matplotlib.figure import Figure

from benchmarks.protocol.labels import of_suite
from benchmarks.reporting.figures.style import (
    METHOD_COLOURS,
    PALETTE,
    Picture,
    canvas,
    legend_below,
)
from benchmarks.studies.classic.results import SuiteResults
from benchmarks.studies.robots.contact_report import draw, levels

CURVES: Final = "Return of the last greedy policy over training"
CONTACT: Final = "Success, time and force over the hole's displacement"


def pictures(results: SuiteResults) -> list[Picture]:
    """What the stored runs can show."""
    result = []
    # of a search the curves would be more than can be told apart
    if results.preset.tasks and not results.preset.search:
        result.append(Picture("curves", CURVES, lambda: _curves(results)))
    if levels(results):
        result.append(Picture("contact", CONTACT, lambda: draw(results)))
    return result


def _curves(results: SuiteResults) -> Figure:
    tasks = results.preset.tasks
    columns = min(4, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure, grid = canvas(rows, columns, (2.6 * columns, 2.2 * rows + 0.4))
    for axes in grid[len(tasks) :]:
        axes.set_visible(False)
    for axes, (key, task) in zip(grid, tasks.items(), strict=False):
        for number, method in enumerate(results.preset.methods):
            curve = results.curve(key, method)
            if curve is None:
                continue
            steps, mean, low, high = curve
            colour = METHOD_COLOURS.get(method, PALETTE[(3 + number) % len(PALETTE)])
            axes.plot(steps / 1e3, mean, color=colour, label=of_suite(method), linewidth=1.3)
            axes.fill_between(steps / 1e3, low, high, color=colour, alpha=0.2, linewidth=0)
        if task.goal is not None:
            axes.axhline(task.goal, color="0.5", linestyle=":", linewidth=1.0)
        axes.set_title(task.title)
    for axes in grid[-columns:]:
        axes.set_xlabel("environment steps (1000)")
    for axes in grid[::columns]:
        axes.set_ylabel("return")
    legend_below(figure, grid)
    return figure
