"""The scheduler: Ctrl-C and a killed harness lose nothing, failures are told, room is checked."""

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
from rich.console import Console
from rich.progress import Progress

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.runs.backends import GRACE_SECONDS, Backend, Job
from benchmarks.runs.cell import run_cell
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.harness import Harness, Outcome, bar, check_disk
from benchmarks.runs.store import RunFolder, Store, digest, write_text
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.conftest import Command
from tests.benchmarks.runs.warm import PATIENCE, Forked, wait_for
from tests.benchmarks.smoke import smoke_file, smoke_preset
from tests.process import ROOT


@pytest.fixture
def long_run(tmp_path: Path) -> list[str]:
    """Arguments for one run that no test waits for."""
    runs = [{"methods": ["dqn"], "tracks": ["safe"]}]
    preset = smoke_file(tmp_path, "long", track={"timesteps": 10_000_000}, runs=runs)
    return ["--preset", str(preset), "--results", str(tmp_path / "results")]


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_ended_harness_leaves_a_checkpoint_to_resume_from(
    number: signal.Signals, long_run: list[str], tmp_path: Path
) -> None:
    """Its run is a process of its own."""
    process = Forked(tmp_path / "out.txt", ["run", *long_run])
    run = Store(tmp_path / "results", "long").run("dqn-optimized-safe-s0")
    wait_for(lambda: run.progress()[0] > 0, tmp_path / "out.txt")  # at step 0 nothing is saved
    process.send_signal(number)
    code = process.wait()
    wait_for(lambda: checkpoints(run.checkpoint), run.log)
    assert not run.is_complete()
    if number == signal.SIGINT:
        assert code == 130
        assert "the same command resumes" in (tmp_path / "out.txt").read_text("utf-8")


@pytest.mark.usefixtures("forked")
def test_a_failed_run_ends_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # no start lies so far from every hole, which the child finds out
    hopeless = {"base": "safe", "task": {"start_clearance": [0.6, 0.7]}}
    groups = [{"methods": ["greedy"], "tracks": ["hopeless"]}, {"methods": ["optimum"]}]
    path = smoke_file(tmp_path, "odd", tracks={"hopeless": hopeless}, runs=groups)
    words = ["run", "--preset", str(path), "--results", str(tmp_path / "results"), "--jobs", "1"]
    assert main(words) == 1
    out = capsys.readouterr().out
    assert "greedy-optimized-hopeless-s0: failed" in out
    assert "too little workspace" in out
    runs = Store.open(tmp_path / "results", "odd").completed()
    assert [run.id for run in runs] == ["optimum-optimized-s0"]


def test_a_small_disk_is_refused(long_run: list[str], tmp_path: Path, refused: Command) -> None:
    with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=10**6)):
        assert "make room" in refused("run", *long_run)
    assert not (tmp_path / "results" / "long" / "runs").exists()


@pytest.mark.parametrize(
    ("method", "track", "message"),
    [
        ("rainbow", {"hyperparameters": {"v_min": 30.0}}, "v_min"),
        *((m, {"reward_kwargs": {"step_costs": 0.1}}, "step_costs") for m in ("rainbow", "greedy")),
        *((m, {"observation": "papers"}, "papers") for m in ("rainbow", "greedy")),
    ],
)
def test_an_impossible_cell_is_refused_before_the_start(
    method: str, track: dict[str, Any], message: str, tmp_path: Path, refused: Command
) -> None:
    runs = [{"methods": [method], "tracks": ["safe"]}]
    path = smoke_file(tmp_path, "odd", track=track, runs=runs)
    words = ["--preset", str(path), "--results", str(tmp_path / "results")]
    assert message in refused("run", *words)
    assert message in refused("train", *words, "--cell", f"{method}-optimized-safe-s0")
    assert not (tmp_path / "results" / "odd" / "runs").exists()


def test_a_run_of_other_settings_than_another_seeds_is_refused_before_the_start(
    long_run: list[str], tmp_path: Path, refused: Command
) -> None:
    one = Insertion(long_run[1])
    run = one.open_store(tmp_path / "results", create=True).run("dqn-optimized-safe-s9")
    settings = one.settings(one.cells[0])
    other = {**settings, "track": {**settings["track"], "timesteps": 480}}
    run.begin(other)
    run.write_meta({"training": {}})
    told = "s0 differ in more than their seed (track.timesteps: 480 -> 10000000)"
    assert told in refused("run", *long_run)
    assert told in refused("train", *long_run, "--cell", "dqn-optimized-safe-s0")
    RunFolder(run.path.with_name("dqn-optimized-safe-s0")).begin(other)
    assert "s0 holds a run with other settings" in refused("run", *long_run)


@pytest.mark.usefixtures("forked")
def test_a_preset_that_was_edited_meanwhile_is_not_run_under_its_old_name(tmp_path: Path) -> None:
    runs = [{"methods": ["greedy"], "tracks": ["safe"]}]

    class Editing(Backend):
        def start(self, argv: Sequence[str], folder: RunFolder) -> Job:
            smoke_file(tmp_path, "odd", track={"mask_visited": 5}, runs=runs)
            return super().start(argv, folder)

    one = Insertion(str(smoke_file(tmp_path, "odd", track={"mask_visited": 3}, runs=runs)))
    store = one.open_store(tmp_path / "results", create=True)
    outcome = Harness(one, store, Editing(1), Console(file=io.StringIO())).run()
    assert [*outcome.failed] == ["greedy-optimized-safe-s0"]
    assert "'odd' was edited after the run began" in store.run(*outcome.failed).log.read_text()


def test_a_learner_that_ends_early_is_no_complete_run(tmp_path: Path) -> None:
    one = Insertion(load_preset("smoke"))
    store = one.open_store(tmp_path, create=True)
    with (
        mock.patch("stable_baselines3.DQN.learn", lambda self, *_, **__: self),
        pytest.raises(BenchmarkError, match=r"DQN.learn\(\) returned at step 0 of 480"),
    ):
        run_cell(one, one.find("dqn-optimized-safe-s0"), store)
    assert not store.completed()


def test_a_digest_is_of_what_decides_a_result() -> None:
    settings = {"track": {"description": "a", "timesteps": 3, "tau": 1}, "seeds": [1, 2]}
    told = {**settings, "track": {"tau": 1, "timesteps": 3, "description": "b"}}
    longer = {**settings, "track": {"description": "a", "timesteps": 4, "tau": 1}}
    assert digest(settings) == digest(told) != digest(longer)


class FakeJob(Job):
    """A run whose progress the test writes; its note "deleted" leaves no folder of it."""

    def __init__(self, folder: RunFolder, script: Iterator[tuple[float, str]]) -> None:
        self.log, self.folder, self.script = folder.log, folder, script
        self.code: int | None = None
        self.waits = True

    def poll(self) -> int | None:
        if self.code is not None:
            return self.code
        share, note = next(self.script)
        self.waits = note == "waits"
        if note == "ended":
            signal.raise_signal(signal.SIGTERM)
        if share < 0.0:
            if note != "no log":
                write_text(self.folder.log, "first line\n" + 7 * "more\n" + "the reason\n")
            self.code = int(share)
        elif share == 1.0:
            self.folder.write_meta({"training": {"set_aside": ["broken-step-7"]}})
            if note == "deleted":
                (self.folder.path / "meta.json").write_text("{", encoding="utf-8")
            self.code = 0
        else:
            self.folder.write_progress(share, note)
        return self.code

    def place(self) -> str | None:
        return None if self.waits else "far"

    def stop(self) -> None:
        self.folder.write_progress(0.5, "asked")

    def wait(self, seconds: float) -> None:
        assert 0.0 < seconds <= GRACE_SECONDS
        self.folder.write_progress(0.5, f"{self.folder.progress()[1]} and waited for")


Scripts = dict[str, list[tuple[float, str]]]  # of each run: how far it is and a note, poll by poll


class FakeBackend(Backend):
    def __init__(self, slots: int, scripts: Scripts) -> None:
        self.slots, self.scripts = slots, scripts
        self.jobs: dict[str, FakeJob] = {}
        self.most = 0

    def start(self, words: Sequence[str], folder: RunFolder) -> FakeJob:
        given = dict(zip(words[4::2], words[5::2], strict=True))
        assert (given["--cell"], given["--device"]) == (folder.id, "cuda")
        assert float(given["--wait"]) == GRACE_SECONDS  # what a killed harness left may be saving
        job = self.jobs[folder.id] = FakeJob(folder, iter(self.scripts[folder.id]))
        self.most = max(self.most, sum(job.code is None for job in self.jobs.values()))
        return job


RUNS = [{"methods": ["rrt_connect", "optimum"], "geometries": ["optimized", "initial"]}]


def fake_run(tmp_path: Path, slots: int, scripts: Scripts) -> tuple[Outcome, FakeBackend, str]:
    """The smoke preset's planners run by a fake backend; returns what a terminal shows.

    Between two looks at the runs no time passes, and each is drawn.
    """
    preset = smoke_preset("fake", runs=RUNS)
    store = Store.open(tmp_path, "fake", create=True)
    terminal = Console(file=io.StringIO(), force_terminal=True, width=400, color_system=None)
    backend = FakeBackend(slots, scripts)
    bars: list[Progress] = []

    def noted(*arguments: Any) -> Progress:
        bars.append(bar(*arguments))
        return bars[-1]

    clock = SimpleNamespace(sleep=lambda _: bars[0].refresh(), perf_counter=time.perf_counter)
    with mock.patch.multiple("benchmarks.runs.harness", bar=noted, time=clock):
        outcome = Harness(Insertion(preset), store, backend, terminal, "cuda").run()
    assert isinstance(terminal.file, io.StringIO)
    return outcome, backend, terminal.file.getvalue()


CELLS = [f"{m}-{g}-s0" for m in ("rrt_connect", "optimum") for g in ("optimized", "initial")]


def test_each_run_has_a_line_and_all_have_one_together(tmp_path: Path) -> None:
    scripts = {
        CELLS[0]: [(0.0, "waits")] * 2 + [(0.25, "success 3 %")] * 6 + [(1.0, "")],
        CELLS[1]: [(0.5, "success 9 %")] * 8 + [(1.0, "")],
        CELLS[2]: [(0.75, "")] * 3 + [(-1.0, "")],
        CELLS[3]: [(1.0, "")],
    }
    outcome, backend, text = fake_run(tmp_path, 2, scripts)
    assert backend.most == 2
    assert sorted(outcome.trained) == sorted([CELLS[0], CELLS[1], CELLS[3]])
    log = tmp_path / "fake" / "runs" / CELLS[2] / "checkpoint/log.txt"
    assert outcome.failed == {CELLS[2]: log}
    assert not outcome.interrupted
    assert re.search(rf"  {CELLS[0]} .* 25 % .*success 3 % on far", text)
    assert re.search(rf"  {CELLS[1]} .* 50 % .*success 9 % on far", text)
    assert re.search(r"all 4 runs .* 19 % .*2 wait", text)  # a quarter and a half of four
    assert re.search(rf"{CELLS[2]}: was killed by signal 1, .*, see .*log.txt", text)
    assert "the reason" in text
    assert "first line" not in text
    assert f"{CELLS[0]}: done in" in text
    assert re.search(rf"{CELLS[3]}: a checkpoint could not be read and is kept as .*broken-", text)


def test_a_run_that_was_damaged_ends_no_other(tmp_path: Path) -> None:
    scripts = {cell: [(0.5, ""), (1.0, "deleted" if cell == CELLS[0] else "")] for cell in CELLS}
    scripts[CELLS[1]] = [(-9.0, "no log")]
    outcome, _, text = fake_run(tmp_path, 1, scripts)
    assert sorted(outcome.failed) == sorted(CELLS[:2])
    assert sorted(outcome.trained) == sorted(CELLS[2:])
    assert "meta.json" in text


def test_a_harness_that_is_terminated_has_its_runs_save(tmp_path: Path) -> None:
    scripts, missed = (
        {CELLS[0]: [(0.5, "")] * 9, CELLS[1]: [(0.5, ""), (0.5, "ended")]},
        list[int](),
    )
    before = signal.signal(signal.SIGTERM, lambda number, _: missed.append(number))
    try:
        outcome, _, text = fake_run(tmp_path, 2, scripts)
        signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert missed == [signal.SIGTERM]  # the second, when the harness was done
    assert outcome.interrupted
    assert "Stopping: the runs save their checkpoints" in text
    store = Store.open(tmp_path, "fake")
    for cell in CELLS[:2]:
        assert store.run(cell).progress() == (0.5, "asked and waited for")
    assert not store.run(CELLS[2]).path.exists()


def test_a_harness_that_was_interrupted_writes_no_tables(tmp_path: Path) -> None:
    store, written = Store(tmp_path, "fake"), list[int]()
    for code, outcome in (
        (0, Outcome(trained=["a"], skipped=["b"])),
        (1, Outcome(trained=["a"], failed={"b": tmp_path})),
        (130, Outcome(trained=["a"], failed={"b": tmp_path}, interrupted=True)),
    ):
        console = Console(file=io.StringIO())
        assert outcome.close(store, console, lambda code=code: written.append(code)) == code  # type: ignore[misc]
    assert written == [0, 1]


def test_a_complete_run_is_left_alone_but_for_its_working_files(tmp_path: Path) -> None:
    one, store = Insertion(smoke_preset("fake", runs=RUNS)), Store.open(tmp_path, "fake", True)
    run = store.run(CELLS[3])  # of a process that was killed at its very end
    run.begin(one.settings(one.find(run.id)))
    run.write_meta({"training": {}})
    (run.checkpoint / "step-7").mkdir(parents=True)
    outcome, _, _ = fake_run(tmp_path, 4, {cell: [(1.0, "")] for cell in CELLS[:3]})
    assert (outcome.skipped, sorted(outcome.trained)) == ([CELLS[3]], sorted(CELLS[:3]))
    assert not run.checkpoint.exists()


def test_what_earlier_calls_have_done_counts_as_done(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "fake", create=True)
    for cell in CELLS[:2]:
        store.run(cell).write_progress(0.8, "")
    _, _, text = fake_run(tmp_path, 4, {cell: [(0.8, "")] * 4 + [(1.0, "")] for cell in CELLS})
    first: Any = re.search(r"all 4 runs .*?(\d+) %", text)
    assert int(first[1]) >= 40


def test_a_process_per_core_of_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Backend().slots == len(os.sched_getaffinity(0))
    assert Backend(3).slots == 3
    asked: dict[str, Any] = {}
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setenv("PYTHONPATH", "mine")
    monkeypatch.setattr(subprocess, "Popen", lambda words, **rest: asked.update(rest, words=words))
    Backend(1).start(["train", "--cell", "x"], RunFolder(tmp_path))
    for name in ("OMP", "MKL", "OPENBLAS", "NUMBA"):
        assert asked["env"][f"{name}_NUM_THREADS"] == "1"
    assert asked["env"]["PYTHONPATH"] == f"{ROOT}{os.pathsep}mine"
    words = f"-m benchmarks train --cell x --parent {os.getpid()}"
    assert asked["words"][1:] == words.split()


@pytest.mark.parametrize(("trap", "code"), [("exit 7", 7), ("", -signal.SIGKILL)])
def test_a_process_is_asked_to_end_and_killed_when_its_time_is_over(
    trap: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, run = tmp_path / "python", RunFolder(tmp_path)
    waits = "for i in $(seq 900); do sleep 0.1; done"
    lines = "#!/bin/sh", f"trap '{trap}' TERM", "echo odd >&2", "echo begun", waits
    program.write_text("\n".join(lines), encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    write_text(run.log, "before\n")
    job = Backend(1).start(["train"], run)
    wait_for(lambda: "begun\n" in run.log.read_text("utf-8"), run.log)
    assert run.log.read_text("utf-8") == "before\nodd\nbegun\n"
    assert os.getsid(job.process.pid) == job.process.pid  # the terminal's Ctrl-C is not for it
    job.stop()
    job.wait(PATIENCE if code > 0 else 0.5)
    assert job.poll() == code


def test_fewer_jobs_need_less_room(tmp_path: Path) -> None:
    track = {"hyperparameters": {"buffer_size": 10**9}}
    preset = smoke_preset("big", track=track, seeds=[*range(50)])
    store = Store.open(tmp_path, "big", create=True)
    needed = []
    for slots in (1, 2, 1000):
        with pytest.raises(BenchmarkError, match="make room") as caught:
            check_disk(Insertion(preset), store, expand(preset), slots)
        result: Any = re.search(r": ([\d,]+) MB may be needed \(runs: 250\)", str(caught.value))
        needed.append(int(result[1].replace(",", "")))
    # two checkpoints of 200 bytes for each of 1e9 transitions are 400 GB; 100 cells learn
    assert needed == [405_000, 805_000, 40_005_000]


def test_a_planner_that_is_asked_to_stop_stops(tmp_path: Path) -> None:
    preset = smoke_preset("plans", runs=[{"methods": ["optimum"]}])
    (cell,) = expand(preset)
    store = Store.open(tmp_path, "plans", create=True)
    assert not run_cell(Insertion(preset), cell, store, lambda: True)
    assert not store.run(cell.id).is_complete()
    assert store.run(cell.id).progress()[0] == 0.0
    assert run_cell(Insertion(preset), cell, store)
