"""The scalar 3-RRS kernels, against golden data, a second formulation, and the mechanism itself."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coop_env.geometry import GEOMETRIES, RRSGeometry
from coop_env.kinematics import rrs_kernels as kernels
from tests.coop_env.kinematics import reference

GOLDEN = Path(__file__).with_name("rrs_golden.csv").read_text().splitlines()
PARAMS = {name: kernels.make_params(g) for name, g in GEOMETRIES.items()}
TILT = st.floats(-0.7, 0.7)


def _rotation(pose: kernels.Pose) -> np.ndarray:
    return np.array(pose[3:]).reshape(3, 3)


@pytest.mark.parametrize("row", list(csv.DictReader(GOLDEN)), ids=lambda row: row["geometry"])
def test_golden_row(row: dict[str, str]) -> None:
    p = PARAMS[row["geometry"]]
    roll, pitch, heave = (float(row[name]) for name in ("roll", "pitch", "heave"))
    pose = kernels.platform_pose(roll, pitch, heave, p)
    reachable, q = kernels.inverse(pose, p)
    assert reachable == bool(int(row["reachable"]))
    assert (pose.x, pose.y) == pytest.approx((float(row["x"]), float(row["y"])), abs=1e-9)
    expected = [float(row[f"R{i}{j}"]) for i in range(3) for j in range(3)]
    assert list(pose[3:]) == pytest.approx(expected, abs=1e-9)
    angles = [float(row[f"q{i}"]) for i in range(3)]
    if reachable:
        assert list(q) == pytest.approx(angles, abs=1e-9)
    else:
        assert any(math.isnan(angle) for angle in q)
    sigma = kernels.sigma_at(roll, pitch, heave, p)
    assert sigma == pytest.approx(float(row["sigma_min_signed"]), abs=1e-9, nan_ok=True)


@settings(max_examples=200)
@given(name=st.sampled_from(sorted(GEOMETRIES)), roll=TILT, pitch=TILT, heave=st.floats(0.21, 0.25))
def test_limbs_close_and_stay_in_their_planes(
    name: str, roll: float, pitch: float, heave: float
) -> None:
    g, p = GEOMETRIES[name], PARAMS[name]
    pose = kernels.platform_pose(roll, pitch, heave, p)
    reachable, q = kernels.inverse(pose, p)
    rotation, centre = _rotation(pose), np.array(pose[:3])
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    for i, (u, t) in enumerate(zip(reference.RADIAL, reference.TANGENTIAL, strict=True)):
        joint = centre + g.platform_radius * rotation @ u
        assert abs(t @ joint) < 1e-14
        if reachable:
            crank = np.cos(q[i]) * u + np.array([0.0, 0.0, np.sin(q[i])])
            elbow = g.base_radius * u + g.proximal_length * crank
            assert abs(np.linalg.norm(joint - elbow) - g.distal_length) < 1e-12


def test_a_joint_too_near_its_base_is_unreachable_though_the_paper_lets_it_pass() -> None:
    g = RRSGeometry(base_radius=0.17, proximal_length=0.06, platform_radius=0.165, heave_min=0.1)
    p = kernels.make_params(g)
    near = g.distal_length - g.proximal_length - 0.01
    assert abs(near - g.proximal_length) <= g.distal_length  # the paper's condition holds
    assert not kernels.inverse(kernels.platform_pose(0.0, 0.0, near, p), p)[0]


def test_the_papers_pose_takes_the_joints_out_of_their_planes_by_a_quarter_radius() -> None:
    p, angle = kernels.make_params(GEOMETRIES["optimized"], "paper"), math.radians(30)
    pose = kernels.platform_pose(angle, angle, 0.21, p)
    expected = Rotation.from_euler("XY", [angle, angle]).as_matrix()
    assert _rotation(pose) == pytest.approx(expected)
    out = _rotation(pose)[1, 0] + pose.y  # t_0 . (P + R u_0), per unit of Rp
    assert out == pytest.approx(0.25, abs=1e-12)
