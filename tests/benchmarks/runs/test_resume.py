"""A run that was cut off ends as an uninterrupted one; damaged checkpoints are set aside.

What ends with a signal instead, for each learner: test_kill.
"""

import dataclasses
import errno
import math
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell
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


# a low bar, so that the curriculum's switch lies within the run
TRACK = {"timesteps": 400, "curriculum": {"threshold": -1.0, "window": 1}}
TRACKS = smoke(TRACK)["tracks"] | {t: {**TRACK, "hyperparameters": SMALL} for t in TEAMS}
PRESET = smoke_preset(tracks=TRACKS, evaluation={"episodes": 1, "noise": [0.0]})


def trained(folder: RunFolder, cell: Cell = CELLS[0]) -> tuple[str, dict[str, Any]]:
    """The digest of the run's weights at its end, and what it says of its training."""
    result = train(PRESET, cell, folder)
    assert result is not None
    return digest(result[0]), result[1]


def cut_off(folder: RunFolder, rounds: int, cell: Cell = CELLS[0]) -> list[Path]:
    """Train for so many rounds; returns the checkpoints that there are."""
    assert train(PRESET, cell, folder, stop_after(rounds)) is None
    return checkpoints(folder.checkpoint)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    runs = {}
    for cell in CELLS:
        folder = RunFolder(tmp_path_factory.mktemp(cell.id))
        weights, _ = trained(folder, cell)
        runs[cell.id] = weights, (folder.path / "curve.csv").read_text("utf-8")
    return runs


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.id)
def test_stopping_twice_changes_nothing(cell: Cell, whole: Whole, folder: RunFolder) -> None:
    cut_off(folder, 17, cell)
    (kept,) = cut_off(folder, 40, cell)
    assert kept.name == "step-0000000228"  # 17 rounds, then 40 more, of 4 environments
    weights, summary = trained(folder, cell)
    assert (weights, (folder.path / "curve.csv").read_text("utf-8")) == whole[cell.id]
    assert len(summary["resumed_at"]) == 2
    assert summary["timesteps"] == 400


def test_checkpoints_are_as_far_apart_as_the_preset_says_and_time_is_that_of_all_processes(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    preset = dataclasses.replace(PRESET, checkpoint_seconds=10.0)
    seconds, told, seen = 0.0, list[float](), list[str]()
    monkeypatch.setattr(RunFolder, "report", lambda self, share, note: told.append(share))
    clock = SimpleNamespace(perf_counter=lambda: seconds, process_time=lambda: seconds / 2.0)
    monkeypatch.setattr("benchmarks.runs.checkpoint.time", clock)

    def stop(at: float) -> bool:
        """Asked once a round of four steps, which takes a second."""
        nonlocal seconds
        seconds += 1.0
        kept = [path.name for path in checkpoints(folder.checkpoint)]
        assert len(kept) <= 1
        seen.extend(name for name in kept if name not in seen)
        return seconds == at

    assert train(preset, CELLS[0], folder, lambda: stop(25.0)) is None
    (folder.checkpoint / "saving" / "half").mkdir(parents=True)  # of a process that was killed
    result = train(preset, CELLS[0], folder, lambda: stop(math.inf))
    assert result is not None
    steps = [36, 76, 96, *range(132, 400, 40)]
    assert seen == [f"step-{step:010d}" for step in steps]
    assert told == [step / 400 for step in (*range(0, 100, 4), *range(96, 400, 4))]
    assert (result[1]["wall_seconds"], result[1]["cpu_seconds"]) == (101.0, 50.5)


def test_a_checkpoint_is_on_the_disk_before_the_last_one_goes(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    (old,) = cut_off(folder, 10)
    synced: list[tuple[str, list[Path]]] = []

    def sync(path: Path) -> None:
        synced.append((path.name, checkpoints(folder.checkpoint)))

    monkeypatch.setattr("benchmarks.runs.checkpoint.sync", sync)
    (new,) = cut_off(folder, 10)
    files = ("buffer.pkl", "model.zip", "state.pkl")
    assert sorted(synced[:-1]) == [(name, [old]) for name in files]
    assert synced[-1] == ("checkpoint", [old, new])


def test_a_run_says_which_commits_it_was_made_with(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    for commit in ("old", "old", "new"):
        monkeypatch.setattr(machine, "describe", lambda c=commit: {"commit": c, "dirty": False})
        cut_off(folder, 10)
    assert trained(folder)[1]["made_with"] == [
        {"from_step": 0, "commit": "old", "dirty": False},
        {"from_step": 80, "commit": "new", "dirty": False},
    ]


@pytest.mark.parametrize("rounds", [0, 1])
def test_stopping_at_once_changes_nothing(rounds: int, whole: Whole, folder: RunFolder) -> None:
    assert len(cut_off(folder, rounds)) == rounds
    assert trained(folder)[0] == whole[CELLS[0].id][0]


def test_stopping_where_it_resumed_keeps_the_checkpoint_as_it_is(folder: RunFolder) -> None:
    (kept,) = cut_off(folder, 10)
    stamps = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    cut_off(folder, 0)
    # written again it would be deleted for its copy, and a kill in between would leave neither
    assert {path: path.stat().st_mtime_ns for path in kept.iterdir()} == stamps


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ESTALE, "Stale file handle"),
        *(MemoryError("Unable to allocate"), torch.OutOfMemoryError("CUDA out of memory")),
    ],
)
def test_a_machine_in_trouble_damages_no_checkpoint(error: Exception, folder: RunFolder) -> None:
    kept, said = cut_off(folder, 40), "it is kept, the same command tries again"
    fails = mock.patch.object(Rainbow, "load", side_effect=error)
    with fails, pytest.raises(BenchmarkError, match=said):
        trained(folder)
    assert checkpoints(folder.checkpoint) == kept
    _, summary = trained(folder)
    assert summary["set_aside"] == []
    assert summary["resumed_at"]


@pytest.mark.parametrize("name", ["state.pkl", "model.zip", "buffer.pkl"])
def test_a_damaged_checkpoint_is_kept_aside(name: str, whole: Whole, folder: RunFolder) -> None:
    (kept,) = cut_off(folder, 40)
    damaged = kept / name
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    (kept.with_name(f"broken-{kept.name}") / "earlier").mkdir(parents=True)  # a second time
    with pytest.warns(UserWarning, match=f"{kept.name} cannot be read"):
        weights, summary = trained(folder)
    assert summary["set_aside"] == [f"broken-{kept.name}"]
    assert weights == whole[CELLS[0].id][0]
    # it outlives the end of the run, which drops the other working files
    folder.drop_checkpoint()
    (aside,) = folder.checkpoint.iterdir()
    assert (aside / name).is_file()


def test_of_two_checkpoints_the_older_serves_where_the_newer_is_damaged(
    whole: Whole, folder: RunFolder, tmp_path: Path
) -> None:
    (old,) = cut_off(folder, 10)  # kept beside the next by a kill
    shutil.copytree(old, tmp_path / "copy")
    (new,) = cut_off(folder, 30)
    shutil.move(tmp_path / "copy", old)
    (new / "state.pkl").write_bytes(b"")
    with pytest.warns(UserWarning, match=f"{new.name} cannot be read"):
        weights, summary = trained(folder)
    assert (summary["set_aside"], summary["resumed_at"]) == ([f"broken-{new.name}"], [40])
    assert weights == whole[CELLS[0].id][0]


@pytest.mark.parametrize(
    "error",
    # torch tells of a failed write without its cause
    [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), RuntimeError("unexpected pos 64 vs 0")],
)
def test_a_disk_that_fills_up_keeps_the_last_checkpoint(
    error: Exception, whole: Whole, folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_off(folder, 10)

    def fill(model: object, path: Path) -> None:
        path.write_bytes(b"half of the buffer")
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(OffPolicyAlgorithm, "save_replay_buffer", fill)
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
        with pytest.raises(BenchmarkError, match=r"disk is full.*goes on from step-0000000040"):
            cut_off(folder, 5)
        if isinstance(error, RuntimeError):  # the disk is not to blame for it where there is room
            patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=10**12))
            with pytest.raises(RuntimeError, match="unexpected pos"):
                cut_off(folder, 5)
    (kept,) = checkpoints(folder.checkpoint)
    assert kept.name == "step-0000000040"
    assert not (folder.checkpoint / "saving").exists()  # its room is free again
    assert trained(folder)[0] == whole[CELLS[0].id][0]
