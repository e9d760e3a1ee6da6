"""``python -m benchmarks design``: the geometric optimization, its table, analyses and figures.

Everything is computed afresh and written to ``results/design/``; ``--figures-only`` redraws from
what is stored there. The generated blocks of ``docs/kinematics.md`` and ``docs/design.md`` are
rewritten from the same data.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from benchmarks.errors import BenchmarkError
from benchmarks.methods.geometric_design import measured_runs, run_rows, table_rows
from benchmarks.runs import machine
from benchmarks.studies.design import docs as design_docs
from benchmarks.studies.design import study
from benchmarks.studies.design.figures import write_figures
from benchmarks.studies.design.store import DesignStore


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    arguments = _parser().parse_args(argv)
    store = DesignStore(arguments.results)
    if not arguments.figures_only:
        run(store, arguments.runs, arguments.atlas_step)
    elif not store.is_complete():
        raise BenchmarkError(f"{store.path} holds no study; run: python -m benchmarks design")
    figures = write_figures(store)
    docs = design_docs.rewrite_all(arguments.docs, store)
    print(design_docs.table(store).markdown())
    print(f"Data:    {store.path}")
    print(f"Figures: {', '.join(str(p) for p in figures if p.suffix == '.png')} (and .pdf)")
    print(f"Docs:    {', '.join(str(path) for path in docs) or 'no page with a block for these'}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks design", description=(__doc__ or "").split("\n\n", 1)[1]
    )
    parser.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the docs")
    parser.add_argument("--runs", type=int, default=10, help="optimizer's runs (default: 10)")
    parser.add_argument(
        "--atlas-step", type=float, default=0.02, help="grid of lambda (default: 0.02)"
    )
    parser.add_argument(
        "--figures-only", action="store_true", help="redraw from stored data, compute nothing"
    )
    return parser


def run(store: DesignStore, runs: int, atlas_step: float) -> None:
    """Compute everything and store it.

    Raises:
        BenchmarkError: ``runs`` or ``atlas_step`` out of range.
    """
    if runs < 1:
        raise BenchmarkError(f"--runs {runs}: must be at least 1")
    if not 0.005 <= atlas_step <= 0.5:
        raise BenchmarkError(f"--atlas-step {atlas_step}: must lie in 0.005 to 0.5")
    began = time.monotonic()
    with Progress(console=Console(stderr=True)) as bar:
        stage = bar.add_task("optimizer's runs", total=1.0)

        def enter(name: str) -> None:
            bar.reset(stage, description=name, total=1.0)

        def tell(share: float) -> None:
            bar.update(stage, completed=share)

        measured = measured_runs(runs, tell)
        run_table, paths = run_rows(measured)
        store.write_rows("table", table_rows(measured))
        store.write_rows("runs", run_table)
        store.write_rows("paths", paths)

        enter("atlas")
        atlas = study.atlas_rows(atlas_step, tell)
        store.write_rows("atlas", atlas)
        enter("global optimum, bands of heave")
        optima = study.optima(atlas, tell)
        store.write_rows("optima", study.optimum_rows(optima))
        robust = optima[f"band {study.ROBUST}"][0]

        enter("sensitivity")
        store.write_rows("heave", study.heave_rows(robust))
        store.write_rows("threshold", study.threshold_rows())
        slopes, tolerances = study.tolerance_rows(robust)
        store.write_rows("slopes", slopes)
        store.write_rows("tolerances", tolerances)

        enter("test trajectory, pose models, maps, speed")
        trajectory, validation = study.trajectory_rows(robust)
        store.write_rows("trajectory", trajectory)
        store.write_rows("validation", validation)
        store.write_rows("pose_model", study.pose_model_rows())
        store.write_rows("pose_model_design", study.pose_model_design_rows())
        store.write_maps(**study.map_arrays())
        store.write_rows("speed", study.speed_rows())
    seconds = round(time.monotonic() - began, 1)
    made = {"runs": runs, "atlas_step": atlas_step, "seconds": seconds}
    store.write_meta({**machine.describe(), **made})


if __name__ == "__main__":
    sys.exit(main())
