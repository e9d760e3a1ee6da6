"""A run that was cut off ends as an uninterrupted one; damaged checkpoints are set aside.

What ends with a signal instead, for each learner: test_kill.
"""

import errno
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset
from benchmarks.runs import machine
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.policy_file import digest
from benchmarks.runs.store import RunFolder
from benchmarks.runs.training import train
from sb3_rainbow import Rainbow
from tests.benchmarks.smoke import SMALL, smoke, smoke_preset, stop_after

Whole = dict[str, tuple[str, str]]  # digest of the weights, and curve, of each cell
TEAMS = ("vdn", "shared_sight", "independent")
CELLS = [Cell("rainbow", "full", "optimized", track, 0) for track in ("safe", *TEAMS)]


@pytest.fixture(scope="module")
def preset() -> Preset:
    # a low bar, so that the curriculum's switch lies within the run
    track = {"timesteps": 400, "curriculum": {"threshold": -1.0, "window": 1}}
    tracks = smoke(track)["tracks"] | {t: {**track, "hyperparameters": SMALL} for t in TEAMS}
    return smoke_preset(tracks=tracks, evaluation={"episodes": 1, "noise": [0.0]})


def trained(preset: Preset, cell: Cell, folder: RunFolder) -> tuple[str, dict[str, Any]]:
    """The digest of the run's weights at its end, and what it says of its training."""
    result = train(preset, cell, folder)
    assert result is not None
    return digest(result[0]), result[1]


@pytest.fixture(scope="module")
def uninterrupted(preset: Preset, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    runs = {}
    for cell in CELLS:
        folder = RunFolder(tmp_path_factory.mktemp(cell.id))
        weights, _ = trained(preset, cell, folder)
        runs[cell.id] = weights, (folder.path / "curve.csv").read_text("utf-8")
    return runs


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.id)
def test_stopping_twice_at_odd_moments_changes_nothing(
    cell: Cell, preset: Preset, uninterrupted: Whole, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path)
    assert train(preset, cell, folder, stop_after(17)) is None
    assert train(preset, cell, folder, stop_after(40)) is None
    (kept,) = checkpoints(folder.checkpoint)
    assert kept.name == "step-0000000228"  # 17 rounds, then 40 more, of 4 environments
    weights, summary = trained(preset, cell, folder)
    assert (weights, (folder.path / "curve.csv").read_text("utf-8")) == uninterrupted[cell.id]
    assert len(summary["resumed_at"]) == 2
    assert summary["timesteps"] == 400


def test_a_run_says_which_commits_it_was_made_with(
    preset: Preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(tmp_path)
    for commit in ("old", "old", "new"):
        monkeypatch.setattr(machine, "describe", lambda c=commit: {"commit": c, "dirty": False})
        train(preset, CELLS[0], folder, stop_after(10))
    assert trained(preset, CELLS[0], folder)[1]["made_with"] == [
        {"from_step": 0, "commit": "old", "dirty": False},
        {"from_step": 80, "commit": "new", "dirty": False},
    ]


@pytest.mark.parametrize("rounds", [0, 1])
def test_stopping_at_the_very_start_changes_nothing(
    rounds: int, preset: Preset, uninterrupted: Whole, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path)
    assert train(preset, CELLS[0], folder, stop_after(rounds)) is None
    assert len(checkpoints(folder.checkpoint)) == rounds
    assert trained(preset, CELLS[0], folder)[0] == uninterrupted[CELLS[0].id][0]


def test_stopping_where_it_resumed_keeps_the_checkpoint_as_it_is(
    preset: Preset, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(10))
    (kept,) = checkpoints(folder.checkpoint)
    stamps = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    train(preset, CELLS[0], folder, stop_after(0))
    # written again it would be deleted for its copy, and a kill in between would leave neither
    assert {path: path.stat().st_mtime_ns for path in kept.iterdir()} == stamps


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ESTALE, "Stale file handle"),
        *(MemoryError("Unable to allocate"), torch.OutOfMemoryError("CUDA out of memory")),
    ],
)
def test_a_machine_in_trouble_damages_no_checkpoint(
    error: Exception, preset: Preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(40))
    kept = checkpoints(folder.checkpoint)

    def fail(*args: object, **kwargs: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(Rainbow, "load", fail)
        with pytest.raises(BenchmarkError, match="it is kept, the same command tries again"):
            train(preset, CELLS[0], folder)
    assert checkpoints(folder.checkpoint) == kept
    _, summary = trained(preset, CELLS[0], folder)
    assert summary["set_aside"] == []
    assert summary["resumed_at"]


@pytest.mark.parametrize("name", ["state.pkl", "model.zip", "buffer.pkl"])
def test_a_damaged_checkpoint_is_named_and_kept_aside(
    name: str, preset: Preset, uninterrupted: Whole, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(40))
    (kept,) = checkpoints(folder.checkpoint)
    damaged = kept / name
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.warns(UserWarning, match=f"{kept.name} cannot be read"):
        weights, summary = trained(preset, CELLS[0], folder)
    assert summary["set_aside"] == [f"broken-{kept.name}"]
    assert weights == uninterrupted[CELLS[0].id][0]
    # it outlives the end of the run, which drops the other working files
    folder.drop_checkpoint()
    (aside,) = folder.checkpoint.iterdir()
    assert (aside / name).is_file()


@pytest.mark.parametrize(
    "error",
    # torch tells of a failed write without its cause
    [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), RuntimeError("unexpected pos 64 vs 0")],
)
def test_a_disk_that_fills_up_keeps_the_last_checkpoint(
    error: Exception,
    preset: Preset,
    uninterrupted: Whole,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(10))

    def fill(model: object, path: Path) -> None:
        path.write_bytes(b"half of the buffer")
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(OffPolicyAlgorithm, "save_replay_buffer", fill)
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
        with pytest.raises(BenchmarkError, match=r"disk is full.*goes on from step-0000000040"):
            train(preset, CELLS[0], folder, stop_after(5))
    (kept,) = checkpoints(folder.checkpoint)
    assert kept.name == "step-0000000040"
    assert not (folder.checkpoint / "saving").exists()  # its room is free again
    assert trained(preset, CELLS[0], folder)[0] == uninterrupted[CELLS[0].id][0]
