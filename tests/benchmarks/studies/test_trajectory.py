"""``study trajectory`` exports an episode, measures many, and can be checked."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
pytest.importorskip("ruckig", reason="ruckig is not installed (extra trajectory)")

from benchmarks.cli import main as command
from benchmarks.studies import trajectory
from benchmarks.studies.trajectory import TrajectoryStudy
from tests.benchmarks.conftest import Command
from tests.process import ROOT

MODEL = ROOT / "results" / trajectory.MODEL


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--blend"], ["--model", str(MODEL)]])
def test_one_episode_is_exported(words: list[str], tmp_path: Path, done: Command) -> None:
    folder = tmp_path / "episode"
    out = done("study", "trajectory", "--export", str(folder), "--start", "0", *words)
    rows = pd.read_csv(folder / "trajectory.csv")
    text = (folder / "joint_trajectory.yaml").read_text("utf-8")
    assert text.count("time_from_start:") == len(rows)
    assert (folder / "trajectory.png").stat().st_size > 0
    assert f"{rows['time'].iloc[-1]:.2f} s in " in out


def test_the_tables_follow_from_the_rows(site: Any) -> None:
    here = site("trajectory")
    places = ["--results", str(here.results), "--model", str(MODEL)]
    assert command(["study", "trajectory", "--starts", "2", *places]) == 0
    here.check(TrajectoryStudy, "optimum")
    rows = pd.DataFrame([row for part in here.parts(TrajectoryStudy).values() for row in part])
    assert len(rows) == 12
    assert set(rows["method"]) == {"optimum", "RRT-Connect", "Rainbow"}
    done = rows[rows["moves_first"] > 0]
    assert (done["method"] == "optimum").any()
    # the shorter of two trajectories of one way, and a way is no longer to its first insertion
    pairs = done.pivot(index=["method", "start"], columns="kind", values="seconds_first")
    assert (pairs["blended"] <= pairs["stop-and-go"] + 1e-9).all()
    assert (done["seconds_first"] <= done["seconds"] + 1e-9).all()


def test_only_what_inserts_counts_as_inserted_softly() -> None:
    """Beside the hole nothing presses, so a way that missed would look gentle."""
    rows = pd.DataFrame(
        {"method": "optimum", "kind": "blended", "start": range(4), "moves_first": [9, 9, 9, 0],
         "moves": 20, **dict.fromkeys(trajectory.KEYS, 1.0), "blocked_first": 0,
         "inserted": [True, True, False, False], "force": [10.0, 90.0, 10.0, 0.0]}
    )  # fmt: skip
    assert "| 2 | 1 |" in " ".join(trajectory.table(rows).split())
