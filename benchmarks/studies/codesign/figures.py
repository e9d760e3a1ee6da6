"""The figure of the co-design: fronts, the paper's designs, and what the area says of success."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.protocol.metrics import SUCCESS
from benchmarks.reporting.figures.style import PALETTE, canvas, legend_below, save, style
from benchmarks.reporting.stats import Value
from benchmarks.studies.codesign.result import SearchResult
from benchmarks.studies.codesign.spaces import ALL, STUDIES
from benchmarks.studies.codesign.text import SYMBOLS, over

NAMED: Final = {"initial": "s", "optimized": "o"}
#: by a design's name, or by the first reason for which it was chosen
COLOURS: Final = {
    "initial": PALETTE[1], "optimized": PALETTE[2], "largest A_w": PALETTE[3],
    "quickest": PALETTE[4], "surest": PALETTE[6],
}  # fmt: skip
BELOW: Final = 3.0  # shown below the floor, %


def write_figures(result: SearchResult) -> list[Path]:
    """Draw the figure as PNG and PDF; returns the paths."""
    with style():
        figure = fronts(result)
        folder = result.folder / "figures"
        return [save(figure, folder / f"fronts.{kind}") for kind in ("png", "pdf")]


def fronts(result: SearchResult) -> Figure:
    """Of each study success and ticks of its designs, and success over the area."""
    figure, panels = canvas(len(STUDIES), 2, (7.2, 6.6))
    for row, study in enumerate(STUDIES):
        _draw_front(panels[2 * row], result, study)
        _draw_area(panels[2 * row + 1], result, study)
    legend_below(figure, panels)
    return figure


def _draw_front(axes: Axes, result: SearchResult, study: str) -> None:
    rows, floor = result.of_study(study), float(result.summary["floor"])
    axes.plot(rows["ticks"], rows["success"], ".", color="0.75", ms=3, label="validation starts")
    front = result.front(study)
    axes.plot(front["ticks"], front["success"], "-", drawstyle="steps-post", color=PALETTE[5],
              lw=1.2, marker=".", label="front, validation starts")  # fmt: skip
    shown = [*front["ticks"]]
    for name, look, tests in _chosen(result, study):
        ticks, success = over(tests["ticks"]), over(tests["success"])
        shown.append(ticks.mean)
        floor = min(floor, success.mean)
        axes.errorbar(ticks.mean, success.mean, xerr=_arms(ticks), yerr=_arms(success),
                      label=f"{name}, test starts", **look)  # fmt: skip
    axes.set_ylim(floor - BELOW, 100.5)
    shown = [x for x in shown if not math.isnan(x)] or [0.0]
    axes.set_xlim(min(shown) - 0.7, max(shown) + 0.7)
    axes.set(title=f"{SYMBOLS[study]}: the optimum", xlabel="mean ticks of the starts solved",
             ylabel="success (%)")  # fmt: skip


def _draw_area(axes: Axes, result: SearchResult, study: str) -> None:
    rows = result.of_study(study)
    axes.plot(rows["a_w"], rows["success"], ".", color="0.75", ms=3)
    for _, look, tests in _chosen(result, study):
        design = tests["design"].iloc[0]
        value = result.policies(design).value(SUCCESS)
        area = float(result.designs.loc[design, "a_w"])
        if value.n:
            axes.errorbar(area, value.mean, yerr=_arms(value), **{**look, "mfc": look["color"]},
                          label="filled: policy of the design's own")  # fmt: skip
    axes.set(title=f"{SYMBOLS[study]}: success by area", xlabel="$A_w$ (rad²)", ylim=(-2, 102))


def _chosen(result: SearchResult, study: str) -> list[tuple[str, dict[str, Any], Any]]:
    """Name, look and test rows of the designs that belong into a study's panels."""
    drawn = []
    for design, tests in result.chosen.groupby("design", sort=False):
        name, of = str(design), result.designs.loc[str(design), "study"]
        if of in (study, ALL) or name in NAMED:
            label = name if "-" not in name else tests["chosen"].iloc[0].partition(": ")[2]
            colour = COLOURS.get(label.partition(",")[0], PALETTE[2])
            look = {"color": colour, "marker": NAMED.get(name, "D"), "ms": 6, "mfc": "white",
                    "capsize": 2, "ls": "none", "lw": 1.0, "zorder": 5}  # fmt: skip
            drawn.append((label, look, tests))
    return drawn


def _arms(value: Value) -> list[list[float]] | None:
    if math.isnan(value.low):
        return None
    return [[max(0.0, value.mean - value.low)], [max(0.0, value.high - value.mean)]]
