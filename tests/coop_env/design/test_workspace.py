"""A_w: the paper's headline, the connected component, and a second implementation of it."""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from coop_env import design
from coop_env.design import DesignError, DesignProblem
from coop_env.design.analysis import LENGTHS
from coop_env.geometry import GEOMETRIES, INITIAL, OPTIMIZED, RRSGeometry
from coop_env.kinematics import rrs
from tests.coop_env.kinematics import reference


def test_the_papers_headline_and_the_tables_other_figures() -> None:
    initial, optimized = design.measure(INITIAL), design.measure(OPTIMIZED)
    assert initial.area == pytest.approx(0.82, abs=0.005)
    assert optimized.area == pytest.approx(1.16, abs=0.005)
    assert optimized.area / initial.area - 1.0 == pytest.approx(0.42, abs=0.01)
    assert initial.sigma_cone == pytest.approx(0.078, abs=5e-4)
    assert optimized.sigma_cone == pytest.approx(0.210, abs=5e-4)
    # the centres of cells stand at half degrees: a bound at one would ask for the last bit
    assert 31.0 < math.degrees(initial.max_angle) < 32.0
    assert 40.1 < math.degrees(optimized.max_angle) < 41.9
    for result in (initial, optimized):  # Omega respects the limits it is defined by
        assert math.radians(12.0) <= result.joint_low <= result.joint_high <= math.radians(78.0)


@pytest.mark.parametrize("g", [*GEOMETRIES.values(), reference.FLAT], ids=[*GEOMETRIES, "flat"])
def test_agrees_with_numpy_and_batched_svd_cell_by_cell(g: RRSGeometry) -> None:
    sigma, component = reference.workspace_map(g)
    problem = DesignProblem.of(g)
    result = design.workspace_map(g, problem)
    np.testing.assert_array_equal(result.inside, component)
    np.testing.assert_allclose(result.sigma, sigma, atol=1e-8)
    poses = np.stack([*result.samples, np.full_like(sigma, g.home_heave)], axis=-1)
    np.testing.assert_array_equal(result.kappa, rrs.condition_number(poses, g))
    assert result.area == pytest.approx(design.workspace_area(g, problem), abs=1e-12)
    paper = design.workspace_map(g, replace(problem, pose_model="paper"))
    np.testing.assert_array_equal(paper.sigma, rrs.signed_sigma_min(poses, g, "paper"))


def test_cells_that_touch_at_a_corner_are_not_connected() -> None:
    corners = DesignProblem(cells=20, heaves=(0.23,))
    g = corners.geometry(1.82, 1.101)  # two cells hang on by corners alone
    result = design.workspace_map(g, corners)
    np.testing.assert_array_equal(result.inside, reference.workspace_map(g, 20)[1])
    assert result.inside.sum() == 26
    part = DesignProblem(cells=30, heaves=(0.23,))
    edge = part.geometry(1.925, 1.358)  # admitted about the centre, but not in all four cells
    assert design.workspace_map(edge, part).inside[14:16, 14:16].sum() == 2


@pytest.mark.parametrize("model", ["exact", "paper"])
def test_the_tables_figures_are_those_of_the_component_at_the_problems_heave(model: str) -> None:
    problem = DesignProblem(cells=60, heaves=(0.23,), pose_model=model)
    metrics = design.measure(OPTIMIZED, problem)
    result = design.workspace_map(OPTIMIZED, problem)
    poses = np.stack([*result.samples, np.full_like(result.sigma, 0.23)], axis=-1)[result.inside]
    q = rrs.inverse(poses, OPTIMIZED, model).q
    kappa = rrs.condition_number(poses, OPTIMIZED, model)
    assert (metrics.joint_low, metrics.joint_high) == pytest.approx((q.min(), q.max()), abs=1e-12)
    assert metrics.kappa_variation == pytest.approx(np.std(kappa) / np.mean(kappa))


def test_no_tilt_limit_is_needed_for_the_papers_designs() -> None:
    limited = DesignProblem(max_tilt=math.pi / 4)
    for g in GEOMETRIES.values():
        assert design.workspace_area(g, limited) == design.workspace_area(g)
    narrow = replace(OPTIMIZED, joint_min=0.4, joint_max=1.0)
    own = design.workspace_area(narrow, DesignProblem.of(narrow))  # its own joint limits
    assert own < 0.1 * design.workspace_area(OPTIMIZED)
    limits = DesignProblem.of(OPTIMIZED, joint_min=0.4, joint_max=1.0)  # the problem's count
    assert design.workspace_area(OPTIMIZED, limits) == own
    assert DesignProblem.of(INITIAL) == replace(DesignProblem(), eta=INITIAL.characteristic_length)
    tight = design.workspace_area(OPTIMIZED, DesignProblem(max_tilt=math.radians(10)))
    assert tight == pytest.approx(math.radians(20) ** 2)


def test_only_the_ratios_of_lengths_matter() -> None:
    """Lengths and heave in other units are the same machine: J is dimensionless."""
    for size in (0.5, 3.0):
        lengths = {name: size * getattr(OPTIMIZED, name) for name in (*LENGTHS, "home_heave")}
        scaled = replace(OPTIMIZED, **lengths, heave_min=0.01, heave_max=9.0)
        result = design.workspace_area(scaled, DesignProblem(heaves=(size * 0.21,)))
        assert result == pytest.approx(design.workspace_area(OPTIMIZED), rel=2e-3)


def test_jitter_stays_within_its_cell_and_moves_the_area_little() -> None:
    problem = DesignProblem()
    plain = design.sample_points(problem)
    half = problem.extent / problem.cells
    areas = []
    for seed in range(6):
        samples = design.sample_points(problem, np.random.default_rng(seed))
        assert np.abs(samples.roll - plain.roll).max() <= half
        assert np.abs(samples.pitch - plain.pitch).max() <= half
        shifts = np.stack([samples.roll - plain.roll, samples.pitch - plain.pitch]) / half
        assert (shifts.min(axis=(1, 2)) < -0.99).all()
        assert (shifts.max(axis=(1, 2)) > 0.99).all()
        assert np.abs(np.corrcoef(shifts.reshape(2, -1)) - np.eye(2)).max() < 0.05
        areas.append(design.workspace_area(INITIAL, problem, samples))
    assert len(set(areas)) > 1
    assert np.std(areas) < 0.01


def test_several_heaves_make_one_number() -> None:
    problem = design.at_heaves(DesignProblem(), [0.20, 0.22])
    each = design.over_heaves(OPTIMIZED, [0.21, 0.20, 0.22])
    assert design.workspace_area(OPTIMIZED, problem) == pytest.approx(each.min())
    heaves = (0.21, 0.20, 0.22)
    for g in (INITIAL, OPTIMIZED):  # one has more at 0.20 than at home, the other less
        maps = [design.workspace_map(g, heave=heave).area for heave in heaves]
        assert design.over_heaves(g, heaves) == pytest.approx(maps)
        assert len(set(maps)) == 3


def test_a_cone_beyond_the_grid_or_out_of_reach_has_no_figures() -> None:
    away = DesignProblem(heaves=(0.5,))
    for problem in (DesignProblem(extent=0.2), DesignProblem(cells=2), away):
        result = design.measure(OPTIMIZED, problem)
        assert math.isnan(result.sigma_cone)
        assert math.isnan(result.kappa_variation_cone)
    assert result.area == design.workspace_area(OPTIMIZED, away) == 0.0
    assert math.isnan(result.kappa_variation)


def test_impossible_problems_are_named() -> None:
    impossible: dict[str, list[Any]] = {
        "eta": [math.nan, "a"],
        "distal_length": [-1.0],
        "heaves": [(), 0.2, {0.21: 1}, map(float, ["0.21"]), (0.21, math.inf)],
        "threshold": [None],
        "extent": [2.0],
        "joint_min": [2.0],
        "cells": [1, 2.5],
        "pose_model": ["papr"],
    }
    for field, values in impossible.items():
        for value in values:
            with pytest.raises(DesignError, match=field):
                DesignProblem(**{field: value})
    array: Any = np.array([0.21, 0.22])
    assert DesignProblem(heaves=array) == DesignProblem(heaves=(0.21, 0.22))


def test_lambdas_and_lengths_are_two_names_of_one_machine() -> None:
    g = DesignProblem().geometry(1.44, 1.658)
    assert g.base_radius == pytest.approx(0.1778, abs=1e-4)
    assert g.proximal_length == pytest.approx(0.1024, abs=1e-4)
    assert g.platform_radius == pytest.approx(0.1114, abs=1e-4)
    assert sum(g.lambdas) == pytest.approx(4.0)
    again = RRSGeometry.from_lambdas(*g.lambdas[:2], eta=g.characteristic_length)
    assert again.base_radius == pytest.approx(g.base_radius)


def test_numbers_of_any_kind_are_kept_as_floats_and_a_heave_is_one() -> None:
    problem = DesignProblem(cells=20, threshold=Fraction(3, 20))  # type: ignore[arg-type]
    assert problem == DesignProblem(cells=20)
    assert design.workspace_area(OPTIMIZED, problem) > 0.0
    for heave in (math.nan, -0.21):
        with pytest.raises(DesignError, match="heave = "):
            design.workspace_map(OPTIMIZED, heave=heave)


def test_samples_of_another_grid_are_refused() -> None:
    problem, rng = DesignProblem(cells=30), np.random.default_rng(0)
    for drawn in (design.sample_points(problem), design.sample_points(problem, rng)):
        assert design.workspace_area(OPTIMIZED, problem, drawn) > 1.0
    for other in (DesignProblem(cells=60), DesignProblem(cells=30, extent=0.5)):
        for measure in (design.workspace_area, design.workspace_map, design.measure):
            with pytest.raises(DesignError, match=r"samples\.roll: must be a point in each"):
                measure(OPTIMIZED, problem, design.sample_points(other))
    roll, pitch = design.sample_points(problem)
    for shift in (-0.1, 0.1):
        with pytest.raises(DesignError, match=r"samples\.pitch: must be a point in each"):
            design.workspace_area(OPTIMIZED, problem, design.Samples(roll, pitch + shift))
