"""Stored runs play again: which episodes at which levels."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.evaluation.evaluate import levels
from benchmarks.protocol.plan import Cell
from benchmarks.runs.store import Store
from benchmarks.studies.scoring.scores import FRESH_EPISODES, Replay


def replay(results: Path, episodes: int | None, starts: int | None) -> Replay:
    Store.open(results, "cut", create=True)
    return Replay("cut", results, episodes, starts)


@pytest.mark.parametrize(
    ("method", "track", "found"),
    [
        ("rainbow", "safe", [{}]),
        ("greedy_observed", "safe", [{}]),
        ("greedy", "uncertain", [{"error": 3.0}]),
        ("rainbow", "uncertain_nominal", [{"error": 3.0}]),
        ("optimum", "", [{}]),
    ],
)
def test_other_starts_are_played_as_the_headline_has_them(
    method: str, track: str, found: list[dict[str, object]], tmp_path: Path
) -> None:
    cell = Cell(method, "full", "optimized", track, 0)
    fresh = replay(tmp_path, None, 7)
    preset = fresh.shortened(cell)
    assert preset.evaluation.episodes == FRESH_EPISODES
    mine = levels(preset, cell)
    assert [level.columns for level in mine] == found
    assert all(level.noise == 0.0 for level in mine)
    # the same machine as in the stored episodes, to the bit
    whole = [level.arguments for level in levels(fresh.preset, cell)]
    assert all(level.arguments in whole for level in mine)


def test_the_test_episodes_are_played_whole(tmp_path: Path) -> None:
    cell = Cell("greedy", "full", "optimized", "uncertain", 0)
    again = replay(tmp_path, None, None)
    assert again.shortened(cell) == again.preset
    few = replay(tmp_path, 3, None).shortened(cell).evaluation
    assert (few.episodes, few.errors) == (3, again.preset.evaluation.errors)
    assert replay(tmp_path, 50, 7).shortened(cell).evaluation.episodes == 50
