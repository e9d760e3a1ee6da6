"""The Delta: inverse against forward, Jacobian against differences, workspace, bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coop_env.geometry import DELTA, DeltaGeometry, GeometryError
from coop_env.kinematics import delta, delta_kernels
from tests.coop_env.kinematics.reference import FOLDING, RADIAL

OTHER = DeltaGeometry(base_radius=0.2, effector_radius=0.05, proximal_length=0.3, distal_length=0.7)


def _reached(g: DeltaGeometry, seed: int) -> np.ndarray:
    """Positions (n, 3) within the paper's bounds that all limbs reach, in any assembly mode."""
    r, low = g.planar_limit, -(g.proximal_length + g.distal_length)
    high = -abs(g.proximal_length - g.distal_length)
    points = np.random.default_rng(seed).uniform([-r, -r, low], [r, r, high], (50_000, 3))
    inside = (delta.workspace_margin(points, g) > 0) & (delta.limb_margin(points, g) > 0).all(-1)
    return points[inside]


def _positions(count: int, seed: int = 0, geometry: DeltaGeometry = DELTA) -> np.ndarray:
    points = _reached(geometry, seed)
    points = points[delta.is_valid(points, geometry)][:count]
    assert len(points) == count
    return points


def _drawn(seed: int) -> DeltaGeometry:
    """A Delta of any lengths; some have upright knees' planes."""
    rng = np.random.default_rng(seed)
    reach = rng.uniform(0.15, 0.4) * np.array([1.0, rng.uniform(1.02, 1.4)])
    return DeltaGeometry(*rng.uniform(0.05, 0.25, 2), *reach)


@pytest.mark.parametrize("geometry", [DELTA, OTHER, FOLDING], ids=["default", "other", "folding"])
def test_forward_undoes_inverse_over_the_workspace(geometry: DeltaGeometry) -> None:
    points = _positions(5000, geometry=geometry)
    theta, reachable = delta.inverse(points, geometry)
    assert reachable.all()
    result = delta.forward(theta, geometry)
    assert result.reachable.all()
    # at the edge of reach the map q -> x is steep: a rounding error grows by 1 / sqrt(margin)
    np.testing.assert_allclose(result.position, points, atol=1e-9)
    assert result.residual.max() < 1e-12


@pytest.mark.parametrize("geometry", [DELTA, FOLDING, *map(_drawn, range(8))])
def test_valid_places_are_those_that_home_leads_to(geometry: DeltaGeometry) -> None:
    """Those of the paper's Delta are all; what lies beyond a parallel singularity is not valid."""
    points = _reached(geometry, seed=4)
    valid, sigma = delta.is_valid(points, geometry), delta.signed_sigma_min(points, geometry)
    np.testing.assert_array_equal(valid, sigma > 0)
    assert geometry is not DELTA or valid.all()
    assert geometry is not FOLDING or (~valid).sum() > 10
    away = valid & (sigma > 1e-3)  # forward kinematics is steep beside a singularity
    result = delta.forward(delta.inverse(points[away], geometry).theta, geometry)
    np.testing.assert_allclose(result.position, points[away], atol=1e-7)


def test_links_have_their_lengths_and_knees_point_out() -> None:
    points = _positions(2000, seed=1)
    base, knee, wrist = np.moveaxis(delta.limb_points(points), 2, 0)
    chord, to_knee = wrist - base, knee - base
    proximal, distal = (np.linalg.norm(link, axis=-1) for link in (to_knee, wrist - knee))
    np.testing.assert_allclose(proximal, DELTA.proximal_length, atol=1e-12)
    np.testing.assert_allclose(distal, DELTA.distal_length, atol=1e-12)
    # of the two knees that close a limb, the one further out
    radial, knee_radial = (np.einsum("nia,ia->ni", way, RADIAL) for way in (chord, to_knee))
    outward = knee_radial * -chord[..., 2] + to_knee[..., 2] * radial
    assert (outward > -1e-12).all()


def test_jacobian_is_the_derivative_of_the_inverse() -> None:
    points = _positions(500, seed=3)
    points = points[delta.limb_margin(points).min(axis=-1) > 0.05]
    h = 1e-4
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * h)
    steps = h * np.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * np.eye(3)
    theta = delta.inverse(points[:, None, None] + steps).theta
    numeric = DELTA.proximal_length * np.einsum("j,njki->nik", weights, theta)
    np.testing.assert_allclose(delta.jacobian(points), numeric, atol=1e-6, rtol=1e-6)
    values = np.linalg.svd(delta.jacobian(points), compute_uv=False)
    np.testing.assert_allclose(np.abs(delta.signed_sigma_min(points)), values[:, 2], rtol=1e-12)
    np.testing.assert_allclose(delta.condition_number(points), values[:, 0] / values[:, 2])


@given(x=st.floats(-0.15, 0.15), y=st.floats(-0.15, 0.15), z=st.floats(-0.6, -0.26))
@settings(max_examples=150)
def test_turning_by_120_degrees_permutes_the_limbs(x: float, y: float, z: float) -> None:
    c, s = np.cos(2 * np.pi / 3), np.sin(2 * np.pi / 3)
    a, ok_a = delta.inverse([x, y, z])
    b, ok_b = delta.inverse([c * x - s * y, s * x + c * y, z])
    assert ok_a == ok_b or delta.limb_margin([x, y, z]).min() < 1e-9
    if ok_a and ok_b:
        np.testing.assert_allclose(b, np.roll(a, 1), atol=1e-7)


def test_the_workspace_is_the_papers_with_its_sign_mended() -> None:
    inside = [[0.0, 0.0, -0.5], [0.0, 0.0, -0.26], [0.159, 0.0, -0.45]]
    outside = [[0.0, 0.0, -0.24], [0.0, 0.0, -0.66], [0.161, 0.0, -0.45], [0.0, 0.0, 0.3]]
    assert delta.is_valid(inside).all()
    assert not delta.is_valid(outside).any()
    assert (delta.workspace_margin(inside) > 0).all()
    assert (delta.workspace_margin(outside) < 0).all()


def test_a_batch_is_a_loop_and_the_kernel_to_the_bit() -> None:
    points = np.random.default_rng(5).uniform([-0.3, -0.3, -0.7], [0.3, 0.3, -0.1], (300, 3))
    p = delta_kernels.make_params(DELTA)
    theta, reachable = delta.inverse(points)
    assert 0 < reachable.sum() < 300
    result, valid = delta.forward(theta), delta.is_valid(points)
    for i, (x, y, z) in enumerate(points.tolist()):
        ok, angles = delta_kernels.inverse(x, y, z, p)
        assert ok == reachable[i] == result.reachable[i]
        if ok:
            assert angles == tuple(theta[i])
            assert delta_kernels.forward(angles, p)[1] == tuple(result.position[i])
        assert delta_kernels.is_valid(x, y, z, p) == valid[i]
        np.testing.assert_array_equal(delta.jacobian(points)[i], delta.jacobian(points[i]))


@pytest.mark.parametrize(
    "theta", [[np.nan, 0.0, 0.0], [np.pi, np.pi, -np.pi / 2], [0.0, np.pi / 2, -np.pi / 2]]
)
def test_limbs_that_cannot_meet_say_so(theta: list[float]) -> None:
    short = DeltaGeometry(0.3, 0.04, proximal_length=0.26, distal_length=0.28)
    result = delta.forward(theta, short)
    assert not result.reachable
    assert np.isnan([*result.position, result.residual]).all()


def test_bad_input() -> None:
    with pytest.raises(delta.ShapeError, match="position has shape"):
        delta.inverse([0.0, 0.0])
    with pytest.raises(delta.ShapeError, match="theta has shape"):
        delta.forward(np.zeros((3, 4)))
    with pytest.raises(TypeError, match="real numbers"):
        delta.inverse("x")
    for bad in ([np.nan, 0.0, -0.5], [0.0, 0.0, -0.9], [0.0, 0.0, -np.inf]):
        theta, reachable = delta.inverse(bad)
        assert not reachable
        assert np.isnan(theta).all()
        assert np.isnan(delta.jacobian(bad)).all()
        assert np.isnan(delta.signed_sigma_min(bad))
        assert not delta.is_valid(bad)


def test_a_delta_is_refused_where_its_limbs_reach_nothing() -> None:
    """The widest base that is not refused reaches a point."""
    most = 2.0 * np.sqrt(DELTA.proximal_length * DELTA.distal_length)
    wide = DeltaGeometry(base_radius=DELTA.effector_radius + 0.999 * most)
    z = np.linspace(-0.65, -0.25, 2001)
    points = np.column_stack([np.zeros((len(z), 2)), z])
    reached = points[delta.is_valid(points, wide)]
    assert len(reached) > 0
    found = delta.forward(delta.inverse(reached, wide).theta, wide)
    np.testing.assert_allclose(found.position, reached, atol=1e-9)
    with pytest.raises(GeometryError, match="reach no point"):
        DeltaGeometry(base_radius=DELTA.effector_radius + 1.001 * most)
