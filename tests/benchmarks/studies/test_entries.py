"""Bring your own method: any SB3 model or planner joins the leaderboard with one command."""

import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import sb3_contrib
import stable_baselines3
from gymnasium import spaces

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError, resolve
from benchmarks.evaluation.evaluate import (
    Condition,
    begin_episodes,
    by_policy,
    follow,
    model_policy,
    play,
)
from benchmarks.evaluation.model_files import algorithms, detect_algorithm
from benchmarks.protocol.presets import load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.verify import check_runs
from benchmarks.runs.store import Store
from benchmarks.studies.base import _as_json
from benchmarks.studies.scoring import entries
from benchmarks.studies.scoring.entries import checked
from coop_env.env import CoopInsertionEnv
from tests.benchmarks import fabricated_store
from tests.benchmarks.conftest import Command
from tests.benchmarks.smoke import smoke_file
from tests.process import ROOT

SETTINGS: dict[str, dict[str, Any]] = {
    **{"a2c": {}},
    **{name: {"n_steps": 16, "batch_size": 16} for name in ("ppo", "trpo", "maskable_ppo")},
    **{name: {"buffer_size": 200, "learning_starts": 10} for name in ("dqn", "qrdqn", "rainbow")},
}
CLASSES: dict[str, Any] = {name: resolve(where, "") for name, where in algorithms().items()}
Train = Callable[..., Path]


def make_env(**arguments: Any) -> CoopInsertionEnv:
    return CoopInsertionEnv(reward="progress", max_moves=20, **arguments)


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Train:
    """A model trained for a few steps, saved; each once."""
    folder = tmp_path_factory.mktemp("models")

    def made(name: str, seed: int = 0, **arguments: Any) -> Path:
        path = folder / f"{name}-{seed}-{'-'.join(arguments)}.zip"
        if not path.exists():
            settings = SETTINGS[name] | {"policy_kwargs": {"net_arch": [16]}, "seed": seed}
            model = CLASSES[name]("MlpPolicy", make_env(**arguments), device="cpu", **settings)
            model.learn(32).save(path)
        return path

    return made


def board(results: Path) -> pd.DataFrame:
    path = Store.open(results, "smoke").tables / "leaderboard.csv"
    return pd.read_csv(path, dtype=str).set_index("Method")


def command(results: Path, *words: str | Path) -> list[str | Path]:
    trust = ["--trust"] if "--model" in words else []
    return ["evaluate", "--preset", "smoke", "--results", results, *words, *trust]


@pytest.mark.parametrize("name", ["ppo", "maskable_ppo"])
def test_a_model_joins_the_board(name: str, train: Train, tmp_path: Path, done: Command) -> None:
    path = train(name)
    out = done(*command(tmp_path, "--model", path, "--name", f"my-{name}"))
    assert f"my-{name}" in out
    assert "leaderboard.md" in out
    row = board(tmp_path).loc[f"my-{name}"]
    assert row["Rank"] == "1"
    assert row["Masks"] == ("paper's" if name == "maskable_ppo" else "none")
    assert f"Brought: my-{name} ({name}, models: 1)." in out
    store = Store.open(tmp_path, "smoke")
    (entry,) = store.entered()
    assert entry.config()["entry"]["observation"] == "paper"
    rows = entry.rows("episodes")
    # the protocol: test seeds, all levels of noise, six holes to the end, the model's own actions
    assert rows["reset_seed"].unique().tolist() == episode_seeds(0, 2, "validate")
    assert rows["noise"].unique().tolist() == [0.0, 0.01]
    player = by_policy(model_policy(CLASSES[name].load(path, device="cpu")), 0)
    expected = play(player, load_preset("smoke"), 0, [Condition({"reward": "progress"}, 0.01)])
    noisy = rows[rows["noise"] == 0.01]
    assert noisy["moves"].tolist() == [row["moves"] for row in expected]
    assert noisy["energy"].tolist() == pytest.approx([row["energy"] for row in expected], rel=1e-6)
    assert check_runs(store) == []
    done("verify", "--preset", "smoke", "--results", str(tmp_path))


def test_masks_go_to_who_knows_them(train: Train) -> None:
    observations = np.full((1, 12), 0.5, dtype=np.float32)
    for name in ("maskable_ppo", "rainbow"):
        act = model_policy(CLASSES[name].load(train(name), device="cpu"))
        for forced in (3, 8):
            assert act(observations, np.arange(12)[None] == forced).tolist() == [forced]
    act = model_policy(stable_baselines3.PPO.load(train("ppo"), device="cpu"))
    none = np.zeros((1, 12), dtype=np.bool_)
    assert act(observations, none).tolist() == act(observations, ~none).tolist()


@pytest.mark.parametrize("name", ["dqn", "qrdqn"])
def test_episodes_explore_each_for_itself(name: str, train: Train) -> None:
    model = CLASSES[name].load(train(name), device="cpu")
    model.exploration_rate = 0.5
    masks = np.ones((100, 12), dtype=np.bool_)
    observations = np.full((100, 12), 0.5, dtype=np.float32)
    (greedy,) = set(model_policy(model)(observations, masks).tolist())
    for _ in range(3):
        acted = model_policy(model, deterministic=False)(observations, masks)
        assert 20 < np.sum(acted != greedy) < 75


@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_the_algorithm_is_read_from_the_file(name: str, train: Train) -> None:
    assert detect_algorithm(train(name)) == name


def test_one_model_per_seed_and_a_second_call_scores_nothing(
    train: Train, tmp_path: Path, done: Command, refused: Command
) -> None:
    preset = smoke_file(tmp_path, "two", seeds=[3, 4], evaluation={"episodes": 1, "noise": [0.0]})
    files = [str(train("ppo", 0)), str(train("ppo", 1))]
    words = ["evaluate", "--preset", str(preset), "--results", str(tmp_path), "--name", "two"]
    words.append("--trust")
    done(*words, "--model", *files)
    store = Store.open(tmp_path, "two")
    assert [entry.id for entry in store.entered()] == ["two-optimized-s3", "two-optimized-s4"]
    assert len({entry.config()["entry"]["sha256"] for entry in store.entered()}) == 2
    before = [(entry.path / "meta.json").read_bytes() for entry in store.entered()]
    assert "2 of 2 seeds were scored already" in done(*words, "--model", *files)
    assert [(entry.path / "meta.json").read_bytes() for entry in store.entered()] == before
    # another model under the same name: refused, until it is said
    assert "choose another --name, or --replace it" in refused(*words, "--model", files[1])
    second: Any = {"wraps": entries._score, "side_effect": [mock.DEFAULT, MemoryError]}
    with mock.patch.object(entries, "_score", **second), pytest.raises(MemoryError):
        main([*words, "--model", files[1], "--replace"])
    assert [(entry.path / "meta.json").read_bytes() for entry in store.entered()] == before
    done(*words, "--model", files[1], "--replace")
    assert not (store.folder / "replacing").exists()
    assert "models: 1)" in (store.tables / "leaderboard.md").read_text(encoding="utf-8")
    assert "3 models for 2 seeds" in refused(*words, "--model", *files, files[0])


def test_another_observation_is_found_out(train: Train, tmp_path: Path, done: Command) -> None:
    path = train("dqn", observation="markov")
    done(*command(tmp_path, "--model", path, "--mask-singularities"))
    (entry,) = Store.open(tmp_path, "smoke").entered()
    assert entry.config()["entry"]["observation"] == "markov"
    assert entry.config()["entry"]["mask_singularities"] is True
    assert path.stem in board(tmp_path).index


def test_a_glance_stores_nothing(train: Train, tmp_path: Path, done: Command) -> None:
    out = done(*command(tmp_path, "--model", train("ppo"), "--episodes", "1"))
    assert "seed 0, noise 0.01: Success rate (%)" in out
    assert "Avg. completion time (s) -; " in out
    assert "Nothing was stored" in out
    assert list(tmp_path.iterdir()) == []


PLANNER = """
from benchmarks.methods.oracle import LatticeOracle

oracle = LatticeOracle()


def plan(env):
    return oracle.plan(env)


def moves(env):
    answer = oracle.plan(env)
    return answer.moves.tolist() if answer.moves is not None else []


def masks(env):
    return f"{env.params.task.mask_singularities} {env.params.task.visited}"


def nothing(env):
    return []


def cheat(env):
    env.step(int(env.action_masks().argmax()))
    return [0]


def nonsense(env):
    return [12]
"""


@pytest.fixture
def planners(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (here / "my_planner.py").write_text(PLANNER, encoding="utf-8")
    monkeypatch.delitem(sys.modules, "my_planner", raising=False)  # another test's
    return here


@pytest.mark.slow
def test_a_planner_joins_too_and_equals_the_harness_s_own(planners: Path, done: Command) -> None:
    given = {"mine": "my_planner:moves", "mine-plan": "my_planner:plan", "again": "optimum"}
    for name, planner in given.items():
        done(*command(planners, "--planner", planner, "--name", name))
    store = Store.open(planners, "smoke")
    rows = [entry.rows("episodes").drop(columns="plan_seconds") for entry in store.entered()]
    assert len(rows) == 3
    for other in rows[1:]:
        pd.testing.assert_frame_equal(other, rows[0])
    assert board(planners).loc["mine", "Success (%)"] == "100.0"
    assert check_runs(store) == []


def test_moves_past_the_end_are_not_made() -> None:
    (episode,) = begin_episodes({"reward": "progress", "max_moves": 3}, 0, 1)
    follow(episode, checked(lambda env: [0, 1] * 5, "long"))
    assert (episode.over, episode.moves) == (True, 3)
    (episode,) = begin_episodes({"reward": "progress"}, 0, 1)
    follow(episode, checked(lambda env: [], "none"))
    assert (episode.moves, episode.failure) == (0, "no plan")


@pytest.mark.parametrize("moves", [[3.9], ["7"], "01", 3])
def test_moves_that_are_no_integers_are_refused(moves: Any) -> None:
    (episode,) = begin_episodes({"reward": "progress"}, 0, 1)
    with pytest.raises(BenchmarkError, match=r"'mine' returned .*, not a list of moves"):
        follow(episode, checked(lambda env: moves, "mine"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("cheat", "moved the environment; plan on a copy"),
        ("nonsense", "returned move 12; moves are 0 to 11"),
        ("masks", "returned 'False 0', not a list of moves"),
        ("masks --mask-singularities --mask-visited 3", "returned 'True 3', not a list of moves"),
        ("missing", "cannot be imported"),
        ("oracle", "is no function but LatticeOracle"),
    ],
)
def test_a_planner_that_does_wrong_is_one_error(
    words: str, message: str, planners: Path, done: Command, refused: Command
) -> None:
    given = ["--planner", *f"my_planner:{words}".split(), "--name", "wrong"]
    assert message in refused(*command(planners, *given))
    assert not list(planners.rglob("meta.json"))
    # and its name is free
    done(*command(planners, "--planner", "my_planner:nothing", "--name", "wrong"))


def test_an_edited_planner_is_another_one(planners: Path, done: Command, refused: Command) -> None:
    words = command(planners, "--planner", "my_planner:nothing", "--name", "ppo_mine")
    done(*words)  # its name begins like a learner's
    assert check_runs(Store.open(planners, "smoke")) == []
    (planners / "my_planner.py").write_text(f"{PLANNER}# better\n", encoding="utf-8")
    assert "--replace it" in refused(*words)
    done(*words, "--replace")


def test_a_gone_seeds_entry_is_replaced(planners: Path, done: Command, refused: Command) -> None:
    def words(seeds: list[int]) -> list[str | Path]:
        path = smoke_file(planners, "mine", seeds=seeds)
        own = command(planners, "--planner", "my_planner:nothing", "--name", "idle")
        return [*own, "--preset", path]

    done(*words([0, 1]))
    assert "--replace it" in refused(*words([0]))
    done(*words([0]), "--replace")
    assert [run.id for run in Store.open(planners, "mine").entered()] == ["idle-optimized-s0"]
    done(*words([0, 2]))


@pytest.mark.parametrize(
    ("observation", "action", "message"),
    [
        (spaces.Box(0.0, 1.0, (12,)), spaces.Discrete(4), "acts in Discrete(4)"),
        (spaces.Box(0.0, 1.0, (3,)), spaces.Discrete(12), "expects observations Box(0.0, 1.0, (3,"),
        (spaces.Box(-9.0, 1.0, (12,)), spaces.Discrete(12), "train with normalize=True"),
        (spaces.Box(0.0, 9.0, (12,)), spaces.Discrete(12), "train with normalize=True"),
    ],
)
def test_wrong_spaces_are_one_error(
    observation: Any, action: Any, message: str, tmp_path: Path, refused: Command
) -> None:
    path, env = tmp_path / "model.zip", make_env()
    env.observation_space, env.action_space = observation, action
    stable_baselines3.PPO("MlpPolicy", env, device="cpu").save(path)
    assert message in refused(*command(tmp_path / "results", "--model", path))
    assert not (tmp_path / "results").exists()


def test_wrong_files_are_one_error(train: Train, tmp_path: Path, refused: Command) -> None:
    good = train("ppo")

    def error_of(path: Path, *words: str | Path) -> str:
        return refused(*command(tmp_path / "results", "--model", path, *words))

    assert "is missing; give a .zip" in error_of(tmp_path / "none.zip")
    path = tmp_path / "bad.zip"
    path.write_text("not a zip", encoding="utf-8")
    assert "is no model of Stable-Baselines3 (BadZipFile" in error_of(path)
    with zipfile.ZipFile(good) as archive:
        without_its_weights = archive.read("data")
    for data, word in ((b"{}", "Stable-Baselines3 (KeyError"), (without_its_weights, "'ppo'")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data", data)
        assert f"is no model of {word}" in error_of(path)
    assert "is no model of 'dqn'" in error_of(good, "--algo", "dqn")
    assert "unknown algorithm 'sarsa'; known: a2c" in error_of(good, "--algo", "sarsa")
    sb3_contrib.RecurrentPPO("MlpLstmPolicy", make_env(), device="cpu").save(path)
    assert "recurrent policy" in error_of(path)
    assert "letters, digits" in error_of(good, "--name", "a/b")
    assert "one of the harness's own" in error_of(good, "--name", "rainbow")
    assert "either --model or --planner" in error_of(good, "--planner", "optimum")
    two = smoke_file(tmp_path, "two", seeds=[0, 1])
    assert "models are of dqn, ppo" in error_of(good, train("dqn"), "--preset", two)
    assert "preset 'difficulty' has no leaderboard" in error_of(good, "--preset", "difficulty")


def test_an_entry_leaves_other_tables_alone(train: Train, tmp_path: Path, done: Command) -> None:
    store = fabricated_store.make_store(tmp_path, [0], "smoke")
    fabricated_store.write_tables(store)
    before = {path.name: path.read_bytes() for path in store.tables.iterdir()}
    done(*command(tmp_path, "--model", train("ppo"), "--name", "mine"))
    after = {path.name: path.read_bytes() for path in store.tables.iterdir()}
    changed = {name for name in after if after[name] != before.get(name)}
    assert changed == {f"leaderboard{suffix}" for suffix in (".csv", ".md", ".tex")}
    rows = pd.read_csv(store.tables / "leaderboard.csv", dtype=str)
    assert rows["Method"].iloc[0] == "Exact optimum"
    assert rows["Method"].iloc[-1] == "mine"
    ranks = rows["Rank"].tolist()
    assert ranks == ["-", *[str(rank) for rank in range(1, len(ranks))]]


def test_a_study_may_measure_arrays() -> None:
    assert json.loads(_as_json({"x": np.zeros(2), "n": np.int64(3)})) == {"x": [0.0, 0.0], "n": 3}


def test_the_documented_study_runs(here: Path, done: Command, refused: Command) -> None:
    section = (ROOT / "docs" / "own_method.md").read_text("utf-8").split("## A study")[1]
    code = section.split("```python\n")[1].split("```")[0]
    (command,) = (line for line in section.splitlines() if line.startswith("    python -m"))
    (here / "my_study.py").write_text(code, encoding="utf-8")
    done(*command.split()[3:])
    path = here / "results" / "lengths" / "lengths.json"
    stored = json.loads(path.read_text("utf-8"))
    assert stored["command"] == command.strip()
    assert set(stored["parts"]) == {"initial", "optimized"}
    path.write_text("[]", encoding="utf-8")
    assert "holds no study's parts" in refused(*command.split()[3:])
    assert path.read_text("utf-8") == "[]"
