"""Datasets of the task: what is in them is what the environment does; they come whole or not."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.cli import main as command
from benchmarks.protocol.seeding import derive
from benchmarks.studies import data
from tests.benchmarks.conftest import Command
from tests.process import ROOT

minari = pytest.importorskip("minari", reason="Minari is not installed (extra data)")
pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
STEPS = 150
NAMES = [recipe.name for contact in (False, True) for recipe in data.recipes(STEPS, contact)]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All datasets, of a few steps each; from the folder above, as a relative path."""
    folder = tmp_path_factory.mktemp("work")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        words = ["study", "data", "--steps", str(STEPS), "--results", "results"]
        assert command(words) == command([*words, "--contact"]) == 0
    records = json.loads((folder / "results/data/data.json").read_text("utf-8"))
    assert [r["id"] for r in records] == [f"coop-insertion/{name}-v0" for name in NAMES]
    return folder / "results"


@pytest.mark.parametrize("name", NAMES)
def test_the_environment_does_what_a_dataset_says(name: str, results: Path) -> None:
    """Each episode is played again from its seed by its actions, in the recovered environment."""
    with data.minari_root(results / "data"):
        dataset = minari.load_dataset(f"coop-insertion/{name}-v0")
    assert dataset.total_steps >= STEPS
    env, contact = dataset.recover_environment(), name in data.CONTACT
    seeds = [m["seed"] for m in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    assert seeds[0] == derive("data", 0)
    for seed, episode in zip(seeds, dataset, strict=True):
        observation, info = env.reset(seed=int(seed))
        over = episode.terminations | episode.truncations
        assert over[-1]
        assert not over[:-1].any()
        for t in range(len(over) + 1):
            np.testing.assert_array_equal(observation, episode.observations[t])
            if not contact:
                info["action_masks"] = env.unwrapped.action_masks()
            for key, values in episode.infos.items():
                np.testing.assert_array_equal(info[key], values[t])
            if t == len(over):
                break
            action = episode.actions[t]
            assert contact or info["action_masks"][action]
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == pytest.approx(episode.rewards[t])
            assert terminated == episode.terminations[t]
            if contact or truncated:  # one that a behaviour gave up is truncated before
                assert truncated == episode.truncations[t]
    if name.startswith("optimum"):
        assert all(episode.infos["n_filled"][-1] > 0 for episode in dataset)


def test_what_is_there_is_kept_and_what_is_missing_made(results: Path, tmp_path: Path) -> None:
    again = tmp_path / "results"
    shutil.copytree(results, again)
    root = again / "data" / "coop-insertion"
    shutil.rmtree(root / "random-v0")
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*.hdf5")}
    assert command(["study", "data", "--results", str(again), "--steps", str(STEPS)]) == 0
    after = {path: path.stat().st_mtime_ns for path in root.rglob("*.hdf5")}
    assert before.items() < after.items()
    assert {path.parts[-3] for path in after.keys() - before.keys()} == {"random-v0"}
    assert (again / "data/data.json").read_text() == (results / "data/data.json").read_text()
    assert not list((again / "data").glob(".*"))  # nothing half done is left


def test_a_dataset_of_another_recipe_is_refused(results: Path, refused: Command) -> None:
    words = ("study", "data", "--results", str(results), "--steps", "7")
    assert "optimum-small-v0 was made by" in refused(*words)


def test_starts_without_a_move_count_as_failures() -> None:
    idle, done = (minari.data_collector.EpisodeBuffer(rewards=r) for r in ([], 29 * [0.0] + [20.0]))
    result = data.measure([(idle, 0), (done, 1)])
    assert (result["starts"], result["episodes"], result["steps"]) == (2, 1, 30)
    assert (result["success"], result["holes"], result["return"]) == (0.5, 0.5, 10.0)


def test_the_dataset_in_git_is_the_one_of_the_table() -> None:
    (small, *_) = data.recipes(100_000)
    stored = json.loads((ROOT / "results/data/data.json").read_text("utf-8"))
    result: Any = data.read(ROOT / "results" / "data", small)
    assert result == pytest.approx(stored[0])
    assert result["megabytes"] < 1.0
