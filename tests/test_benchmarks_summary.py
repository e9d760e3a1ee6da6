"""The sentences above the tables say what the stored runs say, and nothing without runs."""

from __future__ import annotations

from pathlib import Path

from fabricated_store import make_store

from benchmarks.results import Results
from benchmarks.summary import sentences


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
    assert "no clear difference without" in components
    assert "does not reproduce" in components
    assert "85.0 \u00b1 7.1 to 85.0" in geometry


def test_what_was_not_run_is_not_told(tmp_path: Path) -> None:
    store = make_store(tmp_path, [0], "paper", lambda cell: cell.method == "rrt_connect")
    assert sentences(Results(store)) == [
        "**Beside it** stand RRT-Connect 50.0 %, on the same starts."
    ]
