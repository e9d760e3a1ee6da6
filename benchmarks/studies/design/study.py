"""The geometric optimization: the paper's table and figures, and analyses beyond them.

All is computed afresh and written to ``results/design/``.

table.csv               the paper's table of design results, ours beside it
runs.csv paths.csv      the optimizer's runs (start, end, evaluations), every design they tried
atlas.csv               A_w over (lambda1, lambda2)
optima.csv              the best designs found, by method, and for bands of heave
heave.csv               A_w by heave
threshold.csv           A_w and the optimum by threshold on sigma_min
slopes.csv              change of A_w per millimetre of each length
tolerances.csv          A_w with all lengths off by a tolerance
trajectory.csv          joint angles along the test trajectory
validation.csv          what the designs do along it
pose_model.csv          what the paper's pose model costs, by tilt
pose_model_design.csv   the table's figures under either pose model
maps.npz                fields over (roll, pitch, heave) behind the figures
"""

import argparse
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd
import yaml

from benchmarks.methods.geometric_design import measured_runs, run_rows, table_rows
from benchmarks.reporting.blocks import Block
from benchmarks.runs.machine import describe
from benchmarks.studies.base import Part, Study, Tick, count
from benchmarks.studies.design import analyses
from benchmarks.studies.design.analyses import DesignStore
from benchmarks.studies.design.figures import write_figures
from coop_env.geometry import GEOMETRIES

COLUMNS: Final[dict[str, dict[str, list[list[str]]]]] = yaml.safe_load(
    Path(__file__).with_name("blocks.yaml").read_text(encoding="utf-8")
)
DESIGNS: Final = {
    "nelder_mead": "Nelder-Mead",
    "differential_evolution": "differential evolution",
    "atlas": "best cell of the atlas",
}


class Design(Study):
    """The geometric optimization."""

    name = "design"
    options = {"--runs": count(10, "runs of the optimizer")}  # noqa: RUF012

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.store, self.began = DesignStore(self.results), time.monotonic()

    def parts(self) -> Mapping[str, Part]:
        return {
            "optimizer's runs": self._runs,
            "atlas, global optimum, bands of heave": self._optima,
            "sensitivity, test trajectory, pose models, maps": self._sensitivity,
        }

    def _write(self, **rows: Any) -> None:
        for name, result in rows.items():
            self.store.write_rows(name, result)

    def _runs(self, tick: Tick) -> None:
        measured = measured_runs(self.given.runs, tick)
        runs, paths = run_rows(measured)
        (self.store.path / "meta.json").unlink(missing_ok=True)  # complete once all is anew
        self._write(table=table_rows(measured), runs=runs, paths=paths)

    def _optima(self, tick: Tick) -> None:
        atlas = analyses.atlas_rows(lambda share: tick(share / 2))
        optima = analyses.optima(atlas, lambda share: tick((1 + share) / 2))
        self.designs = {**GEOMETRIES, "robust": optima[f"band {analyses.ROBUST}"][0]}
        self._write(atlas=atlas, optima=analyses.optimum_rows(optima))

    def _sensitivity(self, tick: Tick) -> None:
        slopes, tolerances = analyses.tolerance_rows(self.designs)
        trajectory, validation = analyses.trajectory_rows(self.designs)
        self._write(
            heave=analyses.heave_rows(self.designs), threshold=analyses.threshold_rows(),
            slopes=slopes, tolerances=tolerances, trajectory=trajectory, validation=validation,
            pose_model=analyses.pose_model_rows(),
            pose_model_design=analyses.pose_model_design_rows(),
        )  # fmt: skip
        self.store.write_maps(analyses.map_arrays())
        seconds = round(time.monotonic() - self.began, 1)
        self.store.write_meta({**describe(), "runs": self.given.runs, "seconds": seconds})

    def finish(self) -> None:
        write_figures(self.store)

    @classmethod
    def blocks(cls, results: Path) -> dict[str, Block]:
        store = DesignStore(results)
        if not store.is_complete():
            return {}
        result: dict[str, Block] = {"design-provenance": lambda _: _provenance(store)}
        return result | {name: partial(_columns, store, name) for name in COLUMNS}

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        store = DesignStore(results)
        if not store.is_complete():
            begun = store.path.is_dir()
            return [f"{store.path} is not complete: run `study design` again"] if begun else []
        rows = {row["metric"]: row for row in store.rows("table").to_dict("records")}
        runs, result = store.rows("runs"), []
        for end, column in (("initial", "a_w_initial"), ("optimized", "a_w")):
            stored, wanted = float(rows["workspace"][f"{end}_mean"]), float(runs[column].mean())
            if abs(stored - wanted) > 1e-6:
                result.append(
                    f"{store.path / 'table.csv'} gives {stored:.7g} as the {end} workspace, the "
                    f"mean of runs.csv is {wanted:.7g}"
                )
        return result


def _columns(store: DesignStore, name: str, _: str) -> str:
    """Columns (key, heading, format) of stored rows as Markdown tables."""
    tables = []
    for file, columns in COLUMNS[name].items():
        rows = PREPARED.get(file, lambda frame: frame)(store.rows(file)).to_dict("records")
        cells = [[heading for _, heading, _ in columns]]
        cells += [[format(row[key], form) for key, _, form in columns] for row in rows]
        lines = [f"| {' | '.join(row)} |" for row in cells]
        lines.insert(1, "|" + "|".join("---:" if form else "---" for _, _, form in columns) + "|")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _optima(frame: pd.DataFrame) -> pd.DataFrame:
    lengths = ["base_radius", "proximal_length", "platform_radius"]
    return frame.assign(design=frame["design"].replace(DESIGNS), **1e3 * frame[lengths])


def _range(frame: pd.DataFrame) -> pd.DataFrame:
    ends = zip(frame["joint_low"], frame["joint_high"], strict=True)
    return frame.assign(range=[f"[{low:.1f}, {high:.1f}]" for low, high in ends])


# what tables show of stored rows besides their columns
PREPARED: Final[dict[str, Callable[[pd.DataFrame], pd.DataFrame]]] = {
    "optima": _optima,
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
