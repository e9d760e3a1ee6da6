"""Numbers, tables and figures of the public tasks, from stored runs."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import expand, settings
from benchmarks.protocol.presets import load_suite
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.stats import Value
from benchmarks.runs.store import Store
from benchmarks.studies.catalogue import stores
from benchmarks.studies.classic.report import build_tables, pictures
from benchmarks.studies.classic.results import SuiteResults, student
from tests.process import ROOT

STORE = Store(ROOT / "results" / "classic", "control")


@pytest.fixture(scope="module")
def results() -> SuiteResults:
    return SuiteResults(load_suite("control"), STORE)


def test_scores_are_means_over_seeds_with_an_interval(results: SuiteResults) -> None:
    runs = [run.folder for run in results.runs("mountaincar", "qrdqn")]
    assert [run.id for run in runs] == [f"mountaincar-qrdqn-s{seed}" for seed in range(1, 6)]
    value = results.score("mountaincar", "qrdqn")
    assert value.mean == pytest.approx(np.mean([run.rows("episodes")["return"] for run in runs]))
    # by a table of Student's distribution: 4.303 with two degrees of freedom
    three = student([1.0, 2.0, 6.0])
    half = 4.303 * math.sqrt(7.0 / 3.0)
    assert (three.low, three.high) == pytest.approx((3.0 - half, 3.0 + half), rel=1e-3)
    assert student([2.0] * 5) == Value(2.0, 0.0, 5, 2.0, 2.0)
    assert math.isnan(student([20.0, 21.0]).low)  # two seeds tell too little


def test_a_curve_is_drawn_and_read_where_it_reaches_a_goal(results: SuiteResults) -> None:
    runs = results.runs("cartpole", "rainbow")
    steps = runs[0].curve["timesteps"]
    returns = np.array([run.curve["return_mean"] for run in runs])
    for run, values in zip(runs, returns, strict=True):
        assert run.steps_to(475.0) == steps[int(np.argmax(values >= 475.0))]
    assert math.isnan(runs[0].steps_to(501.0))
    (picture,) = pictures(results)
    line: Any = picture.draw().axes[0].get_lines()[0]
    drawn = np.interp(steps / 1e3, *line.get_data())
    np.testing.assert_allclose(drawn, returns.mean(axis=0), atol=5.0)


def test_runs_that_are_not_what_the_preset_says_are_named(tmp_path: Path) -> None:
    atari = dataclasses.replace(load_suite("atari100k"), seeds=[3], final_episodes=2, controls=[])
    store = Store.open(tmp_path, "atari100k", create=True)
    seeds = episode_seeds(3, 2)
    made = {"wall_seconds": 1.0, "cpu_seconds": 1.0, "commit": "a", "dirty": False, "machine": {}}
    rows = [{"episode": i, "seed": seed, "return": 1.0} for i, seed in enumerate(seeds)]
    for cell, kept in zip(
        expand(atari), (rows, rows[:1], [rows[0], {**rows[1], "seed": 7}]), strict=True
    ):
        run = store.run(cell.id)
        run.begin(settings(atari, cell))
        run.write_rows("episodes", kept)
        run.write_rows("curve", [{"timesteps": 0, "return_mean": 1.0}])
        run.write_meta({"cell": cell.id, "training": {"timesteps": 0}, **made})
    few, other = SuiteResults(atari, store).problems()
    assert "has 1 rows, not one for each of the 2 test episodes" in few
    assert "other than the test seeds" in other
    del made["machine"]
    run.write_meta({"cell": "another", "training": {"timesteps": 0}, **made})
    problems = SuiteResults(atari, store).problems()
    for wrong in ("is of the run 'another'", "lacks 'machine'"):
        assert f"{run.path}: meta.json {wrong}" in problems
    text = (run.path / "config.yaml").read_text().replace("gamma: 0.99", "gamma: 0.5")
    (run.path / "config.yaml").write_text(text)
    with pytest.raises(BenchmarkError, match=r"settings \(arguments.gamma: 0.5 -> 0.99"):
        SuiteResults(atari, store)


def test_one_task_is_not_compared_with_itself(results: SuiteResults) -> None:
    tasks = {"cartpole": results.preset.tasks["cartpole"]}
    alone = SuiteResults(dataclasses.replace(results.preset, tasks=tasks), STORE)
    assert [table.name for table in build_tables(alone)] == ["scores", "controls", "steps"]


def test_a_store_of_the_other_kind_is_not_the_presets(tmp_path: Path) -> None:
    """A preset file of one's own may have the name of a public preset."""
    Store.open(tmp_path, "tiny", create=True)
    Store.open(tmp_path / "classic", "minatar", create=True)
    assert stores(tmp_path) == {"minatar": tmp_path / "classic" / "minatar"}
