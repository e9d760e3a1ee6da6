"""3-RRS forward kinematics: the inverse undone, and no silent jump of assembly mode."""

import numpy as np
import pytest

from coop_env.geometry import GEOMETRIES, RRSGeometry
from coop_env.kinematics import rrs

EVERY = pytest.mark.parametrize("g", GEOMETRIES.values(), ids=GEOMETRIES)


def _valid_poses(geometry: RRSGeometry, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = [-0.78, -0.78, 0.21], [0.78, 0.78, 0.25]
    poses = rng.uniform(low, high, size=(20 * count, 3))
    return poses[rrs.is_valid(poses, geometry)][:count]


@EVERY
@pytest.mark.parametrize("pose_model", ["exact", "paper"])
def test_undoes_the_inverse_from_the_pose_itself(g: RRSGeometry, pose_model: str) -> None:
    poses = _valid_poses(g, 2000, seed=1)
    q, reachable = rrs.inverse(poses, g, pose_model)
    result = rrs.forward(q, poses, g, pose_model)
    assert result.converged[reachable].all()
    np.testing.assert_allclose(result.pose[reachable], poses[reachable], atol=1e-12)
    assert (result.residual[reachable] < 1e-12).all()


@EVERY
def test_one_move_away_on_the_same_side_of_the_singularity(g: RRSGeometry) -> None:
    poses = _valid_poses(g, 4000, seed=2)
    rng = np.random.default_rng(3)
    step = rng.uniform([-0.03, -0.03, -0.02], [0.03, 0.03, 0.02], poses.shape)
    before = np.clip(poses + step, [-0.78, -0.78, 0.21], [0.78, 0.78, 0.25])
    side, other = rrs.signed_sigma_min(poses, g), rrs.signed_sigma_min(before, g)
    # Nearer to the singularity, the straight line in q may itself run across it.
    clear = rrs.is_valid(before, g) & (side * other > 0)
    clear &= np.minimum(np.abs(side), np.abs(other)) > 0.1
    result = rrs.forward(rrs.inverse(poses, g).q, before, g)
    assert clear.sum() > 1000
    assert result.converged[clear].all()
    np.testing.assert_allclose(result.pose[clear], poses[clear], atol=1e-9)


@EVERY
def test_from_afar_it_is_the_pose_or_the_branch_has_ended_in_a_singularity(g: RRSGeometry) -> None:
    """All pairs on home's side: the straight line in q either leads there, or ends on the way."""
    poses = _valid_poses(g, 6000, seed=7)
    poses = poses[rrs.signed_sigma_min(poses, g) > 0]
    before = np.random.default_rng(8).permutation(poses)
    goal, start = rrs.inverse(poses, g).q, rrs.inverse(before, g).q
    result = rrs.forward(goal, before, g)
    assert result.converged.mean() > 0.9
    np.testing.assert_allclose(result.pose[result.converged], poses[result.converged], atol=1e-8)
    assert np.isnan(result.pose[~result.converged]).all()
    assert (result.residual[~result.converged] > 1e-10).all()
    lost = np.flatnonzero(~result.converged)[:40]
    assert len(lost) == 40
    pose, alive = before[lost], np.ones(len(lost), dtype=bool)
    for fraction in np.linspace(0.0, 1.0, 1001)[1:]:
        result = rrs.forward(start[lost] + fraction * (goal[lost] - start[lost]), pose, g)
        alive &= result.converged
        pose = np.where(alive[:, None], result.pose, pose)
    assert not alive.any()  # in small steps it ends as well
    sigma = np.abs(rrs.signed_sigma_min(pose, g))
    assert sigma.max() < 0.1
    assert np.median(sigma) < 0.02


@EVERY
def test_two_assembly_modes_of_one_q_are_told_apart_by_the_previous_pose(g: RRSGeometry) -> None:
    """A pose beyond the singularity shares its q with another on home's side."""
    poses = _valid_poses(g, 6000, seed=6)
    beyond = poses[rrs.signed_sigma_min(poses, g) < -0.05]
    assert len(beyond) > 100
    q = rrs.inverse(beyond, g).q
    from_home = rrs.forward(q, [0.0, 0.0, 0.21], g)
    from_there = rrs.forward(q, beyond + np.array([1e-3, -1e-3, 1e-4]), g)
    np.testing.assert_allclose(from_there.pose, beyond, atol=1e-9)
    other = from_home.pose[from_home.converged]
    assert len(other) > 20
    assert (np.abs(other - beyond[from_home.converged]).max(axis=-1) > 1e-3).all()
    assert (from_home.residual[from_home.converged] < 1e-12).all()  # and it closes as well


@pytest.mark.parametrize(
    ("q", "previous"),
    [
        ([np.nan, 0.5, 0.5], [0.0, 0.0, 0.21]),
        ([np.inf, 0.5, 0.5], [0.0, 0.0, 0.21]),
        ([0.5, 0.5, 0.5], [np.nan, 0.0, 0.21]),
        ([0.5, 0.5, 0.5], [0.0, 0.0, 0.9]),
        ([1.5, 0.1, 0.1], [0.0, 0.0, 0.21]),
    ],
)
def test_hopeless_input_ends_in_nan_and_a_flag(q: list[float], previous: list[float]) -> None:
    result = rrs.forward(q, previous)
    assert not result.converged
    assert np.isnan(result.pose).all()
