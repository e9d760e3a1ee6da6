"""The two robots' dimensions, as frozen dataclasses that cannot hold an impossible machine.

The paper prints no dimensions. :data:`INITIAL` and :data:`OPTIMIZED` were fitted to its headline
figures (workspace 0.82 to 1.16 rad^2), so they do not confirm them; see ``docs/fidelity.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from coop_env.errors import as_dataclass, keep_number

MAX_JOINT_VELOCITY: Final = 2.61
"""rad/s. The paper names no drives. These limits are published for joints 6 and 7 of the Franka
Panda (Franka Control Interface, robot limits), whose torque of 12 N m is nearest to the twin's."""
MAX_JOINT_ACCELERATION: Final = 20.0
"""rad/s^2, from the same table."""
MAX_JOINT_JERK: Final = 10_000.0
"""rad/s^3, from the same table."""


class GeometryError(ValueError):
    """A geometry that cannot be built or assembled; the message names the value and the fix."""


@dataclass(frozen=True, slots=True)
class RRSGeometry:
    """Dimensions and limits of a 3-RRS with limbs at azimuths 0, 120 and 240 degrees.

    Lengths in m, angles in rad, joint limits in rad/s, rad/s^2 and rad/s^3 (see
    :data:`MAX_JOINT_VELOCITY`). ``base_radius`` and ``platform_radius`` run from the centre to the
    revolute and to the spherical joints. The lengths obey the paper's equation (constraints):
    ``platform_radius < base_radius < 2 eta``.

    Raises:
        GeometryError: a length or limit is not finite, out of order, or breaks the constraints.
    """

    base_radius: float
    proximal_length: float
    platform_radius: float
    distal_length: float = 0.225
    joint_min: float = math.radians(12.0)
    joint_max: float = math.radians(78.0)
    max_tilt: float = math.pi / 4
    heave_min: float = 0.21
    heave_max: float = 0.25
    home_heave: float = 0.21
    max_joint_velocity: float = MAX_JOINT_VELOCITY
    max_joint_acceleration: float = MAX_JOINT_ACCELERATION
    max_joint_jerk: float = MAX_JOINT_JERK

    def __post_init__(self) -> None:
        for name in self.__slots__:
            signed = name in ("joint_min", "joint_max", "max_tilt", "heave_max")
            least = -math.inf if signed else 0.0
            keep_number(self, name, least, above=not signed, error=GeometryError)
        for low, high in (("joint_min", "joint_max"), ("heave_min", "heave_max")):
            a, b = getattr(self, low), getattr(self, high)
            if not a < b:
                raise GeometryError(f"{low} = {a!r} must be below {high} = {b!r}")
        if not self.heave_min <= self.home_heave <= self.heave_max:
            raise GeometryError(
                f"home_heave = {self.home_heave!r} m: must lie from heave_min = {self.heave_min!r} "
                f"to heave_max = {self.heave_max!r}"
            )
        if not 0.0 < self.max_tilt < math.pi / 2:
            raise GeometryError(f"max_tilt = {self.max_tilt!r} rad: must lie in (0, pi/2)")
        lambda1, _, lambda3 = self.lambdas
        if not lambda3 < lambda1:
            raise GeometryError(
                f"lambda3 = {lambda3:.4g} is not below lambda1 = {lambda1:.4g}: "
                "the platform must be smaller than the base (lower platform_radius)"
            )
        if not lambda1 < 2.0:
            raise GeometryError(
                f"lambda1 = {lambda1:.4g} is not below 2: base_radius = {self.base_radius:.4g} m "
                f"must be below 2 proximal_length + platform_radius = "
                f"{2.0 * self.proximal_length + self.platform_radius:.4g} m"
            )

    @property
    def characteristic_length(self) -> float:
        """eta = (Rb + 2 L1 + Rp) / 4 in m, the paper's scale; also the Jacobian's length."""
        return (self.base_radius + 2.0 * self.proximal_length + self.platform_radius) / 4.0

    @property
    def lambdas(self) -> tuple[float, float, float]:
        """The paper's dimensionless design vector (Rb, 2 L1, Rp) / eta; it sums to 4."""
        eta = self.characteristic_length
        return self.base_radius / eta, 2.0 * self.proximal_length / eta, self.platform_radius / eta

    @classmethod
    def from_lambdas(
        cls, lambda1: float, lambda2: float, eta: float = 0.1235, **limits: float
    ) -> RRSGeometry:
        """The geometry of a design vector; lambda3 = 4 - lambda1 - lambda2.

        Args:
            lambda1: base radius over eta.
            lambda2: twice the proximal length over eta.
            eta: characteristic length, m.
            limits: any other field of the class (``distal_length``, ``joint_max``, ...).

        Raises:
            GeometryError: the paper's constraints are broken.
        """
        lambda3 = 4.0 - lambda1 - lambda2
        for name, value in (("lambda1", lambda1), ("lambda2", lambda2), ("lambda3", lambda3)):
            if not (math.isfinite(value) and value > 0.0):
                raise GeometryError(
                    f"{name} = {value!r}: lambda1, lambda2 and lambda3 = 4 - lambda1 - lambda2 "
                    "must all be above zero"
                )
        return cls(lambda1 * eta, lambda2 * eta / 2.0, lambda3 * eta, **limits)


@dataclass(frozen=True, slots=True)
class DeltaGeometry:
    """Dimensions of a Delta robot with limbs at azimuths 0, 120 and 240 degrees; lengths in m.

    ``proximal_length`` is the paper's active rod l_a, ``distal_length`` its passive rod l_p;
    the radii run from the centre to the joints. ``base_height`` places the Delta's base frame
    above the 3-RRS's on their common axis. The peg hangs ``peg_length`` below the effector. Joint
    limits are in rad/s, rad/s^2 and rad/s^3, see :data:`MAX_JOINT_VELOCITY`.

    Raises:
        GeometryError: a length or limit is not finite and positive, or the robot cannot be
            assembled.
    """

    base_radius: float = 0.12
    effector_radius: float = 0.04
    proximal_length: float = 0.20
    distal_length: float = 0.45
    base_height: float = 0.85
    peg_length: float = 0.08
    peg_radius: float = 0.004
    max_joint_velocity: float = MAX_JOINT_VELOCITY
    max_joint_acceleration: float = MAX_JOINT_ACCELERATION
    max_joint_jerk: float = MAX_JOINT_JERK

    def __post_init__(self) -> None:
        for name in self.__slots__:
            keep_number(self, name, 0.0, above=True, error=GeometryError)
        if self.distal_length <= self.proximal_length:
            raise GeometryError(
                f"distal_length = {self.distal_length:.4g} m must exceed "
                f"proximal_length = {self.proximal_length:.4g} m, or the effector cannot hang below"
            )
        if self.peg_length <= self.peg_radius:
            raise GeometryError(
                f"peg_length = {self.peg_length:.4g} m must exceed "
                f"peg_radius = {self.peg_radius:.4g} m, the radius of its tip"
            )
        # on the axis, and so anywhere, at least one limb has to span this and l_p - l_a downwards
        across = abs(self.base_radius - self.effector_radius)
        most = 2.0 * math.sqrt(self.proximal_length * self.distal_length)
        if not across < most:
            raise GeometryError(
                f"base_radius and effector_radius differ by {across:.4g} m: must be less than "
                f"2 sqrt(proximal_length distal_length) = {most:.4g} m, or the limbs reach no "
                "point of the workspace"
            )

    @property
    def planar_limit(self) -> float:
        """r_max = 0.8 min(l_a, l_p) in m (paper, equation delta-ws)."""
        return 0.8 * min(self.proximal_length, self.distal_length)


#: the paper's initial design
INITIAL: Final = RRSGeometry(base_radius=0.2068, proximal_length=0.0893, platform_radius=0.1086)
#: the paper's optimized design
OPTIMIZED: Final = RRSGeometry(base_radius=0.1778, proximal_length=0.1024, platform_radius=0.1114)
#: the standard Delta
DELTA: Final = DeltaGeometry()
#: the designs by the names that the environment takes
GEOMETRIES: Final = MappingProxyType({"initial": INITIAL, "optimized": OPTIMIZED})


def resolve_rrs(value: Any) -> RRSGeometry:
    """A 3-RRS from a name of :data:`GEOMETRIES`, a geometry, or its fields."""
    return as_dataclass("geometry", value, RRSGeometry, GEOMETRIES)


def resolve_delta(value: Any) -> DeltaGeometry:
    """A Delta from None (the standard one), a geometry, or its fields."""
    return as_dataclass("delta", value, DeltaGeometry, {None: DELTA})
