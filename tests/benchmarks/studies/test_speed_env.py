"""``python -m benchmarks study speed-env`` measures, prints and stores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.cli import main
from benchmarks.studies.speed.env import SpeedEnv


def test_the_command_writes_what_it_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--steps", "256", "--rounds", "1", "--starts", "3"]
    assert main(["study", "speed-env", "--results", str(tmp_path), *small]) == 0
    parts = json.loads((tmp_path / "speed" / "env.json").read_text())["parts"]
    text = (tmp_path / "speed" / "env.md").read_text()
    printed = capsys.readouterr().out
    assert text in printed
    assert str(tmp_path / "speed") in printed
    assert all(value > 0.0 for value in parts["steps"].values())
    assert parts["optimum, optimized"]["feasible"] > 0.0
    # generous, so that only a gross slip fails here whatever else the machine does
    assert parts["steps"]["batch of 64"] < parts["steps"]["SB3 DummyVecEnv of 64"]
    assert SpeedEnv.problems(tmp_path) == []
