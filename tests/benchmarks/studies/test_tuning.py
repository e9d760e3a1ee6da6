"""The search: the paper's grid and TPE, resumed after any end, and never on test episodes."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("optuna", reason="the extra 'tune' is not installed")

from rich.console import Console

from benchmarks.__main__ import main
from benchmarks.errors import BenchmarkError
from benchmarks.protocol import seeding
from benchmarks.protocol.presets import Track, as_dict, load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.runs.backends import Job
from benchmarks.runs.cell import opened, run_cell
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.harness import Harness, Outcome
from benchmarks.runs.store import RunFolder
from benchmarks.studies.tuning.study import GRID, PAPER, Configuration, Search
from benchmarks.studies.tuning.tune import FIRST_SEED, Tuning, results_table
from coop_env.env import CoopInsertionEnv

SEEDS, EPISODES = 2, 2


def tiny_track(steps: int = 96) -> Track:
    track = load_preset("smoke").tracks["safe"]
    small = dataclasses.replace(track.hyperparameters, learning_starts=32, net_arch=[16])
    return dataclasses.replace(track, timesteps=steps, hyperparameters=small)


class Ended:
    """A job that is over."""

    def __init__(self, log: Path, code: int) -> None:
        self.log, self.code = log, code

    def poll(self) -> int | None:
        return self.code

    def place(self) -> str | None:
        return ""

    def news(self) -> list[str]:
        return []

    def stop(self) -> None:
        pass

    def wait(self, seconds: float) -> None:
        pass


class Inline:
    """Runs each training in this process; interrupts or fails at the given starts."""

    slots = 1

    def __init__(self, interrupt_at: int | None = None, fail_at: int | None = None) -> None:
        self.interrupt_at, self.fail_at = interrupt_at, fail_at
        self.started: list[str] = []

    def describe(self) -> str:
        return "inline"

    def start(self, words: Sequence[str], folder: RunFolder) -> Job:
        experiment, store = opened(words[1], words[2], Path(words[3]))
        cell = experiment.find(words[words.index("--cell") + 1])
        assert cell.id == folder.id
        self.started.append(folder.id)
        if len(self.started) == self.interrupt_at:
            asked = iter([False, False, True])
            # cut off in its midst
            assert not run_cell(experiment, cell, store, lambda: next(asked, True))
            raise KeyboardInterrupt
        if len(self.started) == self.fail_at:
            return Ended(folder.path / "log.txt", 1)
        assert run_cell(experiment, cell, store)
        return Ended(folder.path / "log.txt", 0)

    def close(self) -> None:
        pass


def tuning(folder: Path, trials: int = 2) -> Tuning:
    track = as_dict(tiny_track())
    about = {"sampler": "grid", "seeds": SEEDS, "episodes": EPISODES, "track": track}
    RunFolder(folder).begin({"search": about})
    return Tuning(folder, Search(folder, "grid", trials))


def search(folder: Path, backend: Inline, trials: int = 2) -> Outcome:
    experiment = tuning(folder, trials)
    return Harness(experiment, experiment.store, backend, Console(quiet=True)).run()


def outcome(folder: Path) -> dict[str, bytes]:
    paths = sorted((folder / "runs").glob("*/validation.csv"))
    return {path.parent.name: path.read_bytes() for path in paths}


def test_the_grid_is_27_configurations_around_the_papers_choice() -> None:
    assert {name: len(values) for name, values in GRID.items()} == dict.fromkeys(GRID, 3)
    assert all(PAPER[name] == values[1] for name, values in GRID.items())


def test_the_grid_asks_each_configuration_once_however_often_it_is_cut_off(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    seen: list[Configuration] = []
    asked = True
    while asked:
        study = Search(tmp_path, "grid", None)  # a new process
        for frozen in study.begun():
            assert Configuration.of(frozen) in seen
            study.tell(frozen, 50.0)
        for _ in range(rng.integers(1, 6)):
            new = study.ask()
            asked = new is not None
            if new is None:
                break
            seen.append(Configuration.of(new))
            if rng.random() < 0.5:
                study.tell(new, float(rng.random()))
    study = Search(tmp_path, "grid", None)
    for frozen in study.begun():
        study.tell(frozen, 0.0)
    assert len(study.complete()) == len(seen) == len(set(seen)) == 27
    assert {(c.learning_rate, c.n_steps, c.batch_size) for c in seen} == {
        (a, n, b) for a in GRID["learning_rate"] for n in GRID["n_steps"]
        for b in GRID["batch_size"]
    }  # fmt: skip
    assert study.ask() is None
    assert sum(c.is_papers for c in seen) == 1


def score(configuration: Configuration) -> float:
    """Best at 1e-3, whatever the rest."""
    return 100.0 - 40.0 * abs(np.log10(configuration.learning_rate) + 3.0)


def test_tpe_goes_where_it_is_better_and_repeats_across_restarts(tmp_path: Path) -> None:
    def propose(folder: Path, restart: bool) -> list[Configuration]:
        folder.mkdir()
        study = Search(folder, "tpe", 24)
        found = []
        for _ in range(24):
            if restart:
                study = Search(folder, "tpe", 24)
            frozen = study.ask()
            assert frozen is not None
            found.append(Configuration.of(frozen))
            study.tell(frozen, score(found[-1]))
        assert study.ask() is None
        return found

    once = propose(tmp_path / "once", restart=False)
    assert propose(tmp_path / "again", restart=True) == once
    assert len(set(once[:8])) == 8
    scores = [score(configuration) for configuration in once]
    assert np.mean(scores[12:]) > np.mean(scores[:8]) + 5.0


def test_a_configuration_changes_what_it_names_and_nothing_else() -> None:
    track = tiny_track()
    changed = Configuration(3e-4, 5, 32).apply(track)
    h, old = changed.hyperparameters, track.hyperparameters
    assert (h.learning_rate, h.n_steps, h.batch_size) == (3e-4, 5, 32)
    ratio = old.learning_rate_end / old.learning_rate
    assert h.learning_rate_end / h.learning_rate == pytest.approx(ratio)
    back = {"learning_rate": old.learning_rate, "learning_rate_end": old.learning_rate_end,
            "n_steps": old.n_steps, "batch_size": old.batch_size}  # fmt: skip
    assert dataclasses.replace(h, **back) == old  # type: ignore[arg-type]


def test_a_configurations_name_says_all_of_it(tmp_path: Path) -> None:
    study = Search(tmp_path, "tpe", 8)
    while (frozen := study.ask()) is not None:
        configuration = Configuration.of(frozen)
        assert Configuration.parse(configuration.id) == configuration
    with pytest.raises(BenchmarkError, match="names no configuration"):
        Configuration.parse("lr0.1-b3")


def test_an_interrupted_search_ends_as_one_that_was_not(tmp_path: Path) -> None:
    assert search(tmp_path / "whole", Inline()).complete
    for moment in (1, 2, 3):
        folder = tmp_path / f"cut-{moment}"
        assert search(folder, Inline(interrupt_at=moment)).interrupted
        (run,) = [p for p in (folder / "runs").iterdir() if checkpoints(p / "checkpoint")]
        again = Inline()
        assert search(folder, again).complete
        assert again.started[0] == run.name  # what was under way comes first
        assert len(again.started) == 2 * SEEDS - (moment - 1)
        assert outcome(folder) == outcome(tmp_path / "whole")
        titles = [
            results_table(tuning(where).search, where, SEEDS, "T").texts()
            for where in (folder, tmp_path / "whole")
        ]
        assert titles[0] == titles[1]


def test_a_second_call_trains_nothing_and_more_trials_only_the_new(tmp_path: Path) -> None:
    assert search(tmp_path, Inline(), trials=1).complete
    backend = Inline()
    assert search(tmp_path, backend, trials=1).complete
    assert backend.started == []
    assert search(tmp_path, backend, trials=2).complete
    assert len(backend.started) == SEEDS


def test_a_training_that_fails_is_told_and_tried_again(tmp_path: Path) -> None:
    assert len(search(tmp_path, Inline(fail_at=1)).failed) == 1
    assert len(tuning(tmp_path).search.complete()) == 1
    backend = Inline()
    assert search(tmp_path, backend).complete
    assert len(backend.started) == 1
    assert len(tuning(tmp_path).search.complete()) == 2


def test_test_episodes_are_never_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forbidden = {seed for k in (*range(20), *range(1000, 1020)) for seed in episode_seeds(k, 500)}
    streams = {name: key for name, key in seeding._STREAMS.items() if name != "test"}
    monkeypatch.setattr(seeding, "_STREAMS", streams)
    with pytest.raises(KeyError):
        episode_seeds(0, 1)  # whatever asked for a test episode now would fail
    used: list[int] = []
    reset = CoopInsertionEnv.reset

    def spy(self: CoopInsertionEnv, **given: Any) -> Any:
        used.append(given["seed"])
        return reset(self, **given)

    monkeypatch.setattr(CoopInsertionEnv, "reset", spy)
    assert search(tmp_path, Inline(), trials=1).complete
    seeds = [FIRST_SEED + i for i in range(SEEDS)]
    expected = {x for seed in seeds for x in episode_seeds(seed, EPISODES, "validate")}
    # SB3 seeds the environments once more, by the learner's seed
    trained = {
        seeding.derive(stream, seed) + i
        for stream in ("train", "learner")
        for seed in seeds
        for i in range(64)
    }
    assert expected <= set(used) <= expected | trained
    assert not set(used) & forbidden
    stored = {
        int(seed)
        for path in (tmp_path / "runs").iterdir()
        for seed in RunFolder(path).rows("validation")["reset_seed"]
    }
    assert stored == expected


def test_the_seeds_of_the_search_are_those_of_no_preset() -> None:
    for name in ("paper", "quick", "smoke"):
        assert max(load_preset(name).seeds) < FIRST_SEED


def test_the_table_ranks_and_marks_the_papers_choice(tmp_path: Path) -> None:
    study = Search(tmp_path, "grid", None)
    rates = {}
    while (frozen := study.ask()) is not None:
        configuration = Configuration.of(frozen)
        solved = 4 if configuration.is_papers else configuration.n_steps % 4
        rates[configuration] = 25.0 * solved
        for seed in range(1000, 1000 + SEEDS):
            run = RunFolder(tmp_path / "runs" / f"{configuration.id}-s{seed}")
            rows = [{"success": int(i < solved), "holes": 1} for i in range(4)]
            run.write_rows("validation", rows)
            run.write_meta({"training": {"steps_to_75": None}})
        study.tell(frozen, rates[configuration])
    table = results_table(study, tmp_path, SEEDS, "T").texts()
    assert len(table) == 27
    assert table[0][:4] == ["0.0001", "3", "64", "100.0 ± 0.0"]
    assert [row[-1] for row in table] == ["the paper's choice"] + [""] * 26
    shown = [float(row[3].split()[0]) for row in table]
    assert shown == sorted(rates.values(), reverse=True)


def words(results: Path, *more: str) -> list[str]:
    return ["tune", "--preset", "smoke", "--results", str(results), *more]


def test_ctrl_c_saves_and_the_same_command_resumes(tmp_path: Path) -> None:
    given = words(tmp_path, "--steps", "100000000", "--seeds", "1", "--trials", "1", "--jobs", "1")
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks", *given],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    study = tmp_path / "tune" / "safe-grid"
    deadline = time.monotonic() + 120
    while not list(study.glob("runs/*/checkpoint/progress.json")):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=100)
    assert process.returncode == 130, out
    assert "the same command resumes" in out
    (run,) = (study / "runs").iterdir()
    assert checkpoints(run / "checkpoint")
    assert len(Search(study, "grid", 1).begun()) == 1


def test_bad_input_is_one_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def error_of(*more: str) -> str:
        assert main(words(tmp_path, *more)) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        return error

    assert "has no track 'printed'; known: safe" in error_of("--track", "printed")
    assert not (tmp_path / "tune").exists()
    folder = tmp_path / "tune" / "safe-grid"
    RunFolder(folder).begin({"search": {"sampler": "grid", "seeds": 3}})
    assert "holds a run with other settings" in error_of("--seeds", "2")
    with pytest.raises(SystemExit):
        main(words(tmp_path, "--trials", "0"))
    assert "0 is below 1" in capsys.readouterr().err


def test_a_search_has_one_harness(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    preset = load_preset("smoke")
    folder = RunFolder(tmp_path / "tune" / "safe-grid")
    track = dataclasses.replace(preset.tracks["safe"], timesteps=96)
    folder.begin(
        {"search": {"sampler": "grid", "seeds": 1, "episodes": 1, "track": as_dict(track)}}
    )
    with folder.lock():
        given = words(tmp_path, "--steps", "96", "--seeds", "1", "--episodes", "1")
        assert main(given) == 2
    assert "another process is at work" in capsys.readouterr().err
