"""Singular values and determinant of 3 x 3 matrices, against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from coop_env.kinematics.singularity import Matrix3, determinant_3x3, singular_values_3x3

ENTRY = st.floats(-1e3, 1e3).map(lambda value: round(value, 9))  # squares must not underflow


def _rows(m: np.ndarray) -> Matrix3:
    a, b, c, d, e, f, g, h, i = (float(value) for value in m.ravel())
    return (a, b, c), (d, e, f), (g, h, i)


@given(m=arrays(np.float64, (3, 3), elements=ENTRY))
@settings(max_examples=300, deadline=None)
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
