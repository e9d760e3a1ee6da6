"""``python -m benchmarks design``: the geometric optimization, its table, analyses and figures.

Everything is computed afresh and written to ``results/design/``; ``--figures-only`` redraws from
what is stored there. The generated blocks of ``docs/kinematics.md`` and ``docs/design.md`` are
rewritten from the same data.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, TextIO

from benchmarks.errors import BenchmarkError
from benchmarks.methods.geometric_design import geometry_rows, measured_runs, run_rows, table_rows
from benchmarks.runs import machine
from benchmarks.studies.design import docs as design_docs
from benchmarks.studies.design import study
from benchmarks.studies.design.figures import write_figures
from benchmarks.studies.design.store import DesignStore
from coop_env.design import Optimum

__all__ = ["geometry_rows", "main"]

# share of the whole by stage, as measured; only the time-left display rests on it
_SHARES: Final = {
    "optimizer's runs": 0.15,
    "atlas": 0.22,
    "global optimum, bands of heave": 0.33,
    "sensitivity": 0.20,
    "test trajectory, pose models, maps": 0.03,
    "speed": 0.03,
    "figures and docs": 0.04,
}


class _Progress:
    """One line that says the stage, the share done and the time left."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.start = time.monotonic()
        self.before = 0.0
        self.stage = ""
        self.shown = -1.0

    def enter(self, stage: str) -> Callable[[float], None]:
        """Begin a stage; the returned function takes the share of it that is done."""
        names = list(_SHARES)
        self.before = sum(_SHARES[name] for name in names[: names.index(stage)])
        self.stage = stage
        self.update(0.0)
        return self.update

    def update(self, share: float) -> None:
        done = self.before + _SHARES[self.stage] * share
        elapsed = time.monotonic() - self.start
        live = self.stream.isatty()
        if share > 0.0 and not live and elapsed - self.shown < 5.0:
            return
        self.shown = elapsed
        left = f", about {elapsed * (1.0 - done) / done:.0f} s left" if done > 0.05 else ""
        line = f"[{100 * done:3.0f} %] {self.stage} ({elapsed:.0f} s{left})"
        self.stream.write(f"\r{line:<76}" if live else f"{line}\n")
        self.stream.flush()

    def close(self) -> None:
        if self.stream.isatty():
            self.stream.write("\r" + " " * 76 + "\r")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    arguments = _parser().parse_args(argv)
    store = DesignStore(arguments.results)
    if not arguments.figures_only:
        run(store, arguments.runs, arguments.atlas_step, _Progress(sys.stderr))
    figures = write_figures(store)
    docs = design_docs.rewrite_all(arguments.docs, store)
    print(design_docs.table_markdown(store))
    print()
    print(f"Data:    {store.folder}")
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


def run(store: DesignStore, runs: int, atlas_step: float, progress: _Progress) -> None:
    """Compute everything and store it.

    Raises:
        BenchmarkError: ``runs`` or ``atlas_step`` out of range.
    """
    if runs < 1:
        raise BenchmarkError(f"--runs {runs}: must be at least 1")
    if not 0.005 <= atlas_step <= 0.5:
        raise BenchmarkError(f"--atlas-step {atlas_step}: must lie in 0.005 to 0.5")
    measured = measured_runs(runs, progress.enter("optimizer's runs"))
    run_table, paths = run_rows(measured)
    store.write_rows("table", table_rows(measured))
    store.write_rows("runs", run_table)
    store.write_rows("paths", paths)

    atlas = study.atlas_rows(atlas_step, progress.enter("atlas"))
    store.write_rows("atlas", atlas)
    optima = study.optima(atlas, progress.enter("global optimum, bands of heave"))
    store.write_rows("optima", study.optimum_rows(optima))
    best = optima[f"band {study.ROBUST}"]
    assert isinstance(best, Optimum)
    robust = best.geometry

    update = progress.enter("sensitivity")
    store.write_rows("heave", study.heave_rows(robust))
    update(0.2)
    store.write_rows("threshold", study.threshold_rows())
    update(0.5)
    slopes, tolerances = study.tolerance_rows(robust)
    store.write_rows("slopes", slopes)
    store.write_rows("tolerances", tolerances)

    progress.enter("test trajectory, pose models, maps")
    trajectory, validation = study.trajectory_rows(robust)
    store.write_rows("trajectory", trajectory)
    store.write_rows("validation", validation)
    store.write_rows("pose_model", study.pose_model_rows())
    store.write_rows("pose_model_design", study.pose_model_design_rows())
    store.write_maps(**study.map_arrays())

    progress.enter("speed")
    store.write_rows("speed", study.speed_rows())
    seconds = time.monotonic() - progress.start
    store.write_meta(
        {**machine.describe(), "runs": runs, "atlas_step": atlas_step, "seconds": round(seconds, 1)}
    )
    progress.enter("figures and docs")
    progress.close()


if __name__ == "__main__":
    sys.exit(main())
