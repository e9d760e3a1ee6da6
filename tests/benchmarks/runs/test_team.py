"""Teams through the harness in seconds: each form learns, is tested, and agrees."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.cli import main
from benchmarks.reporting.results import Results
from benchmarks.runs.store import Store
from tests.benchmarks.smoke import SMALL, preset_file

TRACKS = ("in_turn", "central", "vdn", "shared_sight", "independent")


@pytest.mark.usefixtures("forked")
def test_all_begin_alike_and_verify_agrees(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = {
        "description": "teams in seconds",
        "seeds": [0],
        "evaluation": {"episodes": 2, "noise": [0.0]},
        "tracks": {t: {"timesteps": 240, "hyperparameters": SMALL} for t in TRACKS},
        "runs": [
            {"methods": ["rainbow"], "tracks": list(TRACKS)},
            {"methods": ["rainbow"], "tracks": ["vdn"], "ablations": ["double_dueling"]},
            {"methods": ["random", "greedy"], "tracks": ["central", "independent"]},
            {"methods": ["optimum", "optimum_at_once"]},
        ],
    }
    words = ["--preset", str(preset_file(tmp_path, preset, "tiny")), "--results", str(tmp_path)]
    assert main(["run", *words, "--jobs", "1"]) == 0
    runs = Results(Store.open(tmp_path, "tiny")).all()
    assert len(runs) == 12
    assert len({tuple(run.test()["start"]) for run in runs}) == 1
    assert main(["verify", *words]) == 0, capsys.readouterr().err
