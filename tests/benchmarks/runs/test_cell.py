"""One cell: whom it waits for, when it stops, what it says of its time and its sources."""

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import Cell
from benchmarks.runs import machine
from benchmarks.runs.cell import Stopped, run_cell, run_here, run_once
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.smoke import smoke_preset

CONFIG = {"cell": {"method": "mine"}}
DONE: dict[str, Any] = {"training": {}}
CELL = "optimum-optimized-s0"


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path / "run")


def test_what_another_process_completes_meanwhile_is_not_done_again(folder: RunFolder) -> None:
    released = threading.Event()

    def complete() -> None:
        with folder.lock():
            released.set()
            while not (folder.path / "waited").exists():
                time.sleep(0.01)
            folder.write_meta(DONE)

    other = threading.Thread(target=complete)
    other.start()
    released.wait()
    with pytest.raises(BenchmarkError, match="another process is at work"):
        run_once(folder, CONFIG, "mine", lambda: pytest.fail("done twice"))
    (folder.path / "waited").touch()
    assert run_once(folder, CONFIG, "mine", lambda: pytest.fail("done twice"), wait=60.0)
    other.join()


def test_a_complete_run_is_left_as_it_is_but_not_taken_for_one_of_other_settings(
    folder: RunFolder,
) -> None:
    assert run_once(folder, CONFIG, "mine", lambda: DONE)
    (folder.path / "run.lock").unlink(missing_ok=True)
    before = folder.versions()
    assert run_once(folder, CONFIG, "mine", lambda: pytest.fail("done twice"))
    assert folder.versions() == before
    with pytest.raises(BenchmarkError, match=r"cell\.method: mine -> other"):
        run_once(folder, {"cell": {"method": "other"}}, "mine", lambda: DONE)


def test_a_run_whose_folder_is_deleted_meanwhile_is_whole_at_its_end(folder: RunFolder) -> None:
    def work() -> dict[str, Any]:
        assert folder.config() == CONFIG
        shutil.rmtree(folder.path)
        return DONE

    assert run_once(folder, CONFIG, "mine", work)
    assert folder.config() == CONFIG


def test_a_run_says_the_time_of_all_its_processes_and_the_sources_that_it_began_with(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    commits = iter(["begun", "edited"])
    monkeypatch.setattr(machine, "describe", lambda: {"commit": next(commits)})
    spent = {"wall_seconds": 500.0, "test_seconds": 20.0, "cpu_seconds": 400.0}
    run_once(folder, CONFIG, "mine", lambda: {"training": spent})
    meta = folder.meta()
    assert (meta["wall_seconds"], meta["cpu_seconds"]) == (520.0, 400.0)
    assert (meta["commit"], meta["cell"], meta["preset"]) == ("begun", "run", "mine")


def test_a_stopped_run_begins_anew_and_a_complete_one_leaves_no_working_files(
    folder: RunFolder,
) -> None:
    def work() -> None:
        folder.write_progress(0.4, "on the way")
        raise Stopped

    assert not run_once(folder, CONFIG, "mine", work)
    assert folder.progress() == (0.0, "stopped")
    assert run_once(folder, CONFIG, "mine", lambda: DONE)
    assert not folder.checkpoint.exists()


@pytest.fixture
def handlers() -> Iterator[None]:
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(
    ("event", "parent", "code"),
    [
        (lambda: None, os.getppid, 0),
        (lambda: None, os.getpid, 130),  # the harness is gone: this process is another's child
        (lambda: signal.raise_signal(signal.SIGTERM), os.getppid, 130),
        (lambda: signal.raise_signal(signal.SIGINT), lambda: None, 130),
    ],
)
def test_a_process_stops_when_it_is_asked_or_its_harness_is_gone(
    event: Callable[[], None], parent: Callable[[], int | None], code: int,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def run(
        self: Insertion, cell: Cell, folder: RunFolder, stop: StopRequested, device: str
    ) -> Any:
        assert (cell.id, device) == (CELL, "cpu")
        event()
        return None if stop() else DONE

    monkeypatch.setattr(Insertion, "run", run)
    store = Store.open(tmp_path, "smoke", create=True)
    assert run_here(Insertion("smoke"), store, CELL, parent(), 0.0, "cpu") == code
    assert store.run(CELL).is_complete() == (code == 0)
    assert ("complete, see" if code == 0 else "stopped,") in capsys.readouterr().out


@pytest.mark.usefixtures("handlers")
def test_a_node_without_a_gpu_refuses_a_run_that_needs_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    store = Store.open(tmp_path, "smoke", create=True)
    with pytest.raises(BenchmarkError, match="PyTorch finds no GPU here"):
        run_here(Insertion("smoke"), store, CELL, None, 0.0, "cuda")
    assert not store.run(CELL).path.exists()


def test_a_cell_runs_on_the_device_that_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[str] = []
    monkeypatch.setattr(Insertion, "run", lambda *arguments: given.append(arguments[-1]))
    one = Insertion(smoke_preset())
    assert not run_cell(one, one.find(CELL), Store(tmp_path, "smoke"), device="cuda")
    assert given == ["cuda"]
