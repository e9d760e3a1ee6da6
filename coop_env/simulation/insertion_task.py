"""The task's numbers as an argument of the environment, checked like the robots' geometry."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from coop_env.errors import ArgumentError, check_integer, check_list, check_number, keep_number

MAX_HOLES: Final = 32

PAPER_HOLES: Final = tuple(
    (math.radians(polar), math.radians(azimuth))
    for polar, azimuth in ((30, 45), (30, 135), (30, 225), (30, 315), (10, 0), (10, 180))
)
"""Four peripheral holes and two inner ones: polar angle and azimuth, rad."""

_MOST = {
    "dome_radius": 1.0,  # m
    "chamfer": 0.1,
    "tolerance": 0.1,
    "angle_tolerance": math.pi / 2,  # rad
    "linear_step": 0.2,
    "angular_step": 0.5,
    "heave_step": 0.2,
    "dt": 60.0,  # s
    "task_time": 1e6,
    "error_bound": 10.0,
    "effector_radius": 0.5,
    "forearm_radius": 0.1,
    "spoke_radius": 0.1,
    "limb_radius": 0.1,
    "start_tilt": math.pi / 2,
    "start_planar": 1.0,
    "singular_margin": 1.0,
}
_MAY_BE_ZERO = ("start_tilt", "start_planar", "singular_margin")


@dataclass(frozen=True, slots=True)
class InsertionTask:
    """Dome and holes, insertion criterion, moves, start states, bodies. Lengths m, angles rad.

    The defaults are the paper's task; ``docs/fidelity.md`` says which of them it leaves open.

    Attributes:
        holes: (polar angle, azimuth) of each hole on the dome, 1 to 32 of them.
        stage_0_holes: at the curriculum's stage 0 the first so many are active (or all).
        dome_radius: of the sphere about the platform's centre that bears the holes.
        chamfer: lead-in: the peg may enter the dome while its tip is nearer to a mouth than its
            radius plus this.
        tolerance: a tip less than this from the mouth is in it ...
        angle_tolerance: ... if the peg's axis is less than this from the hole's normal.
        singular_margin: a move to a signed sigma_min below this ends the episode.
        linear_step: one move along x, y, z of the Delta.
        angular_step: one move of roll or pitch.
        heave_step: one move of heave.
        dt: duration of a move, s.
        task_time: T_task of the reward's time bonus, s.
        start_tilt: bound of roll and pitch at the start.
        start_planar: bound of x and y at the start.
        start_clearance: least and largest height of the tip above the dome's apex at the start.
        start_sigma: least signed sigma_min at the start.
        error_bound: half-width of the normalized observation of hole - tip.
        effector_radius: collision sphere of the Delta's effector.
        forearm_radius: capsule of the Delta's distal links.
        spoke_radius: capsule of the platform's spokes.
        limb_radius: capsule of the 3-RRS's links.

    Raises:
        ArgumentError: a value is of the wrong kind, not finite or out of range.
    """

    holes: Sequence[Sequence[float]] = PAPER_HOLES
    stage_0_holes: int = 4
    dome_radius: float = 0.10
    chamfer: float = 0.010
    tolerance: float = 0.010
    angle_tolerance: float = math.radians(5.0)
    singular_margin: float = 0.05
    linear_step: float = 0.02
    angular_step: float = 0.03
    heave_step: float = 0.02
    dt: float = 0.2
    task_time: float = 60.0
    start_tilt: float = 0.5
    start_planar: float = 0.06
    start_clearance: Sequence[float] = (0.05, 0.15)
    start_sigma: float = 0.15
    error_bound: float = 0.15
    effector_radius: float = 0.04
    forearm_radius: float = 0.010
    spoke_radius: float = 0.008
    limb_radius: float = 0.008

    def __post_init__(self) -> None:
        for name, most in _MOST.items():
            keep_number(self, name, 0.0, most, above=name not in _MAY_BE_ZERO)
        keep_number(self, "start_sigma", self.singular_margin, 10.0)
        object.__setattr__(self, "holes", _holes(self.holes))
        first = check_integer("InsertionTask.stage_0_holes", self.stage_0_holes, 1)
        object.__setattr__(self, "stage_0_holes", first)
        name = "InsertionTask.start_clearance"
        low, high = check_list(name, self.start_clearance, "two numbers", 2)
        low = check_number(f"{name}[0]", low, 0.0, 1.0)
        high = check_number(f"{name}[1]", high, low, 1.0)
        object.__setattr__(self, "start_clearance", (low, high))

    @property
    def steps(self) -> tuple[float, float, float, float, float, float]:
        """One move along each axis (x, y, z, roll, pitch, heave)."""
        x, tilt = self.linear_step, self.angular_step
        return x, x, x, tilt, tilt, self.heave_step

    @property
    def hole_normals(self) -> tuple[tuple[float, float, float], ...]:
        """Outward unit normals in the platform's frame; mouths lie on the dome along them."""
        return tuple(_normal(polar, azimuth) for polar, azimuth in self.holes)

    def active_holes(self, stage: int) -> tuple[int, ...]:
        """1 for each hole that is active at the curriculum's stage 0 or 1, 0 for the others."""
        n = len(self.holes)
        first = n if stage else min(self.stage_0_holes, n)
        return (1,) * first + (0,) * (n - first)


def _holes(value: Any) -> tuple[tuple[float, float], ...]:
    name = "InsertionTask.holes"
    result = []
    for i, pair in enumerate(check_list(name, value, "pairs of polar angle and azimuth")):
        polar, azimuth = check_list(f"{name}[{i}]", pair, "two numbers", 2)
        polar = check_number(f"{name}[{i}] polar angle", polar, 0.0, math.pi / 2)
        azimuth = check_number(f"{name}[{i}] azimuth", azimuth, -2.0 * math.pi, 2.0 * math.pi)
        result.append((polar, azimuth))
    if not 1 <= len(result) <= MAX_HOLES:
        raise ArgumentError(f"{name} are {len(result)}: must be 1 to {MAX_HOLES}")
    for i, one in enumerate(result):  # by where they are: angles name the pole in many ways
        for j, other in enumerate(result[:i]):
            if math.dist(_normal(*one), _normal(*other)) < 1e-9:
                raise ArgumentError(f"{name}[{j}] = {other} and [{i}] = {one} are the same")
    return tuple(result)


def _normal(polar: float, azimuth: float) -> tuple[float, float, float]:
    """Outward unit normal of a hole, in the platform's frame."""
    s = math.sin(polar)
    return s * math.cos(azimuth), s * math.sin(azimuth), math.cos(polar)


PAPER_TASK: Final = InsertionTask()
"""The task of the paper and of ``docs/fidelity.md``."""
