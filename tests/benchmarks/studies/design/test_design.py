"""``python -m benchmarks study design``: the table, the generated pages and the figures."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.cli import main
from benchmarks.methods.geometric_design import DesignRun, measured_runs, run_rows, table_rows
from benchmarks.protocol import paper_values
from benchmarks.studies.design import analyses as design_study
from benchmarks.studies.design import study
from benchmarks.studies.design.analyses import DesignStore
from tests.process import ROOT

STORED = DesignStore(ROOT / "results")


@pytest.fixture(scope="module")
def result() -> list[DesignRun]:
    shares: list[float] = []
    runs = measured_runs(2, shares.append)
    assert shares == [0.5, 1.0]
    return runs


def test_the_tables_rows_are_the_papers_five(result: list[DesignRun]) -> None:
    rows = {str(row["metric"]): row for row in table_rows(result)}
    assert list(rows) == list(paper_values.DESIGN)
    assert rows["workspace"]["initial_mean"] == pytest.approx(0.82, abs=0.005)
    assert rows["workspace"]["optimized_mean"] == pytest.approx(1.165, abs=0.005)
    assert str(rows["workspace"]["initial"]).startswith("0.82")
    assert rows["joint_range"]["optimized_high_mean"] <= 78.0  # type: ignore[operator]
    for metric in ("sigma_min", "condition", "joint_range"):
        assert len(str(rows[metric]["note"])) > 40, "a row that does not match says why"
    json.dumps(list(rows.values()), allow_nan=False)
    runs, paths = run_rows(result)
    assert [run["seed"] for run in runs] == [0, 1]
    assert len(paths) == sum(int(str(run["evaluations"])) for run in runs)


def test_the_papers_pose_costs_more_the_further_it_tilts() -> None:
    rows = design_study.pose_model_rows()
    for key in ("plane_mm", "centre_mm", "yaw_deg", "hole_mm", "hole_deg"):
        values = [float(str(row[key])) for row in rows]
        assert values == sorted(values), key
        assert values[0] > 0.0
    at_30 = next(row for row in rows if row["tilt"] == 30.0)
    # (1 - cos 30) / 2 of Rp is how far the centre has to give way
    assert at_30["centre_mm"] == pytest.approx(111.4 * (1 - math.cos(math.radians(30))) / 2, 1e-3)


def test_the_stored_table_is_what_the_command_would_write(result: list[DesignRun]) -> None:
    stored = STORED.rows("table").set_index("metric")
    for row in table_rows(result):
        for name in ("initial", "optimized"):
            mean = float(str(stored.at[str(row["metric"]), f"{name}_mean"]))
            assert mean == pytest.approx(float(str(row[f"{name}_mean"])), rel=0.05)
    assert STORED.meta()["seconds"] < 120.0
    names = [path.stem for path in STORED.path.glob("*.csv")]
    assert len(names) == 13
    assert all(len(STORED.rows(name)) for name in names)


@pytest.mark.slow
def test_figures_and_pages_are_of_stored_data(site: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    here = site("design-optima")
    store = DesignStore(here.results)
    shutil.copytree(STORED.path, store.path, ignore=shutil.ignore_patterns("figures"))
    monkeypatch.setattr(study.Design, "parts", lambda self: {})
    assert main(["study", "design", "--results", str(here.results)]) == 0
    assert "| differential evolution |" in here.page.read_text("utf-8")
    assert len(list(store.figures.glob("*.png"))) == 5


def test_a_study_that_was_stopped_is_not_complete(
    result: list[DesignRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(STORED.path, tmp_path / "design")

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "measured_runs", lambda *_: result)
    monkeypatch.setattr(study.Design, "_optima", stopped)
    assert main(["study", "design", "--runs", "1", "--results", str(tmp_path)]) == 130
    assert not DesignStore(tmp_path).is_complete()


def test_maps_are_the_designs() -> None:
    maps = STORED.maps()
    cell = math.radians(1.0) ** 2
    assert maps["inside_initial"][0].sum() * cell == pytest.approx(0.8176, abs=1e-3)
    assert maps["inside_optimized"][0].sum() * cell == pytest.approx(1.1636, abs=1e-3)
    sigma = maps["sigma_optimized"][0].astype(float)
    assert np.nanmin(sigma[maps["inside_optimized"][0]]) >= 0.149
