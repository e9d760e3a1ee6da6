"""The whole chain through the ``smoke`` preset: five methods, tables, skipping, bad input."""

import contextlib
import errno
import importlib
import io
import shutil
from pathlib import Path
from unittest import mock

import pandas as pd
import pytest

from benchmarks.cli import main
from benchmarks.protocol.presets import PRESETS
from benchmarks.reporting.results import Results
from benchmarks.runs.store import SCHEMA, Store
from tests.benchmarks.conftest import Command
from tests.benchmarks.runs.warm import children
from tests.benchmarks.smoke import SMALL, preset_file, smoke_file

RUNS = {f"{method}-optimized-safe-s0" for method in ("rainbow", "dqn", "greedy")}
RUNS |= {f"{planner}-optimized-s0" for planner in ("rrt_connect", "optimum")}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, warm: None) -> Path:
    folder, out = tmp_path_factory.mktemp("results"), io.StringIO()
    with children(), contextlib.redirect_stdout(out):
        assert main(["run", "--preset", "smoke", "--results", str(folder), "--jobs", "2"]) == 0
    for title in ("Performance, safe", "Tables (CSV, Markdown, LaTeX)"):
        assert title in out.getvalue()
    # no run of this preset is of the other geometry, or lacks a component
    for title in ("design stage", "one component removed"):
        assert title not in out.getvalue()
    return folder


@pytest.fixture
def copied(results: Path, tmp_path: Path) -> list[str]:
    """Arguments for a copy of the results, which the test may change."""
    shutil.copytree(results / "smoke", tmp_path / "smoke")
    return ["--preset", "smoke", "--results", str(tmp_path)]


def test_all_methods_ran_and_say_how_tensorboard_too(results: Path) -> None:
    store = Store.open(results, "smoke")
    runs = {run.id: run for run in store.completed()}
    assert set(runs) == RUNS
    assert (store.figures / "safe_success.png").is_file()
    for run in runs.values():
        meta = run.meta()
        assert meta["schema"] == SCHEMA
        assert meta["wall_seconds"] > 0 < meta["cpu_seconds"]
        assert {"commit", "dirty", "versions", "machine", "seeds"} <= set(meta)
        assert not run.checkpoint.exists()
    for name in ("rainbow-optimized-safe-s0", "dqn-optimized-safe-s0"):
        assert runs[name].policy.is_file()
        assert runs[name].meta()["training"]["timesteps"] == 480
        assert runs[name].rows("curve")["timesteps"].is_monotonic_increasing
    module = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    events = module.EventAccumulator(str(runs["rainbow-optimized-safe-s0"].tensorboard))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    # no episode of 300 moves need end within so few steps: what counts episodes may be missing
    always = {"learning_rate", "noise", "mean_max_q", "loss", "stage"}
    assert {f"paper/{name}" for name in always} <= tags


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_second_call_trains_nothing_and_verify_agrees(results: Path, done: Command) -> None:
    place, before = ["--preset", "smoke", "--results", str(results)], contents(results)
    assert "5 runs were complete already" in done("run", *place)
    assert contents(results) == before  # a run that was made again would say how long it took
    done("verify", *place)


def test_a_stored_policy_is_scored(results: Path, done: Command) -> None:
    policy = results / "smoke" / "runs" / "dqn-optimized-safe-s0" / "policy.zip"
    words = ["--model", policy, "--algorithm", "dqn", "--episodes", "1"]
    out = done("evaluate", "--preset", "smoke", "--results", results, *words)
    stored = pd.read_csv(policy.parent / "episodes.csv")
    first = stored[(stored["episode"] == 0) & (stored["noise"] == 0.0)].iloc[0]
    assert f"Success rate (%) {100.0 * first['success']:.1f}" in out


@pytest.mark.usefixtures("forked")
def test_what_is_stored_comes_out_again_and_what_has_no_policy_is_left_out(
    results: Path, copied: list[str], tmp_path: Path, done: Command, refused: Command
) -> None:
    runs, files = tmp_path / "smoke" / "runs", contents(tmp_path / "smoke")
    assert "Runs whose every episode came out as stored: 5 of 5" in done("evaluate", *copied)
    assert contents(tmp_path / "smoke") == files
    # one run is changed, of one the policy is gone, one is not there
    rows = runs / "rainbow-optimized-safe-s0" / "episodes.csv"
    first = pd.read_csv(rows)
    first.assign(holes=first["holes"] + 1).to_csv(rows, index=False)
    (runs / "dqn-optimized-safe-s0" / "policy.zip").unlink()
    planned = "rrt_connect-optimized-s0"
    shutil.rmtree(runs / planned)
    out = done("evaluate", *copied)
    assert "Left out, their policy is not here: 1 runs" in out
    assert "Left out, not run yet: 1 runs" in out
    assert "Runs whose every episode came out as stored: 2 of 3" in out
    again = tmp_path / "again" / "test" / "smoke" / "runs" / rows.parent.name
    pd.testing.assert_frame_equal(pd.read_csv(again / "episodes.csv"), first)
    # and what is complete without its policy is not run again
    shutil.copytree(results / "smoke" / "runs" / planned, runs / planned)
    rows.write_bytes(files[rows])
    assert "5 runs were complete already" in done("run", *copied)
    (rows.parent / "policy.zip").unlink()
    assert "has nothing to score: the policies of 2 complete runs" in refused("evaluate", *copied)


def test_runs_of_other_settings_are_neither_played_nor_made_again(
    copied: list[str], tmp_path: Path, refused: Command
) -> None:
    (tmp_path / "smoke").rename(tmp_path / "mine")
    changed = smoke_file(tmp_path, "mine", track={"mask_visited": 8})
    for command in (["evaluate"], ["study", "failures"], ["run"]):
        words = [*command, *copied, "--preset", str(changed)]
        assert "track.mask_visited: 0 -> 8" in refused(*words)


@pytest.mark.usefixtures("warm")  # compiling kernels would report itself on stderr too
def test_a_full_disk_is_one_error(tmp_path: Path, refused: Command) -> None:
    full = OSError(errno.ENOSPC, "No space left on device", "episodes.csv")
    words = ["--preset", "smoke", "--results", str(tmp_path), "--cell", "rrt_connect-optimized-s0"]
    with mock.patch("benchmarks.runs.store.RunFolder.write_rows", side_effect=full):
        assert "No space left on device: episodes.csv; make room" in refused("train", *words)


@pytest.mark.usefixtures("forked")
def test_other_starts_are_their_own(copied: list[str], tmp_path: Path, done: Command) -> None:
    seen: list[set[str]] = []
    for starts in ("1", "2"):
        out = done("evaluate", *copied, "--episodes", "3", "--starts", starts)
        assert "Success (%) of the played runs" in out
        folder = tmp_path / "again" / f"starts-{starts}" / "smoke" / "runs"
        runs = [pd.read_csv(path) for path in sorted(folder.glob("*/episodes.csv"))]
        assert len(runs) == 5
        result = [set(rows.loc[rows["noise"] == 0.0, "start"].astype(str)) for rows in runs]
        assert all(starts == result[0] for starts in result)  # the same for every method
        seen.append(result[0])
    stored = pd.read_csv(tmp_path / "smoke" / "runs" / "optimum-optimized-s0" / "episodes.csv")
    assert not seen[0] & seen[1]
    assert not (seen[0] | seen[1]) & set(stored["start"].astype(str))


@pytest.mark.usefixtures("warm")  # compiling kernels would report itself on stderr too
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--preset", "fast"], "unknown preset 'fast'"),
        (["run", "--preset", "none.yaml"], "preset 'none.yaml': there is no such file"),
        (["run", "--preset", "smoke", "--results", "x" * 300], "name another place"),
        (["train", "--preset", "smoke", "--cell", "ppo-s0"], "nearest: dqn-optimized-safe-s0"),
        (["study", "light"], "unknown study 'light'; known: audit, codesign"),
        (["evaluate", "--preset", "smoke", "--name", "x"], "--name belongs to a --model"),
        (["evaluate", "--preset", "smoke", "--model", "no.zip"], "no.zip is missing"),
        (["tables", "--preset", "tiny"], "has no results; run: python -m benchmarks run --preset"),
        (["train", "--preset", "tiny", "--cell", "x"], "has no cell 'x'"),
        (["study", "media", "--model", "nowhere.zip"], "nowhere.zip is missing"),
        (["study", "media", "--model", __file__], "is no model of Stable-Baselines3"),
        (["watch", "--port", "0"], "port 0"),
        (["verify", "--results", "."], "has no results"),
        (["report", "--results", "."], "has no results"),
        (["evaluate", "--preset", "control"], "'control' is of public tasks"),
        (["run", "--preset", "control", "--device", "cuda"], "public tasks run on the CPU"),
        (["run", "--preset", "smoke", "--device", "cuda"], "PyTorch finds no GPU here"),
        (["run", "--preset", "smoke", "--results", __file__], "name another place"),
        (["evaluate", "--planner", "astar"], "known: optimum, or module:function"),
        (["evaluate", "--planner", "optimum", "--name", "optimum"], "choose another --name than"),
        (["evaluate", "--planner", "optimum", "--mask-visited", "65"], "visited 65: at most 64"),
        (["study", "trajectory", "--start", "1"], "--start and --blend belong to --export"),
    ],
)
def test_bad_input_is_one_error_and_writes_nothing(
    words: list[str], message: str, here: Path, monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert message in refused(*words)
    assert [path.name for path in here.rglob("*") if path.is_file()] in ([], ["store.json"])


def test_an_interrupt_that_meets_a_kernel_is_an_interrupt(here: Path) -> None:
    def print_plan(*_: object) -> None:
        raise SystemError("returned a result with an exception set") from cause

    with mock.patch("benchmarks.cli.print_plan", print_plan):
        cause: BaseException = KeyboardInterrupt()
        assert main(["plan", "--preset", "smoke"]) == 130
        cause = ValueError()
        with pytest.raises(SystemError):
            main(["plan", "--preset", "smoke"])


def test_advice_names_a_preset_of_ones_own_by_its_path(here: Path, refused: Command) -> None:
    own = here / "mine.yaml"
    shutil.copy(PRESETS / "tiny.yaml", own)
    assert f"benchmarks run --preset {own}\n" in refused("tables", "--preset", str(own))


@pytest.mark.slow
@pytest.mark.usefixtures("forked")
def test_teams_begin_alike_and_verify_agrees(tmp_path: Path, done: Command) -> None:
    tracks = ["in_turn", "central", "vdn", "shared_sight", "independent"]
    preset = {
        "description": "teams in seconds",
        "seeds": [0],
        "evaluation": {"episodes": 2, "noise": [0.0]},
        "tracks": {t: {"timesteps": 120, "hyperparameters": SMALL} for t in tracks},
        "runs": [
            {"methods": ["rainbow"], "tracks": tracks},
            {"methods": ["rainbow"], "tracks": ["vdn"], "ablations": ["double_dueling"]},
            {"methods": ["random", "greedy"], "tracks": ["central", "independent"]},
            {"methods": ["optimum", "optimum_at_once"]},
        ],
    }
    words = ["--preset", str(preset_file(tmp_path, preset, "mine")), "--results", str(tmp_path)]
    done("run", *words, "--jobs", "1")
    runs = Results(Store.open(tmp_path, "mine")).all()
    assert len(runs) == 12
    assert len({tuple(run.test()["start"]) for run in runs}) == 1
    done("verify", *words)
