"""Studies ``speed-env`` and ``speed-rainbow``: what they measure, store and say."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError
from benchmarks.studies import catalogue, speed
from benchmarks.studies.base import Measured, Study
from benchmarks.studies.speed import in_turns, measure_updates
from sb3_rainbow import Rainbow
from tests.benchmarks.conftest import Command


def test_the_command_writes_what_it_prints(site: Any) -> None:
    here = site("speed-env")
    small = ["--steps", "256", "--rounds", "1", "--starts", "3"]
    assert main(["study", "speed-env", "--results", str(here.results), *small]) == 0
    here.check(speed.SpeedEnv, "batch of 64")
    parts = here.parts(speed.SpeedEnv)
    assert all(value > 0.0 for value in parts["steps"].values())
    assert parts["optimum, optimized"]["feasible"] > 0.0
    # generous, so that only a gross slip fails here whatever else the machine does
    assert parts["steps"]["batch of 64"] < parts["steps"]["SB3 DummyVecEnv of 64"]


def test_times_are_medians_over_all_rounds_but_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    now, seconds = [0.0], iter([9.0, 0.1, 0.5, 0.2])
    monkeypatch.setattr(time, "process_time", lambda: now[0])

    def take(lasted: float) -> None:
        now[0] += lasted

    actions = {"a": lambda: take(next(seconds)), "b": lambda: take(1.0)}
    assert in_turns(actions, 3) == pytest.approx({"a": 0.2, "b": 1.0})


def test_steps_are_those_that_were_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "in_turns", lambda loops, rounds: dict.fromkeys(loops, 1.0))
    result = speed.measure_steps(100, 1, lambda share: None)
    made = {speed.SINGLE: 100, "batch of 1": 100, "batch of 8": 96, "batch of 256": 256}
    assert {name: result[name] for name in made} == {name: 1e6 / n for name, n in made.items()}


def test_updates_are_counted_whatever_the_number_of_games() -> None:
    one: dict[str, Any] = {"train_freq": 1, "gradient_steps": 1}
    model = Rainbow("MlpPolicy", make_vec_env("CartPole-v1", 4), learning_starts=8, **one)
    model.learn(40)
    before = model._n_updates
    measure_updates({"Rainbow": model}, 5, 2)
    assert model._n_updates - before == 3 * (5 + 5)  # a round is not counted


def test_each_learner_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "sbx_dqn", lambda: DQN)
    models = speed.make_models([16, 8], capacity=192)
    assert set(models) == {
        *("SB3 DQN", "sb3-contrib QR-DQN", "SBX DQN"),
        *("Rainbow", "Rainbow, categorical", "Rainbow, torch eager"),
    }
    assert models["Rainbow"].q_net.net_arch == models["SB3 DQN"].q_net.net_arch == [16, 8]
    assert all(rates["train_cpu"] > 0.0 for rates in measure_updates(models, 3, 1).values())


def test_each_learner_of_images_is_measured() -> None:
    assert set(speed.make_models(None)) == {
        *("SB3 DQN", "sb3-contrib QR-DQN", "Rainbow", "Rainbow, by default two streams of 512")
    }


def test_a_study_says_before_it_measures_what_it_lacks(tmp_path: Path) -> None:
    class Nameless(Measured):
        def measures(self) -> dict[str, Any]:
            raise AssertionError("measured")

    given = argparse.Namespace(results=tmp_path, command="")
    with pytest.raises(TypeError, match="to_markdown"):
        Nameless(given)  # type: ignore[abstract]
    has = {"to_markdown": staticmethod(str)}
    for missing, more in (("name", {}), ("file", {"name": "nameless"})):
        kind = type("Nameless", (Nameless,), has | more)
        with pytest.raises(BenchmarkError, match=f"Nameless needs {missing}"):
            kind(given)


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        *((name, "mujoco", "physics") for name in ("contact", "physics", "transfer")),
        ("codesign", "optuna", "tune"),
        ("data", "minari", "data"),
        ("trajectory", "ruckig", "trajectory"),
    ],
)
def test_without_a_package_that_a_study_needs_its_extra_is_named(
    name: str, module: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    refused: Command,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, module, None)
    assert f"sb3-rainbow-coop[{extra}]" in refused("study", name, "--results", str(tmp_path))
    assert not list(tmp_path.iterdir())


class Counted(Measured):
    """Two parts, of which a run may make the first alone."""

    name, file = "counted", "counted/counted.json"

    @staticmethod
    def to_markdown(result: Any) -> str:
        return str(result)

    def measures(self) -> dict[str, Any]:
        return {name: lambda _: np.int64(self.given.starts) for name in ("a", "b")}


def test_other_settings_leave_what_was_measured(tmp_path: Path) -> None:
    def begun(starts: int) -> Counted:
        given = argparse.Namespace(results=tmp_path, command="", starts=starts, to=tmp_path)
        study = Counted(given)
        name, part = next(iter(study.parts().items()))
        study.keep(name, part(lambda _: None))
        return study

    assert list(begun(1).parts()) == ["b"]
    assert list(begun(1).parts()) == []
    assert list(begun(2).parts()) == ["b"]
    stored, kept = (tmp_path / f"counted/counted{end}" for end in (".json", ".before.json"))
    assert json.loads(stored.read_text("utf-8"))["parts"] == {"a": 2}
    begun(3)
    assert json.loads(kept.read_text("utf-8"))["parts"] == {"a": 1, "b": 1}
    assert json.loads(kept.with_suffix(".before.json").read_text("utf-8"))["parts"] == {"a": 2}


OWN = """
from benchmarks.studies.base import Measured


class Own(Measured):
    name, file = "own", "own/own.json"
    to_markdown = staticmethod(str)

    def measures(self):
        return {5: lambda tick: 1}
"""


def test_an_edited_study_is_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own_study.py"
    path.write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    kind, given = catalogue.study("own_study:Own"), argparse.Namespace(results=tmp_path, command="")
    kind(given).keep("5", 1)
    assert list(kind(given).parts()) == []
    path.write_text(OWN + "# better\n", encoding="utf-8")
    assert list(kind(given).parts()) == ["5"]


def test_a_study_prints_what_it_found_and_no_other_stores(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Two(Study):
        name = "two"

        def parts(self) -> dict[str, Any]:
            return {}

        @classmethod
        def files(cls, results: Path) -> dict[Path, str]:
            return {results / name / "a.md": f"of {name}" for name in ("two", "three")}

    assert Two.main(["--results", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "of two" in out
    assert "of three" not in out
