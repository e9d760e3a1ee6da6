"""Learning curves and the cliff walk, from stored data alone."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any, Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.runs.store import Store, write_atomic
from benchmarks.studies.classic.plan import REPLAYS
from benchmarks.studies.classic.results import Results
from benchmarks.studies.classic.tables import NAMES

COLOURS: Final = {"rainbow": "#0072B2", "dqn": "#D55E00", "qrdqn": "#009E73"}
REPLAY_COLOURS: Final = {"prioritized": "#0072B2", "uniform": "#D55E00"}
STYLE: Final[Any] = {
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.dpi": 110,
}


def write_figures(results: Results, store: Store) -> list[Path]:
    """Draw what the stored runs can show; returns the paths."""
    paths = []
    with plt.rc_context(STYLE):
        if results.preset.tasks:
            paths.append(_save(store, "curves", _curves(results)))
        if results.preset.cliff:
            paths.append(_save(store, "cliff", _cliff(results)))
    return paths


def _save(store: Store, name: str, figure: Figure) -> Path:
    path = store.figures / f"{name}.png"
    # no creation date: the same data must give the same file
    metadata = {"Software": None}
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", metadata=metadata))
    plt.close(figure)
    return path


def _curves(results: Results) -> Figure:
    tasks = results.preset.tasks
    columns = min(4, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    size = (2.6 * columns, 2.2 * rows + 0.4)
    figure, grid = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axes in grid.flat[len(tasks) :]:
        axes.set_visible(False)
    for axes, (key, task) in zip(grid.flat, tasks.items(), strict=False):
        for method in results.preset.methods:
            curve = results.curve(key, method)
            if curve is None:
                continue
            steps, mean, low, high = curve
            axes.plot(steps / 1e3, mean, color=COLOURS[method], label=NAMES[method], linewidth=1.3)
            axes.fill_between(steps / 1e3, low, high, color=COLOURS[method], alpha=0.2, linewidth=0)
        if task.goal is not None:
            axes.axhline(task.goal, color="0.5", linestyle=":", linewidth=1.0)
        axes.set_title(task.title)
        axes.grid(alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel("environment steps (1000)")
    for axes in grid[:, 0]:
        axes.set_ylabel("return")
    handles = {}
    for axes in grid.flat:
        handles.update(dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True)))
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False
    )
    return figure


def _cliff(results: Results) -> Figure:
    variants = results.preset.cliff
    figure, panels = plt.subplots(
        1, len(variants), figsize=(3.2 * len(variants), 2.8), layout="constrained", squeeze=False
    )
    for axes, (key, variant) in zip(panels[0], variants.items(), strict=True):
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
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("updates (median, quartiles)")
    panels[0][0].legend(frameon=False)
    return figure
