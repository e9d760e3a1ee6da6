"""The paper's learning figures and a robustness curve, from stored data alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import labels
from benchmarks.results import Group, Results
from benchmarks.stats import moving_average
from benchmarks.store import Store, write_atomic

SMOOTHING: Final = 10

# figure name -> (columns of curve.csv, axis label, logarithmic)
CURVES: Final[dict[str, tuple[tuple[str, ...], str, bool]]] = {
    "cumulative_reward": (("episode_reward",), "Episode reward", False),
    "exploration": (("learning_rate", "noise"), "Learning rate; exploration", True),
    "holes": (("holes",), "Holes per episode", False),
    "success": (("success",), "Success rate", False),
    "max_q": (("mean_max_q",), "Mean max Q", False),
    "loss": (("loss",), "Loss", True),
    "duration": (("duration",), "Episode duration (s)", False),
}


def write_figures(store: Store) -> list[Path]:
    """Draw all figures of a store; returns their paths."""
    results = Results(store)
    paths = []
    for track in results.tracks():
        methods = {
            labels.METHODS[method]: results.group(method, track=track)
            for method in ("rainbow", "dqn")
        }
        for name, (columns, title, log) in CURVES.items():
            figure = _curves(methods, columns, title, log)
            paths.append(_save(store, f"{track}_{name}", figure))
        ablations = {
            title: results.group("rainbow", track=track, ablation=key)
            for key, title in labels.ABLATIONS.items()
        }
        figure = _curves(ablations, ("success",), "Success rate", False)
        paths.append(_save(store, f"{track}_ablation", figure))
        geometries = {
            f"{name} geometry": results.group("rainbow", name, track)
            for name in ("optimized", "initial")
        }
        figure = _curves(geometries, ("success",), "Success rate", False)
        paths.append(_save(store, f"{track}_geometry", figure))
    if results.tracks():
        paths.append(_save(store, "robustness", _robustness(results)))
    return paths


def _axes() -> tuple[Figure, Axes]:
    figure, axes = plt.subplots(figsize=(6.0, 3.6), dpi=110, layout="constrained")
    axes.grid(alpha=0.3)
    return figure, axes


def _save(store: Store, name: str, figure: Figure) -> Path:
    path = store.figures / f"{name}.png"
    # no creation date: the same data must give the same file
    metadata = {"Software": None}
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", metadata=metadata))
    plt.close(figure)
    return path


def _curves(groups: dict[str, Group], columns: tuple[str, ...], title: str, log: bool) -> Figure:
    figure, axes = _axes()
    drawn = False
    for colour, (name, group) in enumerate(groups.items()):
        frames = [run.folder.rows("curve") for run in group.runs if run.folder.has_rows("curve")]
        for style, column in zip(("-", "--"), columns, strict=False):
            label = name if len(columns) == 1 else f"{name}: {_quantity(column, group)}"
            drawn |= _curve(axes, frames, column, label, f"C{colour}", style)
        for steps in _switches(group):
            axes.axvline(steps, color=f"C{colour}", linestyle=":", linewidth=1.0)
    axes.set_xlabel("Environment steps (dotted: curriculum switch)")
    axes.set_ylabel(title)
    if log and drawn:
        axes.set_yscale("log")
    if drawn:
        axes.legend(fontsize=8)
    return figure


def _quantity(column: str, group: Group) -> str:
    """What a column holds: without noisy layers "noise" is the epsilon of epsilon-greedy."""
    if column != "noise":
        return column.replace("_", " ")
    cells = [run.config["cell"] for run in group.runs]
    greedy = any(c["method"] == "dqn" or c["ablation"] == "no_noisy" for c in cells)
    return "epsilon" if greedy else "noise magnitude"


def _curve(
    axes: Axes, frames: Iterable[pd.DataFrame], column: str, label: str, colour: str, style: str
) -> bool:
    """Mean over seeds with the range between them, on the steps that all seeds share."""
    series = []
    for frame in frames:
        rows = frame[["timesteps", column]].dropna()
        if len(rows):
            steps = rows["timesteps"].to_numpy(dtype=float)
            series.append((steps, moving_average(rows[column].to_numpy(dtype=float), SMOOTHING)))
    if not series:
        return False
    end = min(steps[-1] for steps, _ in series)
    grid = np.linspace(max(steps[0] for steps, _ in series), end, 300)
    values = np.stack([np.interp(grid, steps, y) for steps, y in series])
    axes.plot(grid, values.mean(axis=0), style, color=colour, label=label, linewidth=1.3)
    if len(series) > 1:
        low, high = values.min(axis=0), values.max(axis=0)
        axes.fill_between(grid, low, high, color=colour, alpha=0.2, linewidth=0)
    return True


def _switches(group: Group) -> list[float]:
    steps = [run.meta.get("training", {}).get("curriculum_switch") for run in group.runs]
    return [float(step) for step in steps if step is not None]


def _robustness(results: Results) -> Figure:
    figure, axes = _axes()
    levels = results.noise_levels()
    for method in ("rainbow", "dqn"):
        for track in results.tracks():
            group = results.group(method, track=track)
            if not group.n:
                continue
            values = [group.success(level) for level in levels]
            mean = np.array([value.mean for value in values])
            error = np.array([
                [value.mean - value.low for value in values],
                [value.high - value.mean for value in values],
            ])  # fmt: skip
            label = f"{labels.METHODS[method]}, {labels.track(track)}"
            axes.errorbar(levels, mean, np.maximum(error, 0.0), label=label, capsize=3, marker="o")
    axes.set_xlabel("Observation noise (share of the normalized range)")
    axes.set_ylabel("Success rate (%)")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
    return figure
