"""The store: atomic files, one schema, one harness at a time, nothing overwritten."""

import math
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.runs.store import (
    SCHEMA,
    RunFolder,
    Store,
    changes,
    digest,
    write_atomic,
    write_text,
)
from tests.benchmarks.conftest import Command


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half of the n", encoding="utf-8")
        raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space"):
        write_atomic(path, fail)
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_reader_sees_the_old_file_or_the_new_one_which_is_on_the_disk(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    there: list[str] = []
    flush = mock.patch("os.fsync", side_effect=lambda _: there.append(path.read_text("utf-8")))
    with path.open(encoding="utf-8") as reader, flush:
        write_text(path, "new")
        assert reader.read() == there[0] == "old"
    assert path.read_text(encoding="utf-8") == "new"
    assert path.stat().st_mode & 0o777 == 0o644  # others read it too


def test_rows_come_back_as_they_went(tmp_path: Path) -> None:
    run = Store.open(tmp_path, "smoke", create=True).run("cell")
    run.write_rows("episodes", [
        {"episode": 0, "success": True, "time": 1.234567, "failure": "", "seed": 2**31 - 1},
        {"episode": 1, "success": False, "time": math.nan, "failure": "no plan", "seed": 7},
    ])  # fmt: skip
    frame = run.rows("episodes")
    assert frame["success"].tolist() == [1, 0]
    assert frame["seed"].tolist() == [2**31 - 1, 7]
    assert frame["time"][0] == 1.234567
    assert math.isnan(frame["time"][1])
    assert frame["failure"][1] == "no plan"


def test_a_run_is_complete_when_meta_is_there_and_not_before(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "smoke", create=True)
    run = store.run("cell")
    run.begin({"cell": {"seed": 0}})
    run.write_rows("episodes", [{"episode": 0}])
    run.policy.write_bytes(b"weights")
    run.write_progress(0.5, "half")
    assert not run.is_complete()
    assert not run.has_policy()
    assert run.progress() == (0.5, "half")
    assert store.completed() == []
    run.write_meta({"wall_seconds": 1.0})
    assert run.is_complete()
    assert run.has_policy()
    run.policy.unlink()
    assert run.is_complete()
    assert not run.has_policy()
    assert [result.id for result in store.completed()] == ["cell"]
    run.meta()["wall_seconds"] = 9.0  # who asked may change it
    assert run.meta() == {"schema": SCHEMA, "wall_seconds": 1.0}
    run.drop_checkpoint()
    assert run.progress() == (1.0, "complete")


def test_other_settings_are_refused_and_named(tmp_path: Path) -> None:
    run = Store.open(tmp_path, "smoke", create=True).run("cell")
    run.begin({"track": {"description": "Fast", "gamma": 0.99, "tau": 0.1}})
    before = (run.path / "config.yaml").read_bytes()
    with pytest.raises(BenchmarkError, match=r"\(track.gamma: 0.99 -> 0.9\)"):
        run.begin({"track": {"description": "Quick", "gamma": 0.9, "tau": 0.1}})
    # other words for the same settings are no other run
    run.begin({"track": {"description": "Quick", "gamma": 0.99, "tau": 0.1}})
    assert (run.path / "config.yaml").read_bytes() == before


def test_a_shield_of_the_usual_margins_is_no_lack_of_one() -> None:
    bare: dict[str, Any] = {"track": {"gamma": 0.99, "shield": None}}
    usual: dict[str, Any] = {"track": {"gamma": 0.99, "shield": {}}}
    assert changes(bare, usual) == ["track.shield: None -> {}"]
    assert changes({"track": {"gamma": 0.99}}, usual) == ["track.shield: absent -> {}"]
    assert changes(usual, {"track": {"gamma": 0.99}}) == ["track.shield: {} -> absent"]
    assert digest(bare) != digest(usual)


def test_a_lock_can_be_waited_for(tmp_path: Path) -> None:
    run = Store.open(tmp_path, "smoke", create=True).run("cell")
    held, refused = threading.Event(), threading.Event()

    def hold() -> None:
        with RunFolder(run.path).lock():
            held.set()
            refused.wait()
            time.sleep(0.2)  # the test waits meanwhile; if it comes later, nothing is lost

    other = threading.Thread(target=hold, daemon=True)
    other.start()
    held.wait()
    with pytest.raises(BenchmarkError, match="another process"), run.lock():
        pass
    refused.set()
    with run.lock(wait=100.0):
        pass
    other.join()


def test_progress_is_not_worth_a_run(tmp_path: Path) -> None:
    with mock.patch("benchmarks.runs.store.write_text", side_effect=OSError("no space left")):
        RunFolder(tmp_path).write_progress(0.5, "")
    assert RunFolder(tmp_path).progress() == (0.0, "")


def test_progress_is_told_no_more_often_than_it_is_looked_at(tmp_path: Path) -> None:
    with mock.patch("time.perf_counter", side_effect=[0.0, 0.4, 0.6, 0.8, 1.2]):
        run, told = RunFolder(tmp_path), []
        for share in (0.1, 0.2, 0.3, 0.4):
            run.report(share, lambda: "")
            told.append(run.progress()[0])
    assert told == [0.0, 0.2, 0.2, 0.4]


def test_each_clock_has_its_seconds_where_older_runs_have_them_too(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.write_meta({"wall_seconds": 3.0, "training": {"wall_seconds": 2.0, "cpu_seconds": 1.0}})
    assert (run.seconds(), run.seconds("cpu")) == (3.0, 1.0)


@pytest.mark.parametrize(
    ("text", "share"),
    [("[]", 0.0), ('{"done": null, "note": ""}', 0.0), ('{"done": NaN, "note": ""}', 0.0),
     ('{"done": 5, "note": ""}', 1.0), ('{"done": 0.5, "note": "half"}', 0.5)],
)  # fmt: skip
def test_a_progress_of_any_content_is_a_share(tmp_path: Path, text: str, share: float) -> None:
    run = RunFolder(tmp_path / "run")
    write_text(run.checkpoint / "progress.json", text)
    assert run.progress()[0] == share


@pytest.mark.parametrize("marker", ['{"schema": 999}', "{}", "not json"])
def test_another_schema_is_left_alone(tmp_path: Path, marker: str, refused: Command) -> None:
    path = tmp_path / "smoke" / "store.json"
    path.parent.mkdir()
    path.write_text(marker, encoding="utf-8")
    schema = "999" if "999" in marker else "unreadable"
    error = refused("run", "--preset", "smoke", "--results", str(tmp_path))
    assert f"results schema {schema}, this version reads" in error
    assert [*path.parent.iterdir()] == [path]
    assert path.read_text(encoding="utf-8") == marker


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "smoke").mkdir()
    (tmp_path / "smoke" / "thesis.tex").write_text("", encoding="utf-8")
    with pytest.raises(BenchmarkError, match="no results folder"):
        Store.open(tmp_path, "smoke", create=True)
    with pytest.raises(BenchmarkError, match="has no results"):
        Store.open(tmp_path, "other")
    assert not (tmp_path / "other").exists()


def test_two_harnesses_cannot_hold_one_folder(tmp_path: Path) -> None:
    first, second = (Store.open(tmp_path, "smoke", create=True) for _ in range(2))
    with first.lock(), pytest.raises(BenchmarkError, match="another harness"), second.lock():
        pass
    with second.lock():
        pass


def test_a_store_that_another_harness_makes_right_now_is_opened(tmp_path: Path) -> None:
    marker = tmp_path / "quick" / "store.json"

    def meanwhile(temporary: Path) -> None:
        """The other one has its temporary file, and has not renamed it."""
        assert list(marker.parent.iterdir()) == [temporary]
        Store.open(tmp_path, "quick", create=True)
        temporary.write_text(marker.read_text(encoding="utf-8"), encoding="utf-8")

    write_atomic(marker, meanwhile)
    assert Store.open(tmp_path, "quick").folder == marker.parent
