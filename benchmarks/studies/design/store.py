"""Where the design study keeps its data, ``results/design/``: like a run's, with arrays beside it.

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
speed.csv               milliseconds of one A_w map
maps.npz                fields over (roll, pitch, heave) behind the figures
meta.json figures/      how it was made; *.pdf *.png
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.runs.store import RunFolder, write_atomic


class DesignStore(RunFolder):
    """The files of one design study."""

    def __init__(self, root: Path | str = "results") -> None:
        super().__init__(Path(root) / "design")
        self.figures = self.path / "figures"

    def write_maps(self, **arrays: np.ndarray) -> None:
        """Write ``maps.npz``."""

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)

        write_atomic(self.path / "maps.npz", write)

    def maps(self) -> dict[str, np.ndarray]:
        """Read ``maps.npz``."""
        with np.load(self.path / "maps.npz") as stored:
            return dict(stored)
