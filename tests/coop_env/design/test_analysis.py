"""Sensitivity and the test trajectory."""

import doctest
import importlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coop_env import design
from coop_env.design import DesignError, DesignProblem, analysis
from coop_env.geometry import GEOMETRIES, INITIAL, OPTIMIZED, RRSGeometry
from coop_env.kinematics import rotations, rrs
from tests.coop_env.kinematics import reference

COARSE = DesignProblem(cells=60)


@pytest.mark.parametrize("name", ["base_radius", "distal_length"])
def test_slopes_are_the_change_of_the_area_per_millimetre(name: str) -> None:
    length = getattr(OPTIMIZED, name)
    cells = [
        reference.workspace_map(replace(OPTIMIZED, **{name: length + error}))[1].sum()
        for error in (5e-4, -5e-4)
    ]
    expected = math.radians(1.0) ** 2 * float(cells[0] - cells[1])
    found = design.slopes(OPTIMIZED)
    assert set(found) == set(analysis.LENGTHS)
    assert found[name] == pytest.approx(expected, abs=1e-9)


def test_tolerances_widen_the_spread_and_repeat_by_seed() -> None:
    none = design.under_tolerances(OPTIMIZED, 0.0, 3, COARSE)
    assert np.ptp(none) == 0.0
    assert none[0] == design.workspace_area(OPTIMIZED, COARSE)
    small = design.under_tolerances(OPTIMIZED, 2e-4, 30, COARSE)
    large = design.under_tolerances(OPTIMIZED, 2e-3, 30, COARSE)
    assert small.std() < large.std()
    np.testing.assert_array_equal(small, design.under_tolerances(OPTIMIZED, 2e-4, 30, COARSE))
    for wrong in (-1.0, math.inf):
        with pytest.raises(DesignError, match="tolerance"):
            design.under_tolerances(OPTIMIZED, wrong)
    with pytest.raises(DesignError, match="draws"):
        design.under_tolerances(OPTIMIZED, 0.0, -1)
    with pytest.raises(DesignError, match="heaves"):
        design.over_heaves(OPTIMIZED, 0.2)  # type: ignore[arg-type]


def test_every_length_errs_by_itself_and_either_way(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[RRSGeometry] = []

    def noted(geometry: RRSGeometry, problem: DesignProblem) -> float:
        built.append(geometry)
        return 1.0

    monkeypatch.setattr(analysis, "workspace_area", noted)
    assert design.under_tolerances(OPTIMIZED, 1e-3, 400).tolist() == [1.0] * 400
    lengths = np.array([[getattr(g, name) for name in analysis.LENGTHS] for g in built])
    errors = (lengths - [getattr(OPTIMIZED, name) for name in analysis.LENGTHS]) / 1e-3
    assert np.abs(errors).max() <= 1.0 + 1e-9
    assert (errors.min(axis=0) < -0.95).all()
    assert (errors.max(axis=0) > 0.95).all()
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 0.2
    # draws that cannot be built count as zero, and the next are made all the same
    rough = design.under_tolerances(OPTIMIZED, 0.06, 100)
    assert 0.0 < rough[np.argmin(rough) :].mean() < 1.0


def test_the_trajectory_starts_and_ends_at_rest_at_the_designs_own_home() -> None:
    path = design.cone_trajectory()
    for end in (0, -1):
        np.testing.assert_allclose(path.poses[end], [0.0, 0.0, 0.21], atol=1e-12)
    rates = np.diff(path.poses, axis=0) / np.diff(path.time)[:, None]
    assert np.abs(rates[[0, -1]]).max() < 1e-4 * np.abs(rates).max()
    tilt = np.arccos(np.cos(path.poses[:, 0]) * np.cos(path.poses[:, 1]))
    assert tilt.max() == pytest.approx(math.radians(22.0), abs=1e-6)
    assert path.poses[:, 2].max() == pytest.approx(0.22, abs=1e-9)
    azimuth = np.unwrap(rotations.tilt_azimuth(path.poses[1:-1, :2])[:, 1])
    assert np.ptp(azimuth) == pytest.approx(4.0 * math.pi, abs=1e-6)  # twice about the cone
    higher = replace(OPTIMIZED, heave_min=0.225, heave_max=0.26, home_heave=0.225)
    report = design.validate(higher)
    assert report.valid
    assert report.q[0] == pytest.approx(rrs.inverse([0.0, 0.0, 0.225], higher).q)


@pytest.mark.parametrize("g", GEOMETRIES.values(), ids=GEOMETRIES)
def test_the_report_is_what_the_joints_do(g: RRSGeometry) -> None:
    path = design.cone_trajectory()
    report = design.validate(g, path)
    assert report.valid
    np.testing.assert_array_equal(report.q, rrs.inverse(path.poses, g).q)
    numeric = np.abs(np.gradient(report.q, path.time, axis=0)).max()
    assert report.peak_rate == pytest.approx(numeric, rel=1e-3)
    assert report.sigma_min == pytest.approx(rrs.signed_sigma_min(path.poses, g).min())
    assert report.kappa_max == pytest.approx(rrs.condition_number(path.poses, g).max())
    low, high, dt = report.q.min(axis=0), report.q.max(axis=0), path.time[1]
    assert (report.joint_low, report.joint_high) == (low.min(), high.max())
    assert report.excursion == pytest.approx((high - low).max())
    speed, acceleration, jerk = (np.diff(report.q, n, axis=0) / dt**n for n in (1, 2, 3))
    assert report.peak_acceleration == pytest.approx(np.abs(acceleration).max(), rel=1e-2)
    dimensionless = 12.0**3 / (speed**2).sum(axis=-1).max() * (jerk**2).sum() * dt
    assert report.log_jerk == pytest.approx(math.log(dimensionless), abs=0.01)
    assert report.forward_error < 1e-10
    slow = design.validate(g, design.cone_trajectory(duration=24.0))
    assert slow.peak_rate == pytest.approx(report.peak_rate / 2, rel=1e-3)
    assert slow.log_jerk == pytest.approx(report.log_jerk, abs=1e-3)  # it has no dimension


def test_a_trajectory_too_far_is_reported_not_hidden() -> None:
    steep = design.validate(INITIAL, design.cone_trajectory(tilt=math.radians(40.0)))
    assert not steep.valid
    free = replace(OPTIMIZED, joint_min=-3.0, joint_max=3.0)  # nothing but the singularity is left
    beyond = design.validate(free, design.cone_trajectory(tilt=math.radians(40.0)))
    assert np.isfinite(beyond.q).all()
    assert beyond.sigma_min < 0.0
    assert not beyond.valid
    assert not beyond.forward_error < 1e-3  # followed, the joints lead elsewhere
    stiff = design.validate(replace(OPTIMIZED, joint_max=0.8))  # and nothing but a limit here
    assert stiff.sigma_min > 0.0
    assert not stiff.valid
    out = design.validate(INITIAL, design.cone_trajectory(heave=(0.21, 0.6)))
    assert not out.valid
    assert math.isnan(out.joint_high)
    wrong: dict[str, Any] = {"tilt": 2.0, "heave": 0.21, "duration": 0.0}
    for name, value in wrong.items():
        with pytest.raises(DesignError, match=name):
            design.cone_trajectory(**{name: value})
    whole = design.cone_trajectory()
    with pytest.raises(DesignError, match="2 samples"):
        design.validate(INITIAL, design.PlatformTrajectory(whole.time[:2], whole.poses[:2]))


@pytest.mark.parametrize("name", ["", ".problem", ".optimize", ".analysis"])
def test_worked_examples(name: str) -> None:
    result = doctest.testmod(importlib.import_module(f"coop_env.design{name}"))
    assert result.attempted >= 1
    assert result.failed == 0
