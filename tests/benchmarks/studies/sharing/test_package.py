"""Stored policies become packages that the hub's loader reads, and say where they come from."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

import coop_env  # noqa: F401 - registers the task
from benchmarks.__main__ import main
from benchmarks.evaluation.model_files import load_model
from benchmarks.runs.store import RunFolder
from sb3_rainbow import Rainbow

pytest.importorskip("rl_zoo3", reason="rl_zoo3 is not installed (extra zoo)")
CELL = "rainbow-optimized-safe-s0"
MODEL = "rainbow-CoopInsertion-v0.zip"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with the tiny preset's run of Rainbow."""
    folder = tmp_path_factory.mktemp("results")
    assert main(["train", "--preset", "smoke", "--cell", CELL, "--results", str(folder)]) == 0
    return folder


@pytest.fixture
def results(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(trained, tmp_path / "results"))


def package(results: Path) -> int:
    words = ["--preset", "smoke", "--results", str(results), "--episodes", "1"]
    return main(["package", *words])


def test_a_package_holds_the_policy_and_says_what_it_is(results: Path) -> None:
    from huggingface_hub import ModelCard

    assert package(results) == 0
    folder = Path("hub/smoke") / CELL
    assert {path.name for path in folder.iterdir()} == {
        *(MODEL, "README.md", "results.json", "config.yaml", "env_kwargs.yml")
    }
    run = RunFolder(results / "smoke" / "runs" / CELL)
    stored, packed = Rainbow.load(run.policy, buffer_size=1), load_model(folder / MODEL)
    arguments = yaml.safe_load((folder / "env_kwargs.yml").read_text("utf-8"))
    assert arguments["mask_singularities"] is True
    env = gymnasium.make("CoopInsertion-v0", **arguments)
    seen = np.stack([env.reset(seed=seed)[0] for seed in range(30)])
    same = [model.predict(seen, deterministic=True)[0] for model in (stored, packed)]
    np.testing.assert_array_equal(same[0], same[1])
    text = ModelCard.load(folder / "README.md").text
    rows = run.rows("episodes").query("noise == 0 and masks == 'own'")
    for part in (
        f"python -m benchmarks train --preset smoke --cell {CELL}",
        f"{100 * rows['success'].mean():.1f} % and fills {rows['holes'].mean():.2f} of 6 holes",
        f"at commit {run.meta()['commit'][:9]}, with python 3.",
        "not to be trained on",
    ):
        assert part in text
    assert yaml.safe_load((folder / "config.yaml").read_text("utf-8")) == run.config()


def test_a_policy_that_is_not_the_runs_is_refused(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFolder(results / "smoke" / "runs" / CELL)
    with zipfile.ZipFile(run.policy, "a") as archive:
        archive.writestr("more", "")
    assert package(results) == 2
    assert "is not the policy that its meta.json is about" in capsys.readouterr().err
    assert not (Path("hub/smoke") / CELL).exists()


def test_without_a_policy_the_command_that_makes_one_is_named(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (results / "smoke" / "runs" / CELL / "policy.zip").unlink()
    assert package(results) == 2
    assert "run: python -m benchmarks run --preset smoke" in capsys.readouterr().err
