"""Analyses of a design: the paper's table, sensitivity, and a test trajectory.

Sensitivity is how much the workspace depends on heave and on errors of the lengths. Along the
trajectory the joints should stay within their limits, and move smoothly.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from coop_env.design.problem import (
    PAPER_PROBLEM,
    DesignError,
    DesignProblem,
    Floats,
    Samples,
    workspace_area,
    workspace_map,
)
from coop_env.errors import check_integer, check_list, check_number
from coop_env.geometry import GeometryError, RRSGeometry
from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import roll_pitch, tilt_azimuth

#: Tilt of the fixed cone over which the least sigma_min is compared, rad.
CONE = math.radians(28.0)
LENGTHS = ("base_radius", "proximal_length", "platform_radius", "distal_length")


@dataclass(frozen=True, slots=True)
class DesignMetrics:
    """The table's metrics; Omega is the connected component of home at home's heave.

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
    nan = math.nan  # sigma and kappa over the cone are NaN too if a pose of it is out of reach
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


def over_heaves(
    geometry: RRSGeometry, heaves: Sequence[float] | Floats, problem: DesignProblem = PAPER_PROBLEM
) -> Floats:
    """A_w ``(n,)`` in rad^2 at each heave; the sign of det A is still taken at the design's home.

    >>> from coop_env.geometry import OPTIMIZED
    >>> over_heaves(OPTIMIZED, [0.20, 0.21]).round(2).tolist()  # the cliff below home
    [0.57, 1.16]
    """
    check_list("heaves", heaves, "a list of heights", error=DesignError)
    each = (replace(problem, heaves=(heave,)) for heave in heaves)
    return np.array([workspace_area(geometry, at_heave) for at_heave in each])


def slopes(geometry: RRSGeometry, problem: DesignProblem = PAPER_PROBLEM) -> dict[str, float]:
    """Change of A_w, rad^2 per mm, by each length in turn (central difference of 0.5 mm).

    Raises:
        GeometryError: a machine with a length 0.5 mm off cannot be assembled.
    """

    def area(name: str, error: float) -> float:
        longer: dict[str, Any] = {name: getattr(geometry, name) + error}
        return workspace_area(replace(geometry, **longer), problem)

    return {name: area(name, 5e-4) - area(name, -5e-4) for name in LENGTHS}


def under_tolerances(
    geometry: RRSGeometry,
    tolerance: float,
    draws: int = 100,
    problem: DesignProblem = PAPER_PROBLEM,
) -> Floats:
    """A_w ``(draws,)`` with every length off by an independent uniform error of +-``tolerance`` m.

    The error of a length is the same on all three limbs, because the closed forms used here rest
    on their symmetry. Draws that break the paper's constraints count as zero.
    """
    check_number("tolerance", tolerance, 0.0, error=DesignError)
    check_integer("draws", draws, 0, error=DesignError)
    rng = np.random.default_rng(0)
    areas = np.zeros(draws)
    for i in range(draws):
        errors = rng.uniform(-tolerance, tolerance, len(LENGTHS))
        named = zip(LENGTHS, errors.tolist(), strict=True)
        try:
            built = replace(geometry, **{n: getattr(geometry, n) + error for n, error in named})
        except GeometryError:
            continue
        areas[i] = workspace_area(built, problem)
    return areas


@dataclass(frozen=True, slots=True)
class PlatformTrajectory:
    """Poses ``(n, 3)`` of (roll, pitch, heave) at times ``(n,)`` in s."""

    time: Floats
    poses: Floats


@dataclass(frozen=True, slots=True)
class TrajectoryReport:
    """Metrics of a design along a trajectory; angles in rad, rates in rad/s.

    Attributes:
        valid: every pose reachable, within the joint limits, and on home's side of det A.
        q: actuated angles ``(n, 3)``.
        joint_low: least actuated angle.
        joint_high: greatest.
        excursion: largest travel of one joint.
        peak_rate: largest joint rate, from the Jacobian.
        peak_acceleration: largest joint acceleration, rad/s^2.
        log_jerk: log dimensionless jerk of the joint path, ``ln(T^3 / v^2 * integral jerk^2)`` with
            v the peak speed in joint space; less is smoother.
        sigma_min: least signed sigma_min on the way.
        kappa_max: greatest condition number on the way.
        forward_error: largest error of forward kinematics followed along q, rad or m.
    """

    valid: bool
    q: Floats
    joint_low: float
    joint_high: float
    excursion: float
    peak_rate: float
    peak_acceleration: float
    log_jerk: float
    sigma_min: float
    kappa_max: float
    forward_error: float


def _smoothstep(x: Floats) -> Floats:
    """Smooth step from 0 to 1: the first three derivatives vanish at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)


def cone_trajectory(
    tilt: float = math.radians(22.0),
    heave: tuple[float, float] = (0.21, 0.22),
    duration: float = 12.0,
) -> PlatformTrajectory:
    """From home, tilt, sweep the normal twice about the cone while heave rises and falls, and
    return home; smooth up to the third rate.

    Raises:
        DesignError: tilt not in (0, pi/2), a heave that is none, or no duration.
    """
    if not 0.0 < check_number("tilt", tilt, error=DesignError) < math.pi / 2:
        raise DesignError(f"tilt = {tilt!r} rad: must lie in (0, pi/2)")
    ends = check_list("heave", heave, "a list of the lowest and the highest", 2, DesignError)
    low, high = (check_number("a height of heave", h, error=DesignError) for h in ends)
    check_number("duration", duration, 0.0, above=True, error=DesignError)
    time = np.linspace(0.0, duration, 1201)
    u = time / duration
    lean = tilt * _smoothstep(u / 0.25) * _smoothstep((1.0 - u) / 0.25)
    azimuth = 4.0 * math.pi * _smoothstep(u)
    n = np.stack(
        [np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)], axis=-1
    )
    height = low + (high - low) * np.sin(math.pi * _smoothstep(u)) ** 2
    return PlatformTrajectory(time, np.concatenate([roll_pitch(n), height[:, None]], axis=-1))


def validate(
    geometry: RRSGeometry, trajectory: PlatformTrajectory | None = None
) -> TrajectoryReport:
    """Run a design along a trajectory: by default the cone from its home heave 10 mm upwards.

    Unreachable poses make ``valid`` False and leave NaN in q and in the figures.

    Raises:
        DesignError: the trajectory has fewer than three samples.

    >>> from coop_env.geometry import OPTIMIZED
    >>> validate(OPTIMIZED).valid
    True
    """
    if trajectory is None:
        home = geometry.home_heave
        trajectory = cone_trajectory(heave=(home, min(home + 0.01, geometry.heave_max)))
    time, poses = trajectory.time, trajectory.poses
    if len(time) < 3:
        raise DesignError(f"a trajectory of {len(time)} samples: three at least have a jerk")
    q, reachable = rrs.inverse(poses, geometry)
    sigma = rrs.signed_sigma_min(poses, geometry)
    rates = rrs.joint_rates(poses, np.gradient(poses, time, axis=0, edge_order=2), geometry)
    acceleration = np.gradient(rates, time, axis=0, edge_order=2)
    jerk = np.gradient(acceleration, time, axis=0, edge_order=2)
    speed = np.linalg.norm(rates, axis=-1).max()
    cost = trapezoid(np.sum(jerk**2, axis=-1), time) * (time[-1] - time[0]) ** 3 / speed**2
    margin = rrs.joint_margin(poses, geometry)
    return TrajectoryReport(
        valid=bool(reachable.all() and (margin >= 0.0).all() and (sigma > 0.0).all()),
        q=q,
        joint_low=float(q.min()),
        joint_high=float(q.max()),
        excursion=float(np.ptp(q, axis=0).max()),
        peak_rate=float(np.abs(rates).max()),
        peak_acceleration=float(np.abs(acceleration).max()),
        log_jerk=float(np.log(cost)),
        sigma_min=float(sigma.min()),
        kappa_max=float(rrs.condition_number(poses, geometry).max()),
        forward_error=_follow(geometry, poses, q),
    )


def _follow(geometry: RRSGeometry, poses: Floats, q: Floats) -> float:
    """Largest error of forward kinematics that is given only the first pose and the joints."""
    worst, pose = 0.0, poses[0]
    for angles, expected in zip(q, poses, strict=True):
        pose, _, converged = rrs.forward(angles, pose, geometry)
        if not converged:
            return math.nan
        worst = max(worst, float(np.abs(pose - expected).max()))
    return worst
