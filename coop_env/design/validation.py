"""A test trajectory on a design: do the joints stay within their limits, and move smoothly?"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid

from coop_env.design.problem import DesignError, Floats
from coop_env.geometry import RRSGeometry
from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import roll_pitch


@dataclass(frozen=True, slots=True)
class PlatformTrajectory:
    """Poses ``(n, 3)`` of (roll, pitch, heave) at times ``(n,)`` in s."""

    time: Floats
    poses: Floats


@dataclass(frozen=True, slots=True)
class TrajectoryReport:
    """What a design does along a trajectory; angles in rad, rates in rad/s.

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
    """0 to 1 with rates zero up to the third at both ends."""
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
        DesignError: tilt not in (0, pi/2).
    """
    if not 0.0 < tilt < math.pi / 2:
        raise DesignError(f"tilt = {tilt!r} rad: must lie in (0, pi/2)")
    time = np.linspace(0.0, duration, 1201)
    u = time / duration
    lean = tilt * _smoothstep(u / 0.25) * _smoothstep((1.0 - u) / 0.25)
    azimuth = 4.0 * math.pi * _smoothstep(u)
    n = np.stack(
        [np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)], axis=-1
    )
    low, high = heave
    height = low + (high - low) * np.sin(math.pi * _smoothstep(u)) ** 2
    return PlatformTrajectory(time, np.concatenate([roll_pitch(n), height[:, None]], axis=-1))


def validate(
    geometry: RRSGeometry, trajectory: PlatformTrajectory | None = None
) -> TrajectoryReport:
    """Run a design along a trajectory: by default the cone from its home heave 10 mm upwards.

    Unreachable poses make ``valid`` False and leave NaN in q and in the figures.

    >>> from coop_env.geometry import OPTIMIZED
    >>> validate(OPTIMIZED).valid
    True
    """
    if trajectory is None:
        home = geometry.home_heave
        trajectory = cone_trajectory(heave=(home, min(home + 0.01, geometry.heave_max)))
    time, poses = trajectory.time, trajectory.poses
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
    """Largest error of forward kinematics that knows only the first pose and then the joints."""
    worst, pose = 0.0, poses[0]
    for angles, expected in zip(q, poses, strict=True):
        pose, _, converged = rrs.forward(angles, pose, geometry)
        if not converged:
            return math.nan
        worst = max(worst, float(np.abs(pose - expected).max()))
    return worst
