"""The paper's table of the geometric optimization, ours beside it."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from typing import Any

import pandas as pd

from benchmarks.protocol import labels, paper_values
from benchmarks.reporting.results import Results
from benchmarks.reporting.stats import Value, t_interval
from benchmarks.reporting.tables.table import FLAG_NOTE, Number, Table, TableCell


def design(results: Results) -> Table:
    """Table "results": the geometric optimization, five metrics."""
    if results.design is None:
        return design_table(None, 0)
    runs = int(results.design.config()["design"]["runs"])
    return design_table(results.design.rows("design"), runs)


def design_table(measured: pd.DataFrame | None, runs: int) -> Table:
    """The paper's table of the geometric optimization, beside it rows of so many runs of ours."""
    header = ["Metric", "Initial, paper", "Initial, ours", "Optimized, paper", "Optimized, ours"]
    notes, stored = [], {}
    if measured is not None:
        frame = measured.fillna({"note": ""})
        stored = {str(row["metric"]): row for row in frame.to_dict("records")}
        notes = [f"Ours: mean ± std over {runs} Nelder-Mead runs, each with its own jitter."]
        notes += [*filter(None, frame["note"]), FLAG_NOTE]
    rows: list[list[TableCell]] = []
    for key, paper in paper_values.DESIGN.items():
        row: list[TableCell] = [labels.DESIGN_METRICS[key]]
        for end, printed in zip(("initial", "optimized"), paper, strict=True):
            row += [printed, _design_cell(stored[key], end, runs, printed) if stored else "missing"]
        rows.append(row)
    return Table("design", "Geometric optimization of the 3-RRS", header, rows, notes)


def _design_cell(row: dict[Hashable, Any], end: str, runs: int, paper: str) -> TableCell:
    """A measured design metric; a range differs from the paper's if either of its ends does."""
    mean, std = float(str(row[f"{end}_mean"])), float(str(row[f"{end}_std"]))
    low, high = t_interval(mean, std, runs)
    shown = str(row[end])
    digits = len(shown.split()[0].rstrip(",").partition(".")[2])
    number = Number(Value(mean, std, runs, low, high), digits, paper=paper, shown=shown)
    upper = float(str(row[f"{end}_high_mean"]))
    if math.isnan(upper):
        return number
    first, second = paper.strip("[]").split(", ")
    ends = (
        replace(number, paper=first),
        # of the upper end only the mean is kept
        Number(Value(upper, low=upper, high=upper), paper=second),
    )
    return replace(number, differs=any(each.flagged for each in ends))
