"""The figures of the paper's table of design results, measured on any design."""

import math
from dataclasses import dataclass

import numpy as np

from coop_env.design.problem import PAPER_PROBLEM, DesignProblem, Samples, workspace_map
from coop_env.geometry import RRSGeometry
from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import tilt_azimuth

#: Tilt of the fixed cone over which the least sigma_min is compared, rad.
CONE = math.radians(28.0)


@dataclass(frozen=True, slots=True)
class DesignMetrics:
    """What the table compares; Omega is the connected component of home at home's heave.

    Attributes:
        area: A_w, rad^2.
        sigma_cone: least signed sigma_min over the cone of 28 degrees tilt. Over Omega itself
            it is the threshold by definition.
        max_angle: largest \\|roll\\| or \\|pitch\\| in Omega, rad.
        kappa_variation: standard deviation of the condition number over Omega, relative to its
            mean.
        kappa_variation_cone: the same over the cone, which does not grow with Omega.
        joint_low: least actuated angle over Omega, rad.
        joint_high: greatest, rad.
    """

    area: float
    sigma_cone: float
    max_angle: float
    kappa_variation: float
    kappa_variation_cone: float
    joint_low: float
    joint_high: float


def measure(
    geometry: RRSGeometry, problem: DesignProblem = PAPER_PROBLEM, samples: Samples | None = None
) -> DesignMetrics:
    """The table's figures of a design; NaN where home itself is not in the workspace.

    Those over the cone are NaN where the grid does not reach its tilt, or has no cell within it.

    >>> from coop_env.geometry import INITIAL
    >>> round(measure(INITIAL).sigma_cone, 3)
    0.078
    """
    result = workspace_map(geometry, problem, samples)
    cone = tilt_azimuth(np.stack(result.samples, axis=-1))[..., 0] <= CONE
    covered = problem.extent >= CONE and bool(cone.any())
    nan = math.nan  # also where a pose of the cone is out of reach
    sigma_cone = float(result.sigma[cone].min()) if covered else nan
    if not result.inside.any():
        return DesignMetrics(0.0, sigma_cone, nan, nan, nan, nan, nan)
    roll, pitch = (angle[result.inside] for angle in result.samples)
    poses = np.stack([roll, pitch, np.full_like(roll, problem.home_heave)], axis=-1)
    q = rrs.inverse(poses, geometry, problem.pose_model).q
    return DesignMetrics(
        result.area,
        sigma_cone,
        float(np.abs(poses[:, :2]).max()),
        _variation(result.kappa[result.inside]),
        _variation(result.kappa[cone]) if covered else nan,
        float(q.min()),
        float(q.max()),
    )


def _variation(values: np.ndarray) -> float:
    return float(values.std() / values.mean())
