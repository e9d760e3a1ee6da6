"""The files of the design study."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.runs.store import RunFolder, write_atomic


class DesignStore(RunFolder):
    """The files of the study: like a run's, with arrays and figures beside them."""

    def __init__(self, results: Path) -> None:
        super().__init__(Path(results) / "design")
        self.figures = self.path / "figures"

    def write_maps(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write ``maps.npz``."""

        def write(temporary: Path) -> None:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays)

        write_atomic(self.path / "maps.npz", write)

    def maps(self) -> dict[str, np.ndarray]:
        """Read ``maps.npz``."""
        with np.load(self.path / "maps.npz") as stored:
            return dict(stored)
