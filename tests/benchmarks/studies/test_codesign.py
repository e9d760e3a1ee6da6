"""``python -m benchmarks study codesign``: searches, goes on, chooses, can be checked."""

import math
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

pytest.importorskip("optuna", reason="the extra 'tune' is not installed")

import optuna

from benchmarks.cli import main
from benchmarks.runs.store import RunFolder
from benchmarks.studies import codesign
from benchmarks.studies import codesign_report as report
from benchmarks.studies.codesign import Codesign
from benchmarks.studies.codesign_report import SearchResult
from coop_env.design import workspace_area
from coop_env.geometry import GEOMETRIES, OPTIMIZED

SMALL = ["--designs", "4", "--starts", "3", "--seeds", "2"]


def test_a_design_is_the_given_machine_with_some_lengths_changed() -> None:
    same = codesign.geometry_of({})
    for name, value in asdict(OPTIMIZED).items():
        assert getattr(same, name) == pytest.approx(value, abs=1e-12), name
    higher = codesign.geometry_of({"home_heave": 0.23, "distal_length": 0.25})
    assert (higher.heave_min, higher.heave_max) == pytest.approx((0.23, 0.27))
    assert higher.distal_length == 0.25
    assert higher.lambdas == pytest.approx(OPTIMIZED.lambdas)
    assert codesign.area(OPTIMIZED) == workspace_area(OPTIMIZED)
    assert codesign.of_row({"design": "initial"}) is GEOMETRIES["initial"]


def test_what_cannot_be_assembled_has_no_score() -> None:
    for reason, values in (
        ("lengths", {"lambda1": 0.9, "lambda2": 1.0}),
        ("home", {"home_heave": 0.33}),
        ("starts", {"lambda1": 1.25, "lambda2": 2.65}),
    ):
        with pytest.raises(codesign.Unbuilt, match=reason):
            codesign.build(values)


def test_the_optimum_of_a_design_is_the_same_for_the_same_starts() -> None:
    result = codesign.optimum(OPTIMIZED, 0, 6)
    assert result == codesign.optimum(OPTIMIZED, 0, 6)
    solved = result["success"] / 100.0
    ticks = solved * result["ticks"] + (1 - solved) * 300
    assert result["ticks_all"] == pytest.approx(ticks)
    assert codesign.reach([math.nan, 10.0]) == {"success": 50.0, "ticks": 10.0, "ticks_all": 155.0}
    assert codesign.reach([math.nan])["success"] == 0.0


def test_a_front_holds_what_no_other_beats() -> None:
    rng = np.random.default_rng(0)
    rows = pd.DataFrame({
        "success": rng.integers(70, 100, 40).astype(float), "ticks": rng.integers(15, 25, 40) / 1.0,
    }, index=[f"lambdas-{i}" for i in range(40)])  # fmt: skip
    rows.loc["lambdas-40"] = [60.0, 1.0]
    held = rows[report.on_front(rows, 75.0)]
    for name, row in rows.iterrows():
        beaten = any(
            s >= row["success"] and t <= row["ticks"] and (s, t) != (row["success"], row["ticks"])
            for s, t in zip(rows["success"], rows["ticks"], strict=True)
        )
        assert (name in held.index) == (row["success"] >= 75.0 and not beaten)
    assert report.surest(rows) in held.index
    fast = report.quickest(rows, 90.0)
    assert fast in held.index
    assert rows.loc[fast, "ticks"] == rows.loc[rows["success"] >= 90.0, "ticks"].min()


def test_a_rank_correlation_has_an_interval_about_it() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(size=80).round(1)  # with ties
    y = (x + rng.normal(size=80)).round(1)
    result = report.rank_correlation(x, y)
    assert result.mean == pytest.approx(spearmanr(x, y).statistic)
    assert result.low < result.mean < result.high
    assert result.high - result.low == pytest.approx(4 * 0.75 / math.sqrt(80), rel=0.5)
    assert report.rank_correlation([*x, 9.0], [*y, math.nan]).n == 80
    assert report.rank_correlation(x, np.ones(80)).n == 0


def test_a_search_cut_off_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def score(name: str, study: str, values: dict[str, float], starts: int) -> dict[str, Any]:
        if values["lambda1"] > 1.7:
            raise codesign.Unbuilt("home")
        success, ticks = 100.0 * math.sin(values["lambda1"]), 10.0 * values["lambda2"]
        return {"design": name, **values, "success": success, "ticks": ticks}

    tell: Any = optuna.Study.tell

    def cut_off(self: Any, trial: Any, values: Any = None, **more: Any) -> Any:
        if values is not None:
            raise KeyboardInterrupt
        return tell(self, trial, **more)

    def rows(folder: str, *cuts: int) -> Any:
        place = tmp_path / folder
        place.mkdir()
        search = partial(codesign.search, place, "lambdas", 70.0, 20, 1, lambda share: None)
        for end in (*cuts, None):
            left = [] if end is None else [*end * [mock.DEFAULT], KeyboardInterrupt]
            spy = mock.Mock(wraps=score, side_effect=left or None)
            monkeypatch.setattr(codesign, "score", spy)
            if end == 3:  # and once between a design's row and its end
                with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
                    patch.setattr(optuna.Study, "tell", cut_off)
                    search()
            with suppress(KeyboardInterrupt):
                return search()
        raise AssertionError("cut off")

    monkeypatch.setattr("time.process_time", count().__next__)  # a second for each
    monkeypatch.setattr(codesign, "POPULATION", 4)
    monkeypatch.setattr(codesign, "build", lambda values: values)
    (cut, skipped, seconds), whole = rows("cut", 2, 5, 3), rows("whole")
    assert (cut, skipped) == whole[:2]
    assert seconds == whole[2] + 1  # of the design that was scored twice


@pytest.mark.slow
def test_the_largest_area_is_the_one_that_the_design_study_finds() -> None:
    result = codesign.area_best("lambdas")
    assert result == pytest.approx({"lambda1": 1.438, "lambda2": 1.660}, abs=0.002)
    assert codesign.area(codesign.geometry_of(result)) == pytest.approx(1.165, abs=5e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("forked")
def test_the_command_goes_on_and_can_be_checked(site: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    here = site("codesign")
    results = here.results
    words = ["study", "codesign", "--results", str(results), "--jobs", "1", *SMALL]
    words += ["--policy-steps", "320"]
    with RunFolder(results / "codesign").lock():
        assert main(words) == 2
        assert not (results / "codesign" / "journal.log").exists()
    monkeypatch.setattr(codesign, "EPISODES", 4)
    largest = {
        "lambdas": {"lambda1": 1.4386, "lambda2": 1.6591},
        "heights": {"distal_length": 0.27631, "home_heave": 0.28221},
    }
    monkeypatch.setattr(codesign, "area_best", lambda of: largest[of])
    choose, few = SearchResult.choose, ("initial", "optimized", "lambdas-area", "heights-area")
    monkeypatch.setattr(  # of the six and more, two to train on
        SearchResult, "choose", lambda result: {name: choose(result)[name] for name in few[1::2]}
    )
    cut_off = [*6 * [mock.DEFAULT], KeyboardInterrupt]
    seventh: Any = {"wraps": codesign.optimum, "side_effect": cut_off}
    with mock.patch.object(codesign, "optimum", **seventh):
        assert main(words) == 130
    folder = results / "codesign"
    assert not (folder / "designs.csv").exists()
    assert main(words) == 0
    result = SearchResult(folder)
    assert len(RunFolder(folder).rows("designs")) == 2 * 4 + 4
    assert {*few} <= choose(result).keys()
    assert result.policies.group("rainbow", "central", "heights-area").n == 2

    text = here.check(Codesign, "too few")
    assert text.count("too few designs") == 2
    assert "](../results/codesign/figures/fronts.png)" in text
    assert "--designs 4" in result.summary["command"]
    assert (folder / "figures" / "fronts.png").stat().st_size > 10_000
    assert main([*words, "--starts", "4"]) == 2
    assert "starts: 3 -> 4" in here.capsys.readouterr().err
