"""The generated blocks of ``docs/kinematics.md`` and ``docs/design.md``, from stored data alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import pandas as pd
import yaml

from benchmarks.reporting.pages import blocks
from benchmarks.reporting.tables.geometric import design_table
from benchmarks.reporting.tables.table import Table
from benchmarks.reporting.verify import Report, check_file
from benchmarks.studies.design.store import DesignStore

COLUMNS: Final[dict[str, dict[str, list[list[str]]]]] = yaml.safe_load(
    Path(__file__).with_name("blocks.yaml").read_text(encoding="utf-8")
)
BLOCKS: Final = ("design-table", "design-provenance", *COLUMNS)
DESIGNS: Final = {
    "nelder_mead": "Nelder-Mead",
    "differential_evolution": "differential evolution",
    "atlas": "best cell of the atlas",
}


def rewrite_all(folder: Path, store: DesignStore) -> list[Path]:
    """Rewrite every generated block in the pages of ``folder``; returns the pages that have one."""
    pages = []
    for path in sorted(folder.glob("*.md")) if folder.is_dir() else []:
        page = path.read_text(encoding="utf-8")
        if any(blocks.pattern(name).search(page) for name in BLOCKS):
            blocks.rewrite(path, lambda page: rewrite(page, store))
            pages.append(path)
    return pages


def rewrite(text: str, store: DesignStore) -> str:
    """A page with its generated blocks written afresh."""
    for name in BLOCKS:
        text = blocks.fill(text, name, lambda _, name=name: _block(name, store))  # type: ignore[misc]
    return text


def _block(name: str, store: DesignStore) -> str:
    if name == "design-table":
        return table(store).markdown()
    if name == "design-provenance":
        return _provenance(store)
    return "\n\n".join(
        _markdown(PREPARED.get(rows, lambda frame: frame)(store.rows(rows)), columns)
        for rows, columns in COLUMNS[name].items()
    )


def table(store: DesignStore) -> Table:
    """The paper's table, ours beside it, with the reasons under it."""
    return design_table(store.rows("table"), int(store.meta()["runs"]))


def _markdown(frame: pd.DataFrame, columns: Sequence[Sequence[str]]) -> str:
    """Columns (key, heading, format) of a frame as a Markdown table."""
    lines = ["| " + " | ".join(heading for _, heading, _ in columns) + " |"]
    lines.append("|" + "|".join("---:" if form else "---" for _, _, form in columns) + "|")
    for row in frame.to_dict("records"):
        cells = [format(row[key], form) if form else str(row[key]) for key, _, form in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _optima(frame: pd.DataFrame) -> pd.DataFrame:
    lengths = ["base_radius", "proximal_length", "platform_radius"]
    return frame.assign(design=frame["design"].replace(DESIGNS), **1e3 * frame[lengths])


def _heave(frame: pd.DataFrame) -> pd.DataFrame:
    """Every centimetre, and all near home."""
    whole = (frame["heave"] * 1e4).round().astype(int) % 100 == 0
    return frame[whole | ((frame["heave"] - 0.21).abs() < 0.006)]


def _range(frame: pd.DataFrame) -> pd.DataFrame:
    ends = zip(frame["joint_low"], frame["joint_high"], strict=True)
    return frame.assign(range=[f"[{low:.1f}, {high:.1f}]" for low, high in ends])


# what is told of stored rows beyond their columns
PREPARED: Final[dict[str, Callable[[pd.DataFrame], pd.DataFrame]]] = {
    "optima": _optima,
    "heave": _heave,
    "threshold": lambda rows: rows.assign(gain=100.0 * (rows["optimized"] / rows["initial"] - 1.0)),
    "validation": _range,
    "pose_model": lambda rows: rows.assign(lost=100.0 * rows["lost"] / 180.0),
    "pose_model_design": _range,
}


def _provenance(store: DesignStore) -> str:
    meta = store.meta()
    return (
        f"Computed in {meta['seconds']:.0f} s on one core of {meta['machine']['processor']}, at "
        f"commit {str(meta['commit'])[:9]}{' with uncommitted changes' if meta['dirty'] else ''}."
    )


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the study's table follows from its runs, and the docs from its data."""
    store = DesignStore(results)
    if store.is_complete():
        found = list(_check_table(store))
        for path in sorted(docs.glob("*.md")):
            wanted = rewrite(path.read_text(encoding="utf-8"), store)
            found += check_file(path, wanted, f"the data in {store.path}")
        report.add(f"{store.path}: table, and its blocks in {docs}", found)


def _check_table(store: DesignStore) -> Iterator[str]:
    rows = {row["metric"]: row for row in store.rows("table").to_dict("records")}
    runs = store.rows("runs")
    for end, column in (("initial", "a_w_initial"), ("optimized", "a_w")):
        stored, wanted = float(rows["workspace"][f"{end}_mean"]), float(runs[column].mean())
        if abs(stored - wanted) > 1e-6:
            yield (
                f"{store.path / 'table.csv'} gives {stored:.7g} as the {end} workspace, the mean "
                f"of runs.csv is {wanted:.7g}"
            )
