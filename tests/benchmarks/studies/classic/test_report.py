"""Tables, figures and the block of the public tasks, from stored runs whose numbers are known."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import expand, settings
from benchmarks.protocol.presets import SuitePreset, load_suite
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.stats import Value
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import Store
from benchmarks.studies.catalogue import stores
from benchmarks.studies.classic.report import build_tables, page, pictures
from benchmarks.studies.classic.results import SuiteResults, student

SCORES = {"rainbow": 30.0, "dqn": 20.0, "qrdqn": 10.0, "random": 1.0, "held": 2.0, "script": 33.0}


@pytest.fixture(scope="module")
def preset() -> SuitePreset:
    return load_suite("public")


@pytest.fixture(scope="module")
def store(preset: SuitePreset, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Runs with made-up rows: a seed adds one to every return."""
    store = Store.open(tmp_path_factory.mktemp("results"), "public", create=True)
    for cell in expand(preset):
        run = store.run(cell.id)
        final = SCORES[cell.method] + cell.seed
        run.write_rows("episodes", [{"episode": i, "return": final + i} for i in (-1, 0, 1)])
        curve: list[dict[str, object]] = [
            {"timesteps": t, "return_mean": final * t / 1000} for t in (0, 500, 1000)
        ]
        if cell.learns:
            run.write_rows("curve", curve)
        training = {"updates": 7, "cpu_seconds": 60.0, "wall_seconds": 120.0}
        machine = {"commit": "f" * 40, "dirty": False, "machine": {"processor": "abacus"}}
        run.write_meta({"training": training, **machine})
    return store


def tables_of(preset: SuitePreset, store: Store) -> dict[str, Table]:
    return {table.name: table for table in build_tables(SuiteResults(preset, store))}


def test_scores_are_means_over_seeds_with_an_interval(preset: SuitePreset, store: Store) -> None:
    results = SuiteResults(preset, store)
    assert results.missing == []
    value = results.score("cartpole", "dqn")
    assert (value.mean, value.n) == (20.5, 2)
    assert math.isnan(value.low)  # two seeds tell too little
    # by a table of Student's distribution: 4.303 with two degrees of freedom
    three = student([1.0, 2.0, 6.0])
    half = 4.303 * math.sqrt(7.0 / 3.0)
    assert (three.low, three.high) == pytest.approx((3.0 - half, 3.0 + half), rel=1e-3)
    assert student([2.0] * 5) == Value(2.0, 0.0, 5, 2.0, 2.0)
    assert math.isnan(results.score("acrobot", "dqn").low)
    run = results.runs("cartpole", "rainbow")[1]
    assert run.steps_to(15.0) == 500
    assert math.isnan(run.steps_to(99.0))
    (picture,) = pictures(results)
    line: Any = picture.draw().axes[0].get_lines()[0]
    drawn = np.interp(run.curve["timesteps"] / 1e3, *line.get_data())
    np.testing.assert_allclose(drawn, [0.0, 15.25, 30.5], atol=0.05)


def test_every_panel_is_drawn_and_the_same_data_gives_the_same_file(
    preset: SuitePreset, store: Store
) -> None:
    results = SuiteResults(preset, store)
    paths = [picture.write(store.figures) for picture in pictures(results)]
    assert [path.name for path in paths] == ["curves.png"]
    first = [path.read_bytes() for path in paths]
    again = [picture.write(store.figures) for picture in pictures(results)]
    assert [path.read_bytes() for path in again] == first


def test_the_block_says_which_runs_it_shows(preset: SuitePreset, store: Store) -> None:
    text = page(store)
    cells = expand(preset)
    controls = sum(not cell.learns for cell in cells)
    report = f"{len(cells) - controls} runs and {controls} of controls, {len(cells)} CPU minutes"
    assert report in text
    assert "abacus" in text
    assert "(../results/classic/public/figures/curves.png)" in text
    assert f"{preset.final_episodes} test episodes per seed" in text


def test_published_marks_stand_beside_the_scores(tmp_path: Path) -> None:
    atari = load_suite("atari100k")
    store = Store.open(tmp_path, "atari100k", create=True)
    for cell in expand(atari):
        run = store.run(cell.id)
        run.write_rows("episodes", [{"episode": 0, "return": 5.0 + cell.seed}])
        run.write_rows("curve", [{"timesteps": t, "return_mean": 1.0} for t in (0, 500)])
        run.write_meta({"training": {"updates": 7, "cpu_seconds": 60.0}})
    tables = tables_of(atari, store)
    boxing = next(row for row in tables["scores"].rows if row[0] == "Boxing")
    assert boxing[-1] == "0.2"
    assert "data-efficient Rainbow" in tables["scores"].notes[1]
    assert "together" not in tables


def test_controls_have_their_own_table_and_move_no_score(preset: SuitePreset, store: Store) -> None:
    tables = tables_of(preset, store)
    shown = {row[0]: row[1:] for row in tables["controls"].texts()}
    assert tables["controls"].header[1:] == ["Random", "One action", "Script"]
    assert shown["CartPole-v1"] == ["1.5", "2.5", "33.5"]
    assert shown["Masked identity"] == ["1.0", "2.0", "-"]
    plain = tables_of(dataclasses.replace(preset, controls=[]), store)
    assert "controls" not in plain
    assert plain["together"].markdown() == tables["together"].markdown()
    assert plain["scores"].markdown() == tables["scores"].markdown()


def test_runs_that_are_not_what_the_preset_says_are_named(tmp_path: Path) -> None:
    atari = dataclasses.replace(load_suite("atari100k"), seeds=[3], final_episodes=2, controls=[])
    store = Store.open(tmp_path, "atari100k", create=True)
    seeds = episode_seeds(3, 2)
    rows = [{"episode": i, "seed": seed, "return": 1.0} for i, seed in enumerate(seeds)]
    for cell, kept in zip(
        expand(atari), (rows, rows[:1], [rows[0], {**rows[1], "seed": 7}]), strict=True
    ):
        run = store.run(cell.id)
        run.begin(settings(atari, cell))
        run.write_rows("episodes", kept)
        run.write_rows("curve", [{"timesteps": 0, "return_mean": 1.0}])
        run.write_meta({"cell": cell.id, "training": {}})
    few, other = SuiteResults(atari, store).problems()
    assert "has 1 rows, not one for each of the 2 test episodes" in few
    assert "other than the test seeds" in other
    run.write_meta({"cell": "another", "training": {}})
    assert f"{run.path}: meta.json is of the run 'another'" in SuiteResults(atari, store).problems()
    text = (run.path / "config.yaml").read_text().replace("gamma: 0.99", "gamma: 0.5")
    (run.path / "config.yaml").write_text(text)
    with pytest.raises(BenchmarkError, match=r"settings \(arguments.gamma: 0.5 -> 0.99"):
        SuiteResults(atari, store)


def test_one_task_is_not_compared_with_itself(preset: SuitePreset, store: Store) -> None:
    for tasks in ({"masked_identity"}, {"cartpole"}):
        alone = dataclasses.replace(preset, tasks={key: preset.tasks[key] for key in tasks})
        assert [*tables_of(alone, store)] == ["scores", "controls", "steps"]


def test_a_store_of_the_other_kind_is_not_the_presets(tmp_path: Path) -> None:
    """A preset file of one's own may have the name of a public preset."""
    Store.open(tmp_path, "tiny", create=True)
    Store.open(tmp_path / "classic", "minatar", create=True)
    assert stores(tmp_path) == {"minatar": tmp_path / "classic" / "minatar"}
