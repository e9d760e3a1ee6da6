"""One look for every figure of the harness: fonts, colours, axes, legends, reproducible files.

    with style():
        figure, (axes,) = canvas()
        axes.plot(x, y, color=METHOD_COLOURS["rainbow"], label="Rainbow")
        finish(axes, "Success rate (%)")
        save(figure, folder / "success.png")  # or .pdf

Figures are made without pyplot, so that none is left open, and the look holds inside ``style()``
alone. The same data give the same bytes.
"""

import io
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from benchmarks.protocol.learners import LEARNERS
from benchmarks.runs.store import write_atomic

matplotlib.use("Agg")

# Okabe and Ito, and grey: a colour-blind eye tells them apart
PALETTE: Final = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999"),
)
# one colour per method and one style per track, in every figure; controls from Tol's muted colours
METHOD_COLOURS: Final = {
    **{name: PALETTE[learner.colour % len(PALETTE)] for name, learner in LEARNERS.items()},
    "masked_dqn": PALETTE[5],
    "rrt_connect": PALETTE[3], "rrt_lattice": PALETTE[4], "optimum": PALETTE[6],
    "random": "#DDDDDD", "greedy": "#999933",
    "greedy_observed": "#DDCC77", "lookahead": "#882255", "lookahead_observed": "#AA4499",
    "nominal_plan": "#117733", "plan_search": "#44AA99",
}  # fmt: skip
TRACK_STYLES: Final = {
    "": "-", "repaired": "-", "terminal": "--",
    "safe": "-", "memory": "--", "reward": "-.", "printed": ":", "uncertain": "-",
    "uncertain_nominal": "--",
}  # fmt: skip
STYLE: Final[Any] = {
    "axes.prop_cycle": cycler(color=PALETTE),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": "medium",
    "font.size": 8.5,
    "grid.alpha": 0.3,
    "legend.fontsize": "small",
    "legend.frameon": False,
    "legend.handlelength": 3.0,
    "pdf.fonttype": 42,
}
DPI: Final = 130
COLOURS: Final = 256  # of a stored picture: flat colours and their smoothed edges need no more


def style() -> AbstractContextManager[None]:
    """The look, as long as the context lasts."""
    return matplotlib.rc_context(STYLE)


@dataclass(frozen=True)
class Picture:
    """A figure that can be drawn, and its file's name."""

    name: str
    draw: Callable[[], Figure]

    def write(self, folder: Path) -> Path:
        """Draw it; returns the file's path."""
        with style():
            return save(self.draw(), folder / f"{self.name}.png")


def save(figure: Figure, path: Path, shades: bool = False) -> Path:
    """Write a figure as PNG or PDF, by the name's end, atomically and without a date.

    With ``shades``, those of a colour map, a PNG keeps all colours.
    """
    kind, stream = path.suffix[1:], io.BytesIO()
    metadata = {"CreationDate": None} if kind == "pdf" else {"Software": None}
    figure.savefig(stream, format=kind, dpi=DPI, metadata=metadata)
    data = stream.getvalue()
    if kind == "png" and not shades:
        data = flat_png(data)
    write_atomic(path, lambda temporary: temporary.write_bytes(data))
    return path


def flat_png(data: bytes) -> bytes:
    """A PNG with a palette, a fraction of the size: charts have few colours."""
    image = Image.open(io.BytesIO(data)).convert("RGB")
    # by coverage: a median cut merges the colours of thin lines, of which there are few pixels
    flat = image.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small = io.BytesIO()
    flat.save(small, format="PNG", optimize=True)
    return small.getvalue()


def canvas(
    rows: int = 1, columns: int = 1, size: tuple[float, float] = (6.0, 3.6), *,
    grid: bool = True, sharex: bool = False, sharey: bool = False,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """A figure of that size in inches, and its axes row by row."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    for each in axes.flat:
        each.grid(grid)
    return figure, list(axes.flat)


def finish(axes: Axes, ylabel: str, xlabel: str = "Environment steps") -> None:
    """Labels, and a legend if anything was drawn."""
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    if axes.get_legend_handles_labels()[1]:
        axes.legend()


def legend_below(figure: Figure, axes: Sequence[Axes], columns: int = 3) -> Figure:
    """The figure with one legend under all panels, where nothing is hidden behind it."""
    entries: dict[str, Any] = {}
    for each in axes:
        if (legend := each.get_legend()) is not None:
            legend.remove()
        for handle, label in zip(*each.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=columns)
    return figure
