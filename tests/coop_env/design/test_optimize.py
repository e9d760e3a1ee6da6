"""The optimizers: the paper's gain, constraints kept, starts that cannot work refused."""

import math
from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionEnv, design
from coop_env.design import DesignError, DesignProblem, Samples
from coop_env.geometry import INITIAL, GeometryError, RRSGeometry

COARSE = DesignProblem(cells=60)


def test_nelder_mead_from_the_initial_design_finds_the_papers_gain() -> None:
    result = design.optimize()
    assert result.converged
    assert result.start_value == pytest.approx(0.82, abs=0.005)
    assert result.value == pytest.approx(1.165, abs=0.005)
    assert (result.lambda1, result.lambda2) == pytest.approx((1.44, 1.66), abs=0.02)
    assert result.lambda1 + result.lambda2 + result.lambda3 == pytest.approx(4.0)
    assert tuple(result.path[0, :2]) == pytest.approx(INITIAL.lambdas[:2])
    assert design.workspace_area(result.geometry) == pytest.approx(result.value, abs=1e-12)


def test_runs_differ_by_their_jitter_and_repeat_by_their_seed() -> None:
    runs = [design.optimize(COARSE, seed=seed) for seed in range(3)]
    assert runs[2].path.tolist() == design.optimize(COARSE, seed=2).path.tolist()
    assert len({run.lambda1 for run in runs}) == 3
    assert all(run.converged for run in runs)


@pytest.fixture(scope="module")
def printed() -> design.Optimum:
    return design.optimize(COARSE)


def test_differential_evolution_finds_nothing_better(printed: design.Optimum) -> None:
    far = design.optimize_globally(COARSE, seed=3, population=10, generations=15)
    assert far.value == pytest.approx(printed.value, rel=0.01)


def test_a_search_cut_short_says_so() -> None:
    for cut in (
        design.optimize_globally(COARSE, population=3, generations=1),
        design.optimize(COARSE, max_evaluations=5),
    ):
        assert not cut.converged
        assert "has been exceeded" in cut.message
        assert len(cut.path) == cut.evaluations
        assert cut.value >= cut.start_value
    assert design.optimize(COARSE, max_evaluations=5).evaluations == 5
    first = design.optimize(COARSE, simplex=0.05, max_evaluations=5).path[:3, :2]
    np.testing.assert_allclose(first[1:] - first[0], np.diag([0.05, 0.05]), atol=1e-12)


def test_impossible_arguments_are_named() -> None:
    of_both = {"seed": -1, "constraints": math.sin}
    of_one = {"max_evaluations": 0, "simplex": math.inf, "start": (1.5, 1.5, 1.0)}
    searches: list[tuple[Any, dict[str, Any]]] = [
        (design.optimize, of_both | of_one),
        (design.optimize, {"start": "ab"}),
        (design.optimize_globally, of_both | {"population": 0}),
    ]
    for search, arguments in searches:
        for name, value in arguments.items():
            with pytest.raises(DesignError, match=name):
                search(COARSE, **{name: value})
    with pytest.raises(DesignError, match=r"lambda1 = 1\.5: must be a list of numbers"):
        design.atlas(COARSE, 1.5, [1.5])  # type: ignore[arg-type]
    with pytest.raises(DesignError, match=r"heaves = 0\.2: must be a list"):
        design.at_heaves(COARSE, 0.2)  # type: ignore[arg-type]
    for wrong in ("a", None, [1.0]):
        for name, call in (
            ("lambda1", lambda each: design.atlas(COARSE, [1.5, each], [1.0])),
            ("heaves", lambda each: design.at_heaves(COARSE, [each])),
            ("heaves", lambda each: design.over_heaves(INITIAL, [each])),
        ):
            with pytest.raises(DesignError, match=rf"{name}\[[01]\] = .*: must be a number"):
                call(wrong)


def test_the_atlas_peaks_where_nelder_mead_ends(printed: design.Optimum) -> None:
    grid = design.atlas(COARSE, np.arange(1.2, 1.9, 0.06), np.arange(1.2, 2.0, 0.06))
    best = np.unravel_index(np.nanargmax(grid.value), grid.value.shape)
    assert grid.value[best] <= printed.value + 1e-9
    apart = grid.lambda1[best[0]] - printed.lambda1, grid.lambda2[best[1]] - printed.lambda2
    assert math.hypot(*apart) < 0.12
    i, j = 3, 4
    geometry = COARSE.geometry(grid.lambda1[i], grid.lambda2[j])
    assert grid.value[i, j] == design.workspace_area(geometry, COARSE)


def test_the_atlas_is_nan_exactly_outside_the_constraints_and_reports_progress() -> None:
    rows: list[tuple[int, int]] = []
    tiny = DesignProblem(cells=4)
    grid = design.atlas(
        tiny, [0.9, 1.5, 2.1], [0.5, 1.5, 2.6], progress=lambda done, of: rows.append((done, of))
    )
    for i, a in enumerate(grid.lambda1):
        for j, b in enumerate(grid.lambda2):
            c = 4.0 - a - b
            feasible = 0 < c < a < 2 and b > 0
            assert np.isfinite(grid.value[i, j]) == feasible
    assert rows == [(1, 3), (2, 3), (3, 3)]
    own = design.atlas(
        tiny,
        [1.5, 1.7],
        [1.5],
        objective=lambda g, *_: g.lambdas[0],
        constraints=[lambda g: 1.6 - g.lambdas[0]],
    )
    np.testing.assert_allclose(own.value, [[1.5], [math.nan]])


def test_a_start_without_workspace_is_an_error_not_a_flat_optimum() -> None:
    with pytest.raises(DesignError, match=r"objective 0 at heave 0.5 m.*start from a design"):
        design.optimize(DesignProblem(heaves=(0.5,)))
    with pytest.raises(DesignError, match="objective 0"):
        design.optimize_globally(DesignProblem(threshold=5.0), population=2, generations=1)
    elsewhere = DesignProblem(eta=0.2, distal_length=0.36, heaves=(0.46,), cells=30)
    with pytest.raises(DesignError, match="objective 0"):
        design.optimize(elsewhere)
    assert design.optimize_globally(elsewhere, population=8, generations=3).value > 0.5


@pytest.mark.parametrize(
    "start", [(2.5, 1.0), (1.0, 0.5), (1.0, 2.0), (1.5, -0.2), (math.nan, 1.0), (1.5, None)]
)
def test_a_start_outside_the_constraints_is_named(start: tuple[float, float]) -> None:
    with pytest.raises(GeometryError, match="lambda"):
        design.optimize(start=start)


def test_another_designers_objective_and_constraint() -> None:
    """Least platform radius, subject to a base no larger than 0.2 m and a workspace of 0.5."""

    def small_platform(geometry: RRSGeometry, problem: DesignProblem, samples: Samples) -> float:
        return max(0.0, 0.3 - geometry.platform_radius)

    def enough(geometry: RRSGeometry) -> float:
        return design.workspace_area(geometry, COARSE) - 0.5

    result = design.optimize(
        COARSE,
        (1.5, 1.6),
        objective=small_platform,
        constraints=[enough, lambda g: 0.2 - g.base_radius],
    )
    assert result.value > result.start_value
    assert enough(result.geometry) >= 0.0
    assert result.geometry.base_radius <= 0.2

    def kept(a: float, b: float) -> bool:
        if not (b > 0.0 and 0.0 < 4.0 - a - b < a < 2.0):
            return False
        geometry = COARSE.geometry(a, b)
        return enough(geometry) >= 0.0 and geometry.base_radius <= 0.2

    expected = [kept(a, b) for a, b, _ in result.path.tolist()]
    assert np.isfinite(result.path[:, 2]).tolist() == expected
    assert False in expected
    with pytest.raises(DesignError, match="breaks a constraint"):
        design.optimize(COARSE, constraints=[lambda _: math.nan])
    with pytest.raises(DesignError, match=r"objective is -1\.0"):
        design.optimize(COARSE, objective=lambda *_: -1.0)
    with pytest.raises(DesignError, match="breaks a constraint"):
        design.optimize(COARSE, constraints=[lambda g: 0.1 - g.base_radius])
    nothing: Any = None
    with pytest.raises(DesignError, match="objective is None"):
        design.optimize(COARSE, objective=lambda *_: nothing)
    with pytest.raises(DesignError, match="a constraint returns None"):
        design.optimize(COARSE, constraints=[lambda _: nothing])
    with pytest.raises(DesignError, match="objective is nan"):
        design.optimize(COARSE, objective=lambda *_: math.nan)


def test_the_global_search_keeps_a_designers_objective_and_constraint_to_its_end() -> None:
    """The nearest design to (1.8, 1.3) that has no lambda1 above 1.7."""

    def nearness(geometry: RRSGeometry, *_: Any) -> float:
        lambda1, lambda2 = geometry.lambdas[:2]
        return 4.0 - math.hypot(lambda1 - 1.8, lambda2 - 1.3)

    def search(seed: int) -> design.Optimum:
        return design.optimize_globally(
            COARSE,
            objective=nearness,
            constraints=[lambda g: 1.7 - g.lambdas[0]],
            seed=seed,
            population=6,
            generations=10,
        )

    found = search(0)
    assert (found.lambda1, found.lambda2) == pytest.approx((1.7, 1.3), abs=5e-3)
    assert found.start_value == pytest.approx(nearness(INITIAL))
    assert np.isclose(found.path[:12, :2], INITIAL.lambdas[:2]).all(axis=1).any()
    np.testing.assert_array_equal(found.path, search(0).path)
    assert not np.isin(found.path[:12, 0], search(1).path[:12, 0]).all()


def test_other_limits_heave_and_threshold_reach_the_search() -> None:
    strict = DesignProblem(
        cells=60, threshold=0.3, heaves=(0.22,), joint_min=math.radians(20), joint_max=1.2
    )
    result = design.optimize(strict)
    metrics = design.measure(result.geometry, strict)
    assert math.radians(20) <= metrics.joint_low <= metrics.joint_high <= 1.2
    inside = design.workspace_map(result.geometry, strict)
    assert inside.sigma[inside.inside].min() >= 0.3
    assert result.geometry.home_heave == 0.22


def test_a_design_for_a_band_of_heave_has_no_cliff_in_it(printed: design.Optimum) -> None:
    band = design.at_heaves(COARSE, [0.20, 0.23, 0.25])
    robust = design.optimize(band)
    low, home = design.over_heaves(robust.geometry, [0.20, 0.21], COARSE)
    assert low > 0.95 * home
    assert robust.value > 1.5 * design.workspace_area(printed.geometry, band)


def test_what_is_found_can_heave() -> None:
    """In a range as narrow as a nanometre no start of the task could."""
    result = design.optimize(DesignProblem(cells=30, heaves=(0.231,)), max_evaluations=30).geometry
    assert result.home_heave == 0.231
    assert (result.heave_min, result.heave_max) == (INITIAL.heave_min, INITIAL.heave_max)
    wide = DesignProblem(heaves=(0.22, 0.2, 0.26)).geometry(1.5, 1.6)
    assert (wide.heave_min, wide.home_heave, wide.heave_max) == (0.2, 0.22, 0.26)
    heaves = [CoopInsertionEnv(result).reset(seed=seed)[0][5] for seed in range(8)]
    assert np.ptp(heaves) > 0.1
