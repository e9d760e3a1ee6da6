"""Learning curves and the cliff walk, from stored data alone."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from benchmarks.reporting.figures.style import (
    METHOD_COLOURS,
    PALETTE,
    canvas,
    legend_below,
    save,
    style,
)
from benchmarks.runs.store import Store
from benchmarks.studies.classic.plan import REPLAYS
from benchmarks.studies.classic.presets import label
from benchmarks.studies.classic.results import Results
from benchmarks.studies.robots.contact_report import draw, levels

REPLAY_COLOURS: Final = {"prioritized": PALETTE[0], "uniform": PALETTE[1]}


def write_figures(results: Results, store: Store) -> list[Path]:
    """Draw what the stored runs can show; returns the paths."""
    paths = []
    with style():
        # of a search the curves would be more than can be told apart
        if results.preset.tasks and not results.preset.search:
            paths.append(save(_curves(results), store.figures / "curves.png"))
        if levels(results):
            paths.append(save(draw(results), store.figures / "contact.png"))
        if results.preset.cliff:
            paths.append(save(_cliff(results), store.figures / "cliff.png"))
    return paths


def _curves(results: Results) -> Figure:
    methods = results.preset.methods
    tasks = {
        key: task
        for key, task in results.preset.tasks.items()
        if any(results.curve(key, method) is not None for method in methods)
    } or results.preset.tasks
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
            axes.plot(steps / 1e3, mean, color=colour, label=label(method), linewidth=1.3)
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


def _cliff(results: Results) -> Figure:
    variants = results.preset.cliff
    figure, panels = canvas(1, len(variants), (3.2 * len(variants), 2.8))
    for axes, (key, variant) in zip(panels, variants.items(), strict=True):
        for replay in REPLAYS:
            found = {n: results.updates(key, replay, n) for n in variant.states}
            shown = {n: np.minimum(u, variant.limit) for n, u in found.items() if u is not None}
            if not shown:
                continue
            quartiles = np.array([np.percentile(u, [25, 50, 75]) for u in shown.values()])
            colour, states = REPLAY_COLOURS[replay], list(shown)
            axes.plot(states, quartiles[:, 1], "o-", color=colour, label=replay, markersize=3.5)
            axes.fill_between(states, quartiles[:, 0], quartiles[:, 2], color=colour, alpha=0.2)
        axes.axhline(variant.limit, color="0.5", linestyle=":", linewidth=1.0)
        axes.set_yscale("log")
        axes.set_xticks(variant.states)
        axes.set_title(textwrap.fill(variant.title, 32))
        axes.set_xlabel("states")
    panels[0].set_ylabel("updates (median, quartiles)")
    panels[0].legend()
    return figure
