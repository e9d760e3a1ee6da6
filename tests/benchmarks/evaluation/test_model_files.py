"""Models from files: what is stored here runs nothing, what a stranger saved asks for trust."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation import model_files
from benchmarks.evaluation.model_files import detect_algorithm, load_model, load_stored, set_weights
from benchmarks.protocol.learners import LEARNERS
from benchmarks.studies.robots.trials import inserter
from coop_env.env import CoopInsertionEnv
from sb3_rainbow import Rainbow
from tests.benchmarks.conftest import Command
from tests.process import ROOT
from tests.sb3_rainbow.zoo.crafted import CALL, rewritten, tampered

RESULTS = ROOT / "results"
POLICIES = sorted(RESULTS.glob("*/runs/rainbow-*-s0/policy.zip"))


def sampled(model: BaseAlgorithm, number: int) -> NDArray[np.float32]:
    """Random observations (number, size)."""
    size: Any = model.observation_space.shape
    return np.random.default_rng(0).random((number, *size), np.float32)


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.parent.name)
@pytest.mark.filterwarnings("ignore:The model was trained under action masks")
def test_a_stored_policy_acts_as_it_was_saved(path: Path) -> None:
    safe, saved = load_stored(path), Rainbow.load(path, device="cpu")
    rows = sampled(saved, 200)
    wanted, _ = saved.predict(rows, deterministic=True)
    np.testing.assert_array_equal(safe.predict(rows, deterministic=True)[0], wanted)
    assert len(set(wanted.tolist())) > 1
    assert safe.exploration_rate == saved.exploration_rate
    assert safe.observation_space == saved.observation_space


def test_a_runs_policy_is_of_the_runs_own_algorithm() -> None:
    assert detect_algorithm(POLICIES[0]) == "rainbow"
    with pytest.raises(BenchmarkError, match="is of a run of 'rainbow', not 'ppo'"):
        load_model(POLICIES[0], "ppo")


def test_a_learner_that_cannot_be_imported_spoils_no_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    own = {"mine": replace(LEARNERS["dqn"], where="nowhere:Mine")}
    monkeypatch.setattr(model_files, "LEARNERS", {**LEARNERS, **own})
    assert load_model(POLICIES[0]).num_timesteps >= 0
    path = tmp_path / "other.zip"
    path.write_bytes(b"")
    with pytest.raises(BenchmarkError, match="algorithm 'mine': 'nowhere:Mine' cannot be imported"):
        load_model(path, "mine", trust=True)


def test_the_stored_policy_with_contact_acts_as_it_was_saved() -> None:
    pytest.importorskip("mujoco")
    saved = SAC.load(RESULTS / "classic/contact/runs/standard-sac-s0/policy.zip", device="cpu")
    policy = inserter(RESULTS, "SAC", 0)
    rows = sampled(saved, 50)
    np.testing.assert_array_equal(policy(rows), saved.predict(rows, deterministic=True)[0])


def test_a_stored_run_names_no_module_of_its_own(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    run = "classic/contact/runs/standard-sac-s0"
    folder = shutil.copytree(RESULTS / run, tmp_path / run)
    config = folder / "config.yaml"
    text = config.read_text("utf-8").replace("coop_env:", "of_a_stranger:")
    config.write_text(text, encoding="utf-8")
    with pytest.raises(BenchmarkError, match="of_a_stranger:CoopInsertionContact-v0'"):
        inserter(tmp_path, "SAC", 0)


def test_a_policy_of_ones_own_machine_is_loaded(tmp_path: Path) -> None:
    path = Path(shutil.copy(POLICIES[0], tmp_path))
    text = POLICIES[0].with_name("config.yaml").read_text("utf-8")
    sizes = "{base_radius: 0.18, proximal_length: 0.1, platform_radius: 0.11}"
    own = text.replace("geometry: optimized", "geometry: mine") + f"dimensions: {sizes}\n"
    (tmp_path / "config.yaml").write_text(own, "utf-8")
    assert load_model(path).action_space == load_stored(POLICIES[0]).action_space


def test_a_policy_that_lacks_arrays_or_has_more_is_refused(tmp_path: Path) -> None:
    flat, deep = (
        DQN("MlpPolicy", CoopInsertionEnv(), policy_kwargs={"net_arch": layers}, device="cpu")
        for layers in ([8], [8, 8])
    )
    for model, other in ((flat, deep), (deep, flat)):
        other.save(tmp_path / "policy.zip")
        with pytest.raises(BenchmarkError, match="is of another network: they differ in"):
            set_weights(model, tmp_path / "policy.zip")


def test_what_a_stored_policy_pickles_stays_closed(here: Path) -> None:
    shutil.copy(POLICIES[0].with_name("config.yaml"), here)
    names = "anything", "observation_space", "policy_kwargs"
    path = tampered(POLICIES[0], here / "policy.zip", *names)
    assert load_model(path).observation_space == load_stored(POLICIES[0]).observation_space
    assert not Path("called").exists()


def test_a_strangers_model_asks_for_trust(here: Path, refused: Command) -> None:
    shutil.copy(POLICIES[0].with_name("config.yaml"), here)  # of another file
    path = tampered(POLICIES[0], here / "my.zip", "anything")
    error = refused("evaluate", "--preset", "smoke", "--model", path, "--episodes", "1")
    assert "runs its author's code when it is loaded; add --trust" in error
    assert not Path("called").exists()


def holding(content: bytes, part: str) -> Callable[[str, bytes], bytes]:
    """What makes a file's part this one, for ``rewritten``."""
    return lambda name, old: content if name == part else old


@pytest.mark.parametrize("name", ["data", "policy.pth"])
def test_a_damaged_model_is_one_error(tmp_path: Path, name: str) -> None:
    Rainbow("MlpPolicy", CoopInsertionEnv(), buffer_size=100, device="cpu").save(tmp_path / "m")
    for content in (b"", CALL):  # which torch refuses to unpickle
        damaged = rewritten(tmp_path / "m.zip", tmp_path / "policy.zip", holding(content, name))
        with pytest.raises(BenchmarkError, match="is no model of 'rainbow'"):
            load_model(damaged, "rainbow", trust=True)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")  # torch's
def test_a_pickle_in_a_stored_policy_is_one_error_without_torchs_advice(tmp_path: Path) -> None:
    shutil.copy(POLICIES[0].with_name("config.yaml"), tmp_path)
    path = rewritten(POLICIES[0], tmp_path / "policy.zip", holding(CALL, "policy.pth"))
    with pytest.raises(BenchmarkError, match=r"policy.zip holds .* nothing of it was run$"):
        load_model(path)


def test_a_policy_beside_other_settings_is_one_error(tmp_path: Path) -> None:
    shutil.copy(POLICIES[0], tmp_path / "policy.zip")
    text = POLICIES[0].with_name("config.yaml").read_text("utf-8")
    for old, new in (
        *(("ablation: full", "ablation: none"), ("- 128", "- 127"), ("alpha: 0.6", "alpha: much")),
        *(("cell:", "cells:"), ("method: rainbow", "method: {}")),
    ):
        (tmp_path / "config.yaml").write_text(text.replace(old, new), "utf-8")
        with pytest.raises(BenchmarkError):
            load_model(tmp_path / "policy.zip")
    with pytest.raises(BenchmarkError, match="was not trained on the insertion of"):
        load_model(RESULTS / "classic/contact/runs/standard-sac-s0/policy.zip")


def test_a_packaged_model_needs_no_trust(tmp_path: Path) -> None:
    model_file = pytest.importorskip("sb3_rainbow.zoo.model_file")
    env = CoopInsertionEnv()
    model = Rainbow("MlpPolicy", env, buffer_size=100, device="cpu")
    model_file.write_model(model, tmp_path / "mine.zip")
    observation, _ = env.reset(seed=0)
    wanted = model.predict(observation, deterministic=True)[0]
    assert load_model(tmp_path / "mine.zip").predict(observation, deterministic=True)[0] == wanted
