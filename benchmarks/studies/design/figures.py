"""The paper's four design figures, before and after side by side, and one of the cliff in heave.

Drawn from stored data alone: nothing is computed here.
"""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchmarks.reporting.figures.style import PALETTE, canvas, save, style
from benchmarks.studies.design.analyses import DesignStore

TITLES: Final = {"initial": "Initial geometry", "optimized": "Optimized geometry"}
RIM: Final = PALETTE[4]


def write_figures(store: DesignStore) -> list[Path]:
    """Draw the figures, each as PDF and PNG; returns their paths."""
    with style():
        return [
            save(figure, store.figures / f"{draw.__name__}.{suffix}", draw in MAPS)
            for draw in (*MAPS, joint_trajectories, heave)
            for figure in [draw(store)]
            for suffix in ("pdf", "png")
        ]


def singularity_loci(store: DesignStore) -> Figure:
    """Signed sigma_min over roll and pitch at home's height, and where it vanishes."""
    maps = store.maps()
    angle = maps["angles_deg"]
    figure, panels = canvas(1, 2, (7.2, 3.75), grid=False, sharey=True)
    shades: Any = None
    for axes, name in zip(panels, TITLES, strict=True):
        sigma = maps[f"sigma_{name}"][0].astype(float).T
        inside = maps[f"inside_{name}"][0].astype(float).T
        axes.set_facecolor("0.86")
        shades = axes.pcolormesh(
            angle, angle, sigma, cmap="RdBu", norm=TwoSlopeNorm(0.0, -0.8, 1.0),
            shading="nearest", rasterized=True,
        )  # fmt: skip
        axes.contour(angle, angle, sigma, [0.0], colors="k", linewidths=1.4)
        axes.contour(angle, angle, inside, [0.5], colors=RIM, linewidths=1.6)
        axes.plot(0.0, 0.0, "k+", markersize=6)
        area = inside.sum() * math.radians(angle[1] - angle[0]) ** 2
        axes.set_title(f"{TITLES[name]}: $A_w$ = {area:.2f} rad²")
        ticks = range(-50, 51, 25)
        axes.set(aspect="equal", xlim=(-60, 60), ylim=(-60, 60), xticks=ticks, yticks=ticks)
        axes.set_xlabel("roll (°)")
    panels[0].set_ylabel("pitch (°)")
    bar = figure.colorbar(shades, ax=panels, shrink=0.86, pad=0.02, ticks=np.arange(-0.8, 1.1, 0.2))
    bar.set_label(r"signed $\sigma_{\min}(J)$ at heave 0.21 m")
    keys = [
        Line2D([], [], color="k", lw=1.4, label=r"parallel singularity, $\det A = 0$"),
        Line2D([], [], color=RIM, lw=1.6, label=r"$\Omega$: home's component, within limits"),
        Patch(facecolor="0.86", label="out of reach"),
    ]
    figure.legend(handles=keys, loc="outside lower center", ncols=3)
    return figure


def manipulability_3d(store: DesignStore) -> Figure:
    """The workspace in (roll, pitch, heave) as slices, coloured by 1 / kappa."""
    maps = store.maps()
    angle, heaves = maps["angles_deg"], 1e3 * maps["heaves"]
    figure = Figure(figsize=(7.2, 3.8))
    roll, pitch = np.meshgrid(angle, angle, indexing="ij")
    levels = np.linspace(0.0, 0.7, 15)
    shown: Any = None
    for column, name in enumerate(TITLES):
        axes: Any = figure.add_axes((0.44 * column, -0.04, 0.43, 1.04), projection="3d")
        for k, height in enumerate(heaves):
            inside, place = maps[f"inside_{name}"][k], {"zdir": "z", "offset": height}
            value = np.where(inside, maps[f"manipulability_{name}"][k].astype(float), np.nan)
            shown = axes.contourf(roll, pitch, value, levels, cmap="viridis", alpha=0.9, **place)
            rim = inside.astype(float)
            axes.contour(roll, pitch, rim, [0.5], colors="k", linewidths=0.6, **place)
        axes.patch.set_visible(False)
        figure.text(0.22 + 0.44 * column, 0.89, TITLES[name], ha="center")
        ticks = range(-40, 41, 20)
        axes.set(xlim=(-45, 45), ylim=(-45, 45), zlim=(heaves[0], heaves[-1]))
        axes.set(xticks=ticks, yticks=ticks, zticks=np.round(heaves).astype(int))
        axes.set_xlabel("roll (°)", labelpad=-2)
        axes.set_ylabel("pitch (°)", labelpad=-2)
        axes.set_zlabel("heave (mm)", labelpad=-1)
        axes.tick_params(pad=-1, labelsize=7)
        axes.set_box_aspect((1.0, 1.0, 1.25), zoom=0.95)
        axes.view_init(elev=20, azim=-58)
    bar_axes = figure.add_axes((0.915, 0.16, 0.018, 0.66))
    bar = figure.colorbar(shown, cax=bar_axes, ticks=np.arange(0.0, 0.71, 0.1))
    bar.set_label(r"manipulability $1/\kappa(J)$")
    return figure


def atlas(store: DesignStore) -> Figure:
    """A_w over the designs, with the optimizer's path: all of it, and near the optimum."""
    grid = store.rows("atlas").pivot(index="lambda2", columns="lambda1", values="a_w")
    paths, optima = store.rows("paths"), store.rows("optima").set_index("design")
    figure, panels = canvas(1, 2, (7.2, 3.5), grid=False)
    shown: Any = None
    levels, lambda1 = np.linspace(0.0, 1.2, 13), np.linspace(0.5, 2.0, 50)
    marks = (
        ("initial", "s", "initial"),
        ("nelder_mead", "*", "Nelder-Mead's optimum"),
        ("band 0.20-0.25", "D", "best over heave 0.20 to 0.25 m"),
    )
    for axes in panels:
        axes.set_facecolor("0.86")
        shown = axes.contourf(
            grid.columns, grid.index, grid.to_numpy(), levels, cmap="viridis", extend="max"
        )
        axes.plot(lambda1, 4.0 - 2.0 * lambda1, "k--", lw=1.0)
        axes.plot(lambda1, 4.0 - lambda1, "k--", lw=1.0)
        _draw_path(axes, paths[paths["seed"] == 0])
        for name, marker, label in marks:
            axes.plot(
                *optima.loc[name, ["lambda1", "lambda2"]], marker, color="white", label=label,
                markeredgecolor="k", markersize=11 if marker == "*" else 6, zorder=5,
            )  # fmt: skip
        axes.set_xlabel(r"$\lambda_1 = R_b/\eta$")
    whole, near = panels
    whole.set_ylabel(r"$\lambda_2 = 2L_1/\eta$")
    whole.set(title="Feasible designs", xlim=(0.5, 2.0), ylim=(0.3, 3.4))
    whole.text(0.8, 1.5, r"$\lambda_3 \geq \lambda_1$")
    whole.text(1.55, 2.75, r"$\lambda_3 \leq 0$")
    near.set(title="The optimizer's path", xlim=(1.3, 1.85), ylim=(1.35, 1.85))
    near.legend(loc="upper right", frameon=True, framealpha=0.9)
    bar = figure.colorbar(shown, ax=panels, shrink=0.9, pad=0.02, ticks=np.arange(0.0, 1.21, 0.2))
    bar.set_label(r"$A_w$ (rad²) at heave 0.21 m")
    return figure


def _draw_path(axes: Axes, path: pd.DataFrame) -> None:
    """Every design tried, and a line through those that were the best so far."""
    tried = path[path["a_w"].notna()]
    best = tried[tried["a_w"] > tried["a_w"].cummax().shift(fill_value=-1.0)]
    axes.plot(tried["lambda1"], tried["lambda2"], ".", color="white", markersize=2.5, alpha=0.8)
    axes.plot(best["lambda1"], best["lambda2"], "-", color=PALETTE[1], lw=1.4)


MAPS: Final = (singularity_loci, manipulability_3d, atlas)


def joint_trajectories(store: DesignStore) -> Figure:
    """Actuated angles along the test trajectory, with their limits, and the margins they keep."""
    rows = store.rows("trajectory")
    summary = {row["design"]: row for row in store.rows("validation").to_dict("records")}
    figure, panels = canvas(1, 2, (7.2, 3.0), grid=False, sharey=True)
    for axes, name in zip(panels, TITLES, strict=True):
        for limb in range(3):
            angle = np.degrees(rows[f"q{limb} {name}"])
            axes.plot(rows["time"], angle, color=PALETTE[limb], lw=1.4, label=f"$q_{limb + 1}$")
        at = summary[name]
        for limit in (12.0, 78.0):
            axes.axhline(limit, color="0.4", lw=0.9, ls="--")
        low, high = at["joint_low"], at["joint_high"]
        axes.axhspan(low, high, color="0.93", zorder=0)
        axes.set_title(
            f"{TITLES[name]}: [{low:.1f}°, {high:.1f}°], "
            rf"$\sigma_{{\min}} \geq$ {at['sigma_min']:.2f}"
        )
        axes.set(xlabel="time (s)", xlim=(0.0, rows["time"].iloc[-1]), ylim=(5.0, 85.0))
    panels[0].set_ylabel("actuated angle (°)")
    panels[0].text(0.15, 79.0, "limit", color="0.4", fontsize=7.5, va="bottom")
    panels[1].legend(loc="upper right", ncols=3, bbox_to_anchor=(1.0, 0.9))
    return figure


def heave(store: DesignStore) -> Figure:
    """A_w by heave of the three designs: the cliff below home, and the design without it."""
    rows = store.rows("heave")
    figure, (axes,) = canvas(size=(4.6, 2.9), grid=False)
    axes.axvspan(210.0, 250.0, color="0.94", zorder=0)
    axes.axvline(210.0, color="0.4", lw=0.9, ls="--")
    axes.text(209.6, 1.23, "home", ha="right", color="0.4", fontsize=7.5)
    names = {"initial": "initial", "optimized": "optimized (as printed)", "robust": "robust"}
    for colour, (name, label) in zip(PALETTE, names.items(), strict=False):
        axes.plot(1e3 * rows["heave"], rows[name], color=colour, lw=1.5, label=label)
    axes.set(xlabel="heave (mm); shaded: the range of the task", ylabel="$A_w$ (rad²)")
    axes.set(xlim=(190.0, 260.0), ylim=(0.0, 1.3))
    axes.legend(loc="lower left", bbox_to_anchor=(0.3, 0.02))
    return figure
