"""Rotations, against scipy's; singular values, against LAPACK's; every worked example."""

import doctest
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from coop_env.kinematics import delta, rotations, rrs
from coop_env.kinematics.singularity import (
    determinant_3x3,
    is_manipulable,
    manipulability,
    singular_values_3x3,
)

ANGLES = np.random.default_rng(0).uniform(-1.2, 1.2, size=(4, 50, 3))


def test_euler_matrix_is_scipys() -> None:
    expected = Rotation.from_euler("XYZ", ANGLES.reshape(-1, 3)).as_matrix().reshape(4, 50, 3, 3)
    np.testing.assert_allclose(rotations.roll_pitch_yaw_matrix(ANGLES), expected, atol=1e-14)
    np.testing.assert_allclose(rotations.normal(ANGLES[..., :2]), expected[..., :, 2], atol=1e-14)


def test_tilt_matrix_is_the_shortest_rotation() -> None:
    n = rotations.normal(ANGLES[..., :2]).reshape(-1, 3)
    tilt = rotations.tilt_azimuth(ANGLES[..., :2]).reshape(-1, 2)
    turn = Rotation.from_matrix(rotations.tilt_matrix(n))
    np.testing.assert_allclose(turn.apply([0.0, 0.0, 1.0]), n, atol=1e-13)
    np.testing.assert_allclose(turn.magnitude(), tilt[:, 0], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(n[:, 1], n[:, 0]), tilt[:, 1], atol=1e-12)


def test_roll_pitch_undoes_normal_at_any_length() -> None:
    n = rotations.normal(ANGLES[..., :2])
    np.testing.assert_allclose(rotations.roll_pitch(3.0 * n), ANGLES[..., :2], atol=1e-13)


def test_angles_between_nearly_parallel_vectors_keep_their_digits() -> None:
    small = 1e-9
    assert rotations.angle_between([1.0, 0.0, 0.0], [np.cos(small), np.sin(small), 0.0]) == (
        pytest.approx(small, rel=1e-9)
    )
    assert rotations.angle_between([0.0, 0.0, 2.0], [0.0, 0.0, -5.0]) == pytest.approx(np.pi)


def test_bad_shapes_are_named() -> None:
    with pytest.raises(rotations.ShapeError, match="angles has shape"):
        rotations.normal([0.1, 0.2, 0.3])


@pytest.mark.parametrize("module", [rrs, delta, rotations], ids=lambda m: m.__name__)
def test_worked_examples(module: ModuleType) -> None:
    result = doctest.testmod(module)
    assert result.failed == 0
    own = [f for n, f in vars(module).items() if isinstance(f, FunctionType) and n[0] != "_"]
    assert result.attempted >= sum(f.__module__ == module.__name__ for f in own) >= 6


ENTRY = st.floats(-1e3, 1e3).map(lambda value: round(value, 9))  # squares must not underflow


def _rows(m: np.ndarray) -> Any:
    return tuple(map(tuple, m.tolist()))


@given(m=arrays(np.float64, (3, 3), elements=ENTRY))
@settings(max_examples=300)
def test_equal_to_lapack(m: np.ndarray) -> None:
    expected = np.linalg.svd(m, compute_uv=False)
    scale = max(expected[0], 1e-300)
    assert np.abs(np.array(singular_values_3x3(_rows(m))) - expected).max() <= 1e-13 * scale
    assert determinant_3x3(_rows(m)) == pytest.approx(
        float(np.linalg.det(m)), abs=1e-11 * max(1.0, scale**3)
    )


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0), (2.0, 2.0, 1e-12)])
def test_repeated_and_tiny_values_keep_their_digits(values: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        u, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        v, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        m = u @ np.diag(values) @ v.T
        assert singular_values_3x3(_rows(m)) == pytest.approx(values, abs=2e-15 * values[0] * 4)


def test_a_threshold_holds_where_the_signed_sigma_min_is_no_less() -> None:
    rng = np.random.default_rng(4)
    results = set()
    for _ in range(500):
        a, b, sign = _rows(rng.normal(size=(3, 3))), tuple(rng.normal(size=3)), rng.choice([-1, 1])
        j, sigma, _ = manipulability(a, b, sign)
        beyond_two = 0.5 * sum(singular_values_3x3(j)[:2])  # then the determinant is positive again
        for threshold in (0.15, 0.9999 * abs(sigma), 1.0001 * abs(sigma), beyond_two):
            results.add(sigma >= threshold)
            assert is_manipulable(a, b, sign, threshold) == (sigma >= threshold)
    assert results == {True, False}
    for limb in range(3):  # type I: J is infinite
        b = tuple(1.0 - np.eye(3)[limb])
        assert not is_manipulable(_rows(np.eye(3)), b, 1.0, 0.15)
        j, *others = manipulability(_rows(np.eye(3)), b, 1.0)
        assert np.isinf(j).all()
        assert np.isnan(others).all()
    flat = manipulability(_rows(np.diag([1.0, 2.0, 0.0])), (1.0, 1.0, 1.0), 1.0)  # type II
    assert flat[1:] == (0.0, np.inf)
