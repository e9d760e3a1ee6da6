"""The generated blocks of ``docs/kinematics.md`` and ``docs/design.md``, from stored data alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from benchmarks.protocol import labels
from benchmarks.reporting.tables.table import Cell, Table
from benchmarks.reporting.verify import Report, check_file
from benchmarks.runs.store import write_text
from benchmarks.studies.design.store import DesignStore, stored_geometry_rows


def _begin(name: str) -> str:
    return f"<!-- {name}:begin (written by: python -m benchmarks design) -->"


def _end(name: str) -> str:
    return f"<!-- {name}:end -->"


def rewrite_all(folder: Path, store: DesignStore) -> list[Path]:
    """Rewrite every generated block in the pages of ``folder``; returns the pages that have one."""
    pages = []
    for path in sorted(folder.glob("*.md")) if folder.is_dir() else []:
        old = path.read_text(encoding="utf-8")
        new = rewrite(old, store)
        if any(_begin(name) in old for name in BLOCKS):
            pages.append(path)
        if new != old:
            write_text(path, new)
    return pages


def rewrite(text: str, store: DesignStore) -> str:
    """A page with its generated blocks written afresh."""
    for name, build in BLOCKS.items():
        start, end = text.find(_begin(name)), text.find(_end(name))
        if 0 <= start < end:
            head = text[: start + len(_begin(name))]
            text = f"{head}\n\n{build(store).strip()}\n\n{text[end:]}"
    return text


def table_markdown(store: DesignStore) -> str:
    """The paper's table, ours beside it, with the reasons under it."""
    rows: list[list[Cell]] = []
    notes = [
        f"Ours: mean ± standard deviation over {store.meta()['runs']} runs of Nelder-Mead, each "
        "with its own jitter of the grid."
    ]
    for row in stored_geometry_rows(store.folder.parent):
        label = labels.DESIGN_METRICS[str(row["metric"])]
        keys = ("paper_initial", "initial", "paper_optimized", "optimized")
        rows.append([label, *(str(row[key]) for key in keys)])
        if row["note"]:
            notes.append(str(row["note"]))
    header = ["Metric", "Initial, paper", "Initial, ours", "Optimized, paper", "Optimized, ours"]
    return Table("design", "Geometric optimization of the 3-RRS", header, rows, notes).markdown()


def _table(frame: pd.DataFrame, columns: Sequence[tuple[str, str, str]]) -> str:
    """Columns (key, heading, format) of a frame as a Markdown table."""
    lines = ["| " + " | ".join(heading for _, heading, _ in columns) + " |"]
    lines.append("|" + "|".join("---" if not form else "---:" for _, _, form in columns) + "|")
    for row in frame.to_dict("records"):
        cells = [format(row[key], form) if form else str(row[key]) for key, _, form in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _optima(store: DesignStore) -> str:
    frame = store.rows("optima")
    frame["design"] = frame["design"].replace(
        {
            "nelder_mead": "Nelder-Mead",
            "differential_evolution": "differential evolution",
            "atlas": "best cell of the atlas",
        }
    )
    for name in ("base_radius", "proximal_length", "platform_radius"):
        frame[name] *= 1e3
    columns = [
        ("design", "design", ""),
        ("lambda1", "λ1", ".3f"),
        ("lambda2", "λ2", ".3f"),
        ("base_radius", "Rb (mm)", ".1f"),
        ("proximal_length", "L1 (mm)", ".1f"),
        ("platform_radius", "Rp (mm)", ".1f"),
        ("a_w_home", "A_w at 0.21 m", ".3f"),
    ]
    bands = [name for name in frame.columns if name.startswith("a_w 0")]
    columns += [(name, f"least over {name[4:].replace('-', ' to ')} m", ".3f") for name in bands]
    return _table(frame, columns)


def _heave(store: DesignStore) -> str:
    frame = store.rows("heave")
    every = frame[(frame["heave"] * 1e4).round().astype(int) % 100 == 0]
    near = frame[(frame["heave"] - 0.21).abs() < 0.006]
    chosen = pd.concat([every, near]).drop_duplicates("heave").sort_values("heave")
    return _table(
        chosen,
        [
            ("heave", "heave (m)", ".4f"),
            ("initial", "initial", ".3f"),
            ("optimized", "optimized", ".3f"),
            ("robust", "robust", ".3f"),
        ],
    )


def _threshold(store: DesignStore) -> str:
    frame = store.rows("threshold")
    frame["gain"] = 100.0 * (frame["optimized"] / frame["initial"] - 1.0)
    return _table(
        frame,
        [
            ("threshold", "threshold", ".2f"),
            ("initial", "initial", ".3f"),
            ("optimized", "optimized", ".3f"),
            ("gain", "gain (%)", ".0f"),
            ("reoptimized", "optimized for this threshold", ".3f"),
            ("lambda1", "its λ1", ".3f"),
            ("lambda2", "its λ2", ".3f"),
        ],
    )


def _tolerances(store: DesignStore) -> str:
    slopes = _table(
        store.rows("slopes"),
        [
            ("design", "dA_w, rad² per mm", ""),
            ("base_radius", "Rb", "+.4f"),
            ("proximal_length", "L1", "+.4f"),
            ("platform_radius", "Rp", "+.4f"),
            ("distal_length", "L2", "+.4f"),
        ],
    )
    spread = _table(
        store.rows("tolerances"),
        [
            ("design", "design", ""),
            ("tolerance_mm", "every length ± (mm)", ".1f"),
            ("mean", "mean A_w", ".3f"),
            ("std", "std", ".3f"),
            ("least", "least of 100", ".3f"),
        ],
    )
    return f"{slopes}\n\n{spread}"


def _validation(store: DesignStore) -> str:
    frame = store.rows("validation")
    frame["range"] = [
        f"[{low:.1f}, {high:.1f}]"
        for low, high in zip(frame["joint_low"], frame["joint_high"], strict=True)
    ]
    return _table(
        frame,
        [
            ("design", "design", ""),
            ("range", "joints (°)", ""),
            ("excursion", "largest excursion (°)", ".1f"),
            ("peak_rate", "peak rate (°/s)", ".1f"),
            ("peak_acceleration", "peak acceleration (°/s²)", ".0f"),
            ("log_jerk", "log dimensionless jerk", ".2f"),
            ("sigma_min", "least sigma_min", ".3f"),
            ("kappa_max", "greatest kappa", ".2f"),
            ("forward_error", "error of forward kinematics", ".0e"),
        ],
    )


def _speed(store: DesignStore) -> str:
    return _table(
        store.rows("speed"),
        [
            ("geometry", "geometry", ""),
            ("method", "method", ""),
            ("ms", "ms", ".1f"),
            ("times_faster", "times faster", ".1f"),
        ],
    )


def _pose_model(store: DesignStore) -> str:
    frame = store.rows("pose_model")
    frame["lost"] = 100.0 * frame["lost"] / 180.0
    return _table(
        frame,
        [
            ("tilt", "tilt (°)", ".0f"),
            ("plane_mm", "joint out of its plane (mm)", ".1f"),
            ("centre_mm", "centre off (mm)", ".1f"),
            ("yaw_deg", "yaw off (°)", ".2f"),
            ("hole_mm", "hole off (mm)", ".1f"),
            ("hole_deg", "hole's normal off (°)", ".2f"),
            ("lost", "cannot be driven (% of directions)", ".0f"),
            ("reached_hole_mm", "hole off, driven (mm)", ".1f"),
            ("reached_hole_deg", "hole's normal off, driven (°)", ".1f"),
        ],
    )


def _pose_model_design(store: DesignStore) -> str:
    frame = store.rows("pose_model_design")
    frame["range"] = [
        f"[{low:.1f}, {high:.1f}]"
        for low, high in zip(frame["joint_low"], frame["joint_high"], strict=True)
    ]
    return _table(
        frame,
        [
            ("pose_model", "pose model", ""),
            ("design", "design", ""),
            ("a_w", "A_w (rad²)", ".3f"),
            ("sigma_cone", "least sigma_min in 28°", ".3f"),
            ("max_angle", "max roll/pitch (°)", ".1f"),
            ("kappa_variation", "kappa variation (%)", ".1f"),
            ("range", "joints (°)", ""),
        ],
    )


def _provenance(store: DesignStore) -> str:
    meta = store.meta()
    return (
        f"Computed in {meta['seconds']:.0f} s on one core of {meta['machine']['processor']}, at "
        f"commit {str(meta['commit'])[:9]}{' with uncommitted changes' if meta['dirty'] else ''}."
    )


BLOCKS: Final[dict[str, Callable[[DesignStore], str]]] = {
    "design-table": table_markdown,
    "design-optima": _optima,
    "design-heave": _heave,
    "design-threshold": _threshold,
    "design-tolerances": _tolerances,
    "design-validation": _validation,
    "design-speed": _speed,
    "design-provenance": _provenance,
    "pose-model": _pose_model,
    "design-pose-model": _pose_model_design,
}


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the study's table follows from its runs, and the docs from its data."""
    store = DesignStore(results)
    if (store.folder / "meta.json").is_file():
        found = _check_table(store)
        for path in sorted(docs.glob("*.md")):
            wanted = rewrite(path.read_text(encoding="utf-8"), store)
            found += check_file(path, wanted, f"the data in {store.folder}")
        report.add(f"{store.folder}: table, and its blocks in {docs}", found)


def _check_table(store: DesignStore) -> list[str]:
    rows = {row["metric"]: row for row in store.rows("table").to_dict("records")}
    runs = store.rows("runs")
    problems = []
    for end, column in (("initial", "a_w_initial"), ("optimized", "a_w")):
        stored, wanted = float(rows["workspace"][f"{end}_mean"]), float(runs[column].mean())
        if abs(stored - wanted) > 1e-6:
            problems.append(
                f"{store.folder / 'table.csv'} gives {stored:.7g} as the {end} workspace, the mean "
                f"of runs.csv is {wanted:.7g}"
            )
    shown = {row["metric"]: row for row in stored_geometry_rows(store.folder.parent)}
    for metric, row in rows.items():
        problems += [
            f"{store.folder}: table.json gives {shown[metric][end]} as {metric}, {end}, "
            f"table.csv {row[end]}"
            for end in ("initial", "optimized")
            if shown[metric][end] != row[end]
        ]
    return problems
