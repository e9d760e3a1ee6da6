"""Where the design study keeps its data, ``results/design/``, and how to read it back.

table.csv table.json   the paper's table, ours beside it      meta.json   how it was made
runs.csv paths.csv     the optimizer's runs and every design they tried
*.csv                  one file for each analysis (see ``FILES``)
maps.npz               fields over (roll, pitch, heave) behind the figures
figures/               *.pdf *.png
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.runs.store import write_atomic, write_csv, write_text

Row = dict[str, object]

FILES: Final = {
    "table": "the paper's table of design results, ours beside it",
    "runs": "the optimizer's runs: start, end, evaluations",
    "paths": "every design that the runs evaluated",
    "atlas": "A_w over (lambda1, lambda2)",
    "optima": "the best designs found, by method, and for bands of heave",
    "heave": "A_w by heave",
    "threshold": "A_w and the optimum by threshold on sigma_min",
    "slopes": "change of A_w per millimetre of each length",
    "tolerances": "A_w with all lengths off by a tolerance",
    "trajectory": "joint angles along the test trajectory",
    "validation": "what the designs do along it",
    "pose_model": "what the paper's pose model costs, by tilt",
    "pose_model_design": "the table's figures under either pose model",
    "speed": "milliseconds of one A_w map",
}


class DesignStore:
    """The files of one design study."""

    def __init__(self, root: Path | str = "results") -> None:
        self.folder = Path(root) / "design"
        self.figures = self.folder / "figures"

    def write_rows(self, name: str, rows: Sequence[Mapping[str, object]]) -> None:
        """Write ``<name>.csv``; the table also as JSON."""
        write_csv(self.folder / f"{name}.csv", rows)
        if name == "table":
            text = json.dumps(list(rows), indent=1, ensure_ascii=False)
            write_text(self.folder / "table.json", text + "\n")

    def rows(self, name: str) -> pd.DataFrame:
        """Read ``<name>.csv``.

        Raises:
            BenchmarkError: the study has not been run.
        """
        path = self.folder / f"{name}.csv"
        if not path.is_file():
            raise BenchmarkError(f"{path} is missing; run: python -m benchmarks design")
        return pd.read_csv(path)

    def write_maps(self, **arrays: np.ndarray) -> None:
        """Write ``maps.npz``."""

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)

        write_atomic(self.folder / "maps.npz", write)

    def maps(self) -> dict[str, np.ndarray]:
        """Read ``maps.npz``.

        Raises:
            BenchmarkError: the study has not been run.
        """
        path = self.folder / "maps.npz"
        if not path.is_file():
            raise BenchmarkError(f"{path} is missing; run: python -m benchmarks design")
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}

    def write_meta(self, meta: Mapping[str, Any]) -> None:
        """Write meta.json."""
        text = json.dumps(dict(meta), indent=1, sort_keys=True)
        write_text(self.folder / "meta.json", text + "\n")

    def meta(self) -> dict[str, Any]:
        """Read meta.json."""
        path = self.folder / "meta.json"
        if not path.is_file():
            raise BenchmarkError(f"{path} is missing; run: python -m benchmarks design")
        return dict(json.loads(path.read_text(encoding="utf-8")))


def stored_geometry_rows(root: Path | str = "results") -> list[Row]:
    """The table's rows as stored, without computing anything.

    Raises:
        BenchmarkError: the study has not been run.
    """
    path = DesignStore(root).folder / "table.json"
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; run: python -m benchmarks design")
    return list(json.loads(path.read_text(encoding="utf-8")))
