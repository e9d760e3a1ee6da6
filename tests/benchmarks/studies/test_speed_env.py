"""``python -m benchmarks speed env`` measures, prints and stores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.studies.speed.env import TARGETS, main


def test_the_command_writes_what_it_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--steps", "256", "--rounds", "1", "--starts", "3", "--memory-steps", "1280"]
    assert main(["--results", str(tmp_path), *small]) == 0
    found = json.loads((tmp_path / "speed" / "env.json").read_text())
    text = (tmp_path / "speed" / "env.md").read_text()
    printed = capsys.readouterr().out
    assert printed.startswith(text)
    assert str(tmp_path / "speed" / "env") in printed.removeprefix(text)
    assert set(found["ratios"]) == set(TARGETS)
    assert all(value > 0.0 for value in found["step_us"].values())
    assert found["oracle"]["optimized"]["feasible"] > 0.0
    # generous, so that only a gross slip fails here whatever else the machine does
    assert found["step_us"]["batch of 64"] < found["step_us"]["SB3 DummyVecEnv of 64"]
