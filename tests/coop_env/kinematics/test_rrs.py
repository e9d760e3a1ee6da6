"""The batched 3-RRS library: one formula for batch, loop and kernel; rates, margins, bad input."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coop_env.geometry import GEOMETRIES, INITIAL, OPTIMIZED, RRSGeometry
from coop_env.kinematics import rrs, rrs_kernels
from tests.coop_env.kinematics import reference

POSE_FUNCTIONS: list[Callable[..., np.ndarray]] = [
    rrs.parasitic,
    rrs.plane_offset,
    rrs.is_valid,
    rrs.joint_margin,
    rrs.limb_margin,
    rrs.jacobian,
    rrs.signed_sigma_min,
    rrs.condition_number,
    rrs.twist_matrix,
    rrs.limb_points,
]


def _poses(*shape: int, seed: int = 0, spread: float = 0.75) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-spread, -spread, 0.2], [spread, spread, 0.26], size=(*shape, 3))


@pytest.mark.parametrize("function", POSE_FUNCTIONS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("pose_model", ["exact", "paper"])
def test_a_batch_is_a_loop(function: Callable[..., np.ndarray], pose_model: str) -> None:
    poses = _poses(5, 7)
    batch = function(poses, INITIAL, pose_model)
    loop = np.array([[function(p, INITIAL, pose_model) for p in row] for row in poses])
    assert batch.shape[:2] == (5, 7)
    np.testing.assert_array_equal(batch, loop)


def test_the_batch_is_the_scalar_kernel_to_the_bit() -> None:
    poses = _poses(500)
    p = rrs_kernels.make_params(OPTIMIZED)
    q, reachable = rrs.inverse(poses)
    sigma, valid = rrs.signed_sigma_min(poses), rrs.is_valid(poses)
    for i, (roll, pitch, heave) in enumerate(poses.tolist()):
        pose = rrs_kernels.platform_pose(roll, pitch, heave, p)
        ok, angles = rrs_kernels.inverse(pose, p)
        assert ok == reachable[i]
        if ok:
            assert angles == tuple(q[i])
            assert rrs_kernels.sigma_at(roll, pitch, heave, p) == sigma[i]
        else:
            assert np.isnan(q[i]).all()
            assert np.isnan(sigma[i])
        assert rrs_kernels.is_valid(roll, pitch, heave, p) == valid[i]


def test_strided_and_empty_batches() -> None:
    poses = _poses(40)
    np.testing.assert_array_equal(rrs.inverse(poses[::-3]).q, rrs.inverse(poses[::-3].copy()).q)
    np.testing.assert_array_equal(rrs.inverse(np.asfortranarray(poses)).q, rrs.inverse(poses).q)
    assert rrs.inverse(np.empty((0, 3))).q.shape == (0, 3)
    assert rrs.inverse(poses.astype(np.float32)).q.dtype == np.float64


@pytest.mark.parametrize("g", GEOMETRIES.values(), ids=GEOMETRIES)
def test_agrees_with_the_reference_over_a_grid(g: RRSGeometry) -> None:
    poses = _poses(3000, seed=8)
    state = reference.evaluate(poses, g)
    q, reachable = rrs.inverse(poses, g)
    pose = rrs.platform_pose(poses, g)
    np.testing.assert_allclose(pose.position, state.position, atol=1e-13)
    np.testing.assert_allclose(pose.rotation, state.rotation, atol=1e-13)
    np.testing.assert_array_equal(reachable, state.reachable)
    np.testing.assert_allclose(q[reachable], state.q[reachable], atol=1e-10)
    sigma = rrs.signed_sigma_min(poses, g)
    np.testing.assert_allclose(sigma, reference.signed_sigma_min(state, g), atol=1e-9)
    values = np.linalg.svd(rrs.jacobian(poses, g)[reachable], compute_uv=False)
    expected = np.linalg.svd(state.jacobian[reachable], compute_uv=False)
    np.testing.assert_allclose(values, expected, rtol=1e-8, atol=1e-8)
    kappa = rrs.condition_number(poses, g)[reachable]
    np.testing.assert_allclose(kappa, np.linalg.cond(state.jacobian[reachable]), rtol=1e-5)


@pytest.mark.parametrize("g", GEOMETRIES.values(), ids=GEOMETRIES)
def test_jacobian_and_joint_rates_are_the_derivative_of_the_inverse(g: RRSGeometry) -> None:
    """Moving along roll, pitch and heave; the twist is read off the reference's rotation."""
    h = 1e-5
    poses = _poses(500, seed=9, spread=0.7)
    poses = poses[rrs.limb_margin(poses, g).min(axis=-1) > 0.02]  # off type I singularities
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * h)
    steps = h * np.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * np.eye(3)
    state = reference.evaluate(poses[:, None, None] + steps, g)
    rates = np.einsum("j,njki->nki", weights, state.q)
    turning = np.einsum("j,njkab->nkab", weights, state.rotation)
    spin = turning @ np.swapaxes(reference.platform_pose(poses, g)[1], -1, -2)[:, None]
    rising = np.einsum("j,njk->nk", weights, state.position[..., 2]) / g.characteristic_length
    twists = np.stack([spin[..., 2, 1], spin[..., 0, 2], rising], axis=-1)
    moved = np.einsum("nij,nkj->nki", rrs.jacobian(poses, g), twists)
    np.testing.assert_allclose(moved, rates, atol=1e-6, rtol=1e-6)
    own = rrs.joint_rates(poses[:, None], np.eye(3), g)
    np.testing.assert_allclose(own, rates, atol=1e-6, rtol=1e-6)
    assert len(poses) > 300


def test_parasitic_x_y_yaw_rebuild_the_pose() -> None:
    poses = _poses(200, seed=4)
    position, rotation = reference.platform_pose(poses, OPTIMIZED)
    own = rrs.parasitic(poses)
    np.testing.assert_allclose(own[:, :2], position[:, :2], atol=1e-14)
    yaw = Rotation.from_matrix(rotation).as_euler("XYZ")[:, 2]
    np.testing.assert_allclose(np.sin(own[:, 2]), np.sin(yaw), atol=1e-12)


def test_margins_change_sign_where_validity_does() -> None:
    poses = _poses(3000, seed=6)
    q, reachable = rrs.inverse(poses)
    np.testing.assert_array_equal((rrs.limb_margin(poses) >= 0).all(axis=-1), reachable)
    inside = (q >= OPTIMIZED.joint_min) & (q <= OPTIMIZED.joint_max)
    np.testing.assert_array_equal(rrs.joint_margin(poses) >= 0, inside)
    within = (np.abs(poses[:, :2]) <= OPTIMIZED.max_tilt).all(axis=-1)
    within &= (poses[:, 2] >= 0.21) & (poses[:, 2] <= 0.25)
    expected = reachable & inside.all(axis=-1) & within
    np.testing.assert_array_equal(rrs.is_valid(poses), expected)


def test_bad_shapes_numbers_and_pose_models_are_named() -> None:
    for function, shape in itertools.product(POSE_FUNCTIONS, [(), (2,), (3, 2), (2, 0)]):
        with pytest.raises(rrs.ShapeError, match=r"pose has shape .* must be \(\.\.\., 3\)"):
            function(np.zeros(shape))
    wrong: list[Any] = ["abc", [None, 1.0, 2.0], [1j, 0.0, 0.2], [[1.0], [2.0, 3.0]]]
    for bad in wrong:
        with pytest.raises(TypeError, match="must be real numbers"):
            rrs.inverse(bad)
    for function in (rrs.forward, rrs.joint_rates):
        with pytest.raises(rrs.ShapeError, match="do not broadcast"):
            function(np.zeros((2, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="pose_model = 'papr'"):
        rrs.inverse([0.0, 0.0, 0.21], pose_model="papr")


@pytest.mark.parametrize(
    "bad",
    [[np.nan, 0.0, 0.21], [0.0, 0.0, np.inf], [0.0, 0.0, 0.9], [0.0, 0.0, 0.5], [0.0, 0.0, 0.01]],
)
def test_nan_and_out_of_reach_are_never_numbers(bad: list[float]) -> None:
    q, reachable = rrs.inverse(bad)
    assert not reachable
    assert np.isnan(q).all()
    assert not rrs.is_valid(bad)
    for function in (rrs.jacobian, rrs.signed_sigma_min, rrs.condition_number, rrs.joint_margin):
        assert np.isnan(function(bad)).all()
