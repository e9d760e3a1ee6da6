"""Teams through the harness in seconds: each form learns, is tested, has its row, and agrees."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.cli import main
from benchmarks.protocol.plan import expand, settings
from benchmarks.protocol.presets import load_preset
from benchmarks.reporting.results import Results
from benchmarks.runs.policy_file import digest
from benchmarks.runs.store import Store
from benchmarks.runs.training import train
from tests.benchmarks.runs.warm import Server
from tests.benchmarks.smoke import preset_file, stop_after

SMALL = {
    **{"n_envs": 4, "batch_size": 16, "buffer_size": 1000, "learning_starts": 100},
    **{"updates_per_step": 0.25, "net_arch": [16], "n_atoms": 5},
}
TRACKS = ("in_turn", "central", "vdn", "shared_sight", "independent")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, warm: Server) -> Path:
    folder = tmp_path_factory.mktemp("team")
    preset = {
        "description": "teams in seconds",
        "seeds": [0],
        "evaluation": {"episodes": 2, "noise": [0.0]},
        "tracks": {t: {"timesteps": 240, "hyperparameters": SMALL} for t in TRACKS},
        "runs": [
            {"methods": ["rainbow"], "tracks": list(TRACKS)},
            {"methods": ["rainbow"], "tracks": ["vdn"], "ablations": ["double_dueling"]},
            {"methods": ["random", "greedy"], "tracks": ["central", "independent"]},
            {"methods": ["optimum", "optimum_at_once"]},
        ],
    }
    preset_file(folder, preset, "tiny")
    with warm.children():
        assert main(["run", *_words(folder), "--jobs", "1"]) == 0
    return folder


def _words(folder: Path) -> list[str]:
    return ["--preset", str(folder / "tiny.yaml"), "--results", str(folder)]


def test_all_began_alike_and_verify_agrees(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = Results(Store.open(results, "tiny")).all()
    assert len(runs) == 12
    assert len({tuple(run.test()["start"]) for run in runs}) == 1
    assert main(["tables", *_words(results)]) == 0
    assert main(["verify", *_words(results)]) == 0, capsys.readouterr().err
    assert main(["run", *_words(results)]) == 0
    assert "12 runs were complete already" in capsys.readouterr().out


@pytest.mark.parametrize("track", ["vdn", "shared_sight", "independent"])
def test_a_team_that_was_stopped_goes_on_as_if_never(
    results: Path, tmp_path: Path, track: str
) -> None:
    preset = load_preset(str(results / "tiny.yaml"))
    (cell,) = [c for c in expand(preset) if (c.track, c.method) == (track, "rainbow")][-1:]
    result = []
    for name in ("whole", "stopped"):
        folder = Store.open(tmp_path, name, create=True).run(cell.id)
        folder.begin(settings(preset, cell))
        trained = train(preset, cell, folder, stop_after(30 if name == "stopped" else 10_000))
        assert (trained is None) == (name == "stopped")
        trained = trained or train(preset, cell, folder)
        assert trained is not None
        assert bool(trained[1]["resumed_at"]) == (name == "stopped")
        result.append(digest(trained[0]))
    assert result[0] == result[1]
