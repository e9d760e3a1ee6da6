"""The sentences above the tables say what the stored runs say, and nothing without runs."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.reporting.pages.summary import sentences
from benchmarks.reporting.results import Results, tail_mean
from benchmarks.runs.store import Store
from tests.benchmarks.fabricated_store import make_store


def test_sentences_follow_the_numbers(tmp_path: Path) -> None:
    told = sentences(Results(make_store(tmp_path, [0, 1], "paper")))
    assert len(told) == 5
    ceiling, rivals, printed, components, geometry = told
    # 9 and 8 of 10 solved by Rainbow, 10 and 9 by the optimum, 25 moves against 20
    assert "falls short" in ceiling
    assert "85.0 \u00b1 7.1 %" in ceiling
    assert "exact optimum 95.0 \u00b1 7.1" in ceiling
    assert "25.0" in ceiling
    assert "RRT-Connect 45.0" in rivals
    assert "MaskablePPO 85.0" in rivals
    assert "As printed** Rainbow inserts in 85.0" in printed
    assert "no clear difference, under masks that leave little to do, without" in components
    assert "does not reproduce" in components
    assert "85.0 \u00b1 7.1 to 85.0" in geometry


def test_what_was_not_run_is_not_told(tmp_path: Path) -> None:
    store = make_store(tmp_path, [0], "paper", lambda cell: cell.method == "rrt_connect")
    assert sentences(Results(store)) == [
        "**Beside it** stand RRT-Connect 50.0 %, on the same starts."
    ]


def solve(store: Store, run: str, share: float) -> None:
    """Rewrite a run's episodes: the first ``share`` of them is solved."""
    path = store.run(run).path / "episodes.csv"
    rows = pd.read_csv(path)
    rows["success"] = (rows["episode"] < share * (rows["episode"].max() + 1)).astype(int)
    rows.to_csv(path, index=False)


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [
        (1.0, 1.0, "effect reproduces**"),
        (0.5, 1.0, "effect reproduces in part**"),
        (0.5, 0.5, "effect does not reproduce**"),
    ],
)
def test_the_design_stage_reproduces_only_at_the_ceiling(
    before: float, after: float, verdict: str, tmp_path: Path
) -> None:
    store = make_store(
        tmp_path,
        [0],
        "quick",
        lambda c: c.method in ("rainbow", "optimum") and c.ablation == "full",
    )
    solve(store, "rainbow-initial-tuned-s0", before)
    solve(store, "rainbow-optimized-tuned-s0", after)
    (told,) = [line for line in sentences(Results(store)) if "design stage" in line]
    assert verdict in told
    assert ("at the ceiling" in told) == (before == after == 1.0)


@pytest.mark.parametrize(("holes", "blamed"), [(0.0, True), (1.0, False)])
def test_the_printed_reward_is_blamed_only_where_nothing_is_filled(
    holes: float, blamed: bool, tmp_path: Path
) -> None:
    store = make_store(tmp_path, [0], "paper", lambda c: c.track == "printed")
    solve(store, "rainbow-optimized-printed-s0", 0.0)
    path = store.run("rainbow-optimized-printed-s0").path / "curve.csv"
    pd.read_csv(path).assign(holes=holes).to_csv(path, index=False)
    (told,) = [line for line in sentences(Results(store)) if "As printed" in line]
    assert f"fill {holes:.2f} holes" in told
    assert ("hovering" in told) == blamed


def test_the_last_episodes_count_once_each() -> None:
    curve = pd.DataFrame({
        "timesteps": [100, 900, 950, 980, 1000],
        "episodes": [1, 5, 6, 6, 9],
        "holes": [6.0, 6.0, 4.0, float("nan"), 2.0],
    })  # fmt: skip
    assert tail_mean(curve, "holes") == pytest.approx((1 * 4.0 + 3 * 2.0) / 4)
    assert math.isnan(tail_mean(curve[:1].assign(episodes=0), "holes"))
