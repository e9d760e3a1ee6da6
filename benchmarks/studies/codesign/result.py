"""What the co-design stored, and which designs it chooses by that. No torch here."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from benchmarks.reporting.results import Group, Results
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.codesign.spaces import ALL, BASE, OF_ONE, STUDIES, of_row
from coop_env.geometry import RRSGeometry

POLICIES: Final = "policies"
TABLES: Final = "codesign.md"


class SearchResult:
    """The files of a co-design; what has not been run is None.

    Attributes:
        folder: where they lie.
        summary: what codesign.json says of the search.
        asked: the settings.
        designs: every design that has a score, by its name.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        own = RunFolder(folder)
        self.asked = own.config()
        self.summary: dict[str, Any] = json.loads((folder / "codesign.json").read_text("utf-8"))
        self.designs = own.rows("designs").set_index("design")

    @cached_property
    def chosen(self) -> pd.DataFrame:
        """The optimum on test starts, a row for each chosen design and seed."""
        return RunFolder(self.folder).rows("chosen").fillna({"chosen": ""})

    def of_study(self, study: str) -> pd.DataFrame:
        """The designs of a study, and the one that it begins from."""
        return self.designs[self.designs["study"].isin([study, ALL])]

    def front(self, study: str) -> pd.DataFrame:
        """The designs of a study that no other beats, the quickest first."""
        rows = self.of_study(study)
        return rows[on_front(rows, self.summary["floor"])].sort_values("ticks")

    def choose(self) -> dict[str, str]:
        """The designs to be tested, and why: ``study: reason, reason; study: reason``."""
        named = self.designs.index[~self.designs.index.str.contains("-")]
        chosen: dict[str, list[str]] = {str(name): [] for name in named}
        success = float(self.designs.loc[BASE, "success"])  # type: ignore[arg-type]
        for study in STUDIES:
            rows = self.of_study(study)
            picks = {
                "largest A_w": f"{study}-area",
                "quickest": quickest(rows, success),
                "surest": surest(rows),
            }
            for design in dict.fromkeys(picks.values()):
                why = ", ".join(why for why, picked in picks.items() if picked == design)
                chosen.setdefault(design, []).append(f"{study}: {why}")
        return {design: "; ".join(why) for design, why in chosen.items()}

    def geometry(self, design: str) -> RRSGeometry:
        """The geometry of a design."""
        return of_row({"design": design, **self.designs.loc[design].to_dict()})

    @cached_property
    def _policies(self) -> Results:
        return Results(Store(self.folder, POLICIES))

    def policies(self, design: str) -> Group:
        """The policies that were trained on a design."""
        return self._policies.group("rainbow", OF_ONE, design)


def on_front(rows: pd.DataFrame, floor: float) -> np.ndarray:
    """Which rows no other beats in success and ticks alike, among those at the floor or above."""
    success, ticks = rows["success"].to_numpy(), rows["ticks"].to_numpy()
    at_least = (success[:, None] >= success) & (ticks[:, None] <= ticks)
    better = at_least & ((success[:, None] > success) | (ticks[:, None] < ticks))
    return np.asarray((success >= floor) & ~better.any(axis=0))


def quickest(rows: pd.DataFrame, success: float) -> str:
    """Name of the design with the fewest ticks among those that succeed at least so often."""
    sure = rows[rows["success"] >= success]
    return str(sure.sort_values(["ticks", "success"], ascending=[True, False]).index[0])


def surest(rows: pd.DataFrame) -> str:
    """Name of the design that succeeds most often, of equals the one with the fewest ticks."""
    return str(rows.sort_values(["success", "ticks"], ascending=[False, True]).index[0])
