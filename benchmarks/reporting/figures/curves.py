"""Training curves over seeds with their bands, and marks of the curriculum's switch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from benchmarks.reporting.figures.style import METHOD_COLOURS, PALETTE, TRACK_STYLES
from benchmarks.reporting.results import Group
from benchmarks.reporting.stats import mean_band, moving_average

EPISODES: Final = 10  # of the paper's moving average
POINTS: Final = 300
BY_EPISODE: Final = frozenset({"episode_reward", "holes", "success", "duration"})

Curve = NDArray[np.float64]


def look(group: Group) -> tuple[str, str]:
    """Colour and line style of a group's method and track."""
    cell = group.runs[0].config["cell"]
    method = "masked_dqn" if cell["ablation"] == "none" else cell["method"]
    return METHOD_COLOURS.get(method, PALETTE[-1]), TRACK_STYLES.get(cell["track"], "-.")


def curve_frames(group: Group) -> list[pd.DataFrame]:
    """The stored training curves of a group's runs, one per seed."""
    return [run.folder.rows("curve") for run in group.runs if run.folder.has_rows("curve")]


def series(frame: pd.DataFrame, column: str, window: int) -> tuple[Curve, Curve]:
    """Steps and values of one run; what counts episodes as the mean of the last ``window``."""
    counts = frame["episodes"].diff().fillna(frame["episodes"]).clip(lower=1)
    rows = frame.assign(counts=counts)[["timesteps", column, "counts"]].dropna()
    steps, values = rows["timesteps"].to_numpy(float), rows[column].to_numpy(float)
    if column in BY_EPISODE:
        values = moving_average(values, window, rows["counts"])
    return steps, values


def seed_curves(
    frames: Sequence[pd.DataFrame], column: str, window: int = EPISODES
) -> tuple[Curve, Curve]:
    """Steps (T,) that all seeds share, and the seeds' values there (seeds, T); empty if none."""
    curves = [series(frame, column, window) for frame in frames]
    result = [(steps, values) for steps, values in curves if len(steps)]
    if not result:
        return np.empty(0), np.empty((0, 0))
    start = max(steps[0] for steps, _ in result)
    grid = np.linspace(start, max(start, min(steps[-1] for steps, _ in result)), POINTS)
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in result])


def draw_curve(
    axes: Axes,
    frames: Sequence[pd.DataFrame],
    column: str,
    label: str,
    colour: str,
    style: str = "-",
    band: bool = True,
    raw: bool = False,
    window: int = EPISODES,
) -> None:
    """Mean over seeds with its 95 % band, and with ``raw`` the unsmoothed mean faintly behind."""
    grid, values = seed_curves(frames, column, window)
    if not len(grid):
        return
    if raw:
        rough_grid, rough = seed_curves(frames, column, 1)
        axes.plot(rough_grid, rough.mean(axis=0), color=colour, alpha=0.25, linewidth=0.7)
    mean, low, high = mean_band(values)
    axes.plot(grid, mean, style, color=colour, label=label, linewidth=1.4)
    if band:
        axes.fill_between(grid, low, high, color=colour, alpha=0.2, linewidth=0)


def draw_stages(axes: Axes, frames: Sequence[pd.DataFrame], label: str, colour: str) -> None:
    """Holes per episode, dashed while a seed is in stage 0 and solid in stage 1.

    At steps where seeds are in different stages each stage has the mean of its own seeds, and no
    band.
    """
    grid, values = seed_curves(frames, "holes")
    if not len(grid):
        return
    kept = [frame for frame in frames if frame["holes"].notna().any()]
    stages = np.stack([_stage_at(frame, grid) for frame in kept])
    for stage, style in ((0, "--"), (1, "-")):
        inside = stages == stage
        count = inside.sum(axis=0)
        with np.errstate(invalid="ignore"):
            mean = np.where(inside, values, 0.0).sum(axis=0) / count
        if not count.any():
            continue
        axes.plot(grid, mean, style, color=colour, label=f"{label}, stage {stage}", linewidth=1.4)
        _, low, high = mean_band(values)
        whole = count == len(values)
        axes.fill_between(grid, low, high, where=whole, color=colour, alpha=0.2, linewidth=0)


def _stage_at(frame: pd.DataFrame, grid: Curve) -> NDArray[np.int64]:
    steps = frame["timesteps"].to_numpy(float)
    rows = np.clip(np.searchsorted(steps, grid), 0, len(steps) - 1)
    return np.asarray(frame["stage"].to_numpy()[rows], dtype=np.int64)


def switches(group: Group) -> list[float]:
    """Steps at which each seed's curriculum went from four holes to six."""
    steps = [run.meta.get("training", {}).get("curriculum_switch") for run in group.runs]
    return [float(step) for step in steps if step is not None]


def mark_switches(axes: Axes, groups: Sequence[tuple[Group, str]]) -> None:
    """A dotted line at each seed's curriculum switch, in the colour of its method."""
    marked = False
    for group, colour in groups:
        for step in switches(group):
            label = None if marked else "curriculum switch"
            axes.axvline(step, color=colour, linestyle=":", linewidth=0.9, alpha=0.8, label=label)
            marked = True
