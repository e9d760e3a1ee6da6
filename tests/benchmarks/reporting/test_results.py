"""Which rows of episodes.csv a headline rests on, by the columns that the file has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.reporting.results import Level, Result
from benchmarks.runs.store import RunFolder

ROWS = pd.DataFrame({
    "episode": [0, 1, 2, 3],
    "noise": [0.0, 0.01, 0.0, 0.0],
    "acting": ["greedy", np.nan, "exploring", "greedy"],
    "error": [3.0, 3.0, 3.0, 8.0],
})  # fmt: skip
MACHINE = {"sim_to_real": {"base_position_error": 0.003}}


@pytest.mark.parametrize(
    ("columns", "track", "level", "found"),
    [
        (["noise", "acting", "error"], MACHINE, Level(), [0]),
        (["noise", "acting", "error"], MACHINE, Level(error=8.0), [3]),
        (["noise", "acting"], {}, Level(), [0, 3]),
        (["noise", "acting"], {}, Level(acting="exploring"), [2]),
        (["noise", "acting"], {}, Level(noise=0.01), [1]),
        (["noise"], {}, Level(), [0, 2, 3]),
        (["noise"], {}, Level(noise=0.01), [1]),
        (["noise"], {}, Level(noise=0.02), []),
    ],
)
def test_a_level_has_the_rows_that_were_played_at_it(
    columns: list[str], track: dict[str, Any], level: Level, found: list[int]
) -> None:
    rows = ROWS[["episode", *columns]]
    result = Result(0, {"track": track}, {}, RunFolder(Path("nowhere")), rows)
    assert result.test(level)["episode"].tolist() == found


def test_rows_of_older_runs_under_other_masks_are_left_out(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    (tmp_path / "config.yaml").write_text("cell: {seed: 4}\ntrack: {}\n", encoding="utf-8")
    ROWS.assign(masks=["own", np.nan, "paper", "own"]).to_csv(
        tmp_path / "episodes.csv", index=False
    )
    result = Result.read(folder, {})
    assert result.seed == 4
    assert result.episodes["episode"].tolist() == [0, 1, 3]
