"""The scheduler: Ctrl-C and a killed harness lose nothing, failures are told, room is checked."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from pathlib import Path

import pytest
import yaml

from benchmarks.__main__ import main
from benchmarks.cell import StopFlag
from benchmarks.checkpoint import checkpoints
from benchmarks.presets import PRESETS
from benchmarks.store import Store


@pytest.fixture
def long_preset(tmp_path: Path) -> Path:
    """One run that no test waits for."""
    data = yaml.safe_load((PRESETS / "smoke.yaml").read_text(encoding="utf-8"))
    data["tracks"]["tuned"]["timesteps"] = 10_000_000
    data["runs"] = [{"methods": ["dqn"], "tracks": ["tuned"]}]
    path = tmp_path / "long.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def wait_for(path: Path, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} did not appear"
        time.sleep(0.1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_ended_harness_leaves_a_checkpoint_to_resume_from(
    number: signal.Signals, long_preset: Path, tmp_path: Path
) -> None:
    words = ["run", "--preset", str(long_preset), "--results", str(tmp_path / "results")]
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    run = Store(tmp_path / "results", "long").run("dqn-optimized-tuned-s0")
    wait_for(run.checkpoint / "progress.json")
    process.send_signal(number)
    out, _ = process.communicate(timeout=100)
    deadline = time.monotonic() + 60
    while not checkpoints(run.checkpoint):
        assert time.monotonic() < deadline, (run.checkpoint / "log.txt").read_text()
        time.sleep(0.1)
    assert not run.is_complete()
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert "the same command resumes" in out


def test_a_run_that_fails_is_told_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = yaml.safe_load((PRESETS / "smoke.yaml").read_text(encoding="utf-8"))
    # OMPL's planner refuses the limit when it is built, in the child
    data["planner"] = {"time_limit": -1.0}
    data["runs"] = [{"methods": ["rrt_connect", "optimum"]}]
    path = tmp_path / "odd.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    words = ["run", "--preset", str(path), "--results", str(tmp_path / "results"), "--jobs", "1"]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "rrt_connect-optimized-s0: failed" in out
    assert "time_limit = -1.0" in out
    runs = Store.open(tmp_path / "results", "odd").completed()
    assert [run.id for run in runs] == ["optimum-optimized-s0"]


def test_too_small_a_disk_is_refused_before_the_start(
    long_preset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**12, 10**12, 10**6))
    words = ["run", "--preset", str(long_preset), "--results", str(tmp_path / "results")]
    assert main(words) == 2
    assert "make room" in capsys.readouterr().err
    assert not (tmp_path / "results" / "long" / "runs").exists()


def test_an_orphan_knows_that_it_should_stop() -> None:
    assert not StopFlag()()
    assert not StopFlag(os.getppid())()
    assert StopFlag(os.getppid() + 1)()
