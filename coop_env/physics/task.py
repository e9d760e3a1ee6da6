"""The numbers of the contact task, with its three levels."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from coop_env.errors import (
    ArgumentError,
    ResetOptionError,
    as_dataclass,
    check_integer,
    check_list,
    check_number,
)
from coop_env.geometry import GeometryError
from coop_env.kinematics import delta, rrs
from coop_env.kinematics.rotations import roll_pitch, roll_pitch_yaw_matrix
from coop_env.physics.joints import Floats
from coop_env.physics.model import CONTACT_TIME, TIMESTEP, Machine, Peg

Options = dict[str, Any]
STANDARD_PEG: Final = Peg()
HEAVE_ROOM: Final = 0.005
"""Room for heave, up and down, at every start, m."""
_LARGEST: Final = {"position_error": 0.02, "tilt_error": 0.1, "effector_play": 0.1}  # m, rad
_LARGEST_ERROR: Final = (0.02, 0.02, 0.1, 0.1)  # of the option, m and rad
OWN_OPTIONS: Final = ("error", "friction")
"""Reset options that both tasks have."""


@dataclass(frozen=True, slots=True)
class ContactTask:
    """Insertion of one peg with an uncertain machine. SI units; its numbers are assumptions.

    Attributes:
        peg: fit of the peg and shape of its tip.
        position_error: radius of the disc from which the hole's displacement is drawn, m.
        tilt_error: bound of the hole's tilt about its mouth, to any side, rad.
        friction: least and largest coefficient, drawn per episode.
        force_noise: standard deviation of each observed force, N, after averaging.
        moment_noise: the same of each moment, N m.
        start_height: of the tip above the mouth where it is believed to be, m.
        insertion_depth: of the tip below the real mouth, a success, m; more pays nothing.
        linear_step: one increment along x and y, m.
        depth_step: one increment along z, m.
        angular_step: one increment of roll or pitch, rad.
        heave_step: one increment of heave, m.
        dt: control period, s; whole timesteps of the simulation.
        timestep: of the simulation, s.
        contact_time: time constant of a contact, s, which sets the forces; two timesteps at least.
        effector_play: tilt of the effector about x and y that its rods' play allows, rad. The
            alignment error is the hole's to an upright peg, without it.
        max_steps: control steps until truncation.
        force_limit: a force beyond this in any timestep ends the episode as a failure, N.
        free_force: a peak force up to this costs nothing, N.
        snap_angle: a platform this far off its command has left its assembly mode, rad.
        step_cost: of each control step, and at a failure of all that were left.
        depth_scale: reward per m of depth gained.
        force_cost: per N of each control step's peak force above ``free_force``.
        insertion_bonus: reward of a success.
        failure_cost: of a failure, besides the steps left; its last step gains nothing.

    Raises:
        ArgumentError: a value is of the wrong kind, not finite or out of range.
    """

    peg: Peg = STANDARD_PEG
    position_error: float = 0.003
    tilt_error: float = math.radians(1.0)
    friction: tuple[float, float] = (0.1, 0.4)
    force_noise: float = 0.02
    moment_noise: float = 0.0005
    start_height: float = 0.010
    insertion_depth: float = 0.010
    linear_step: float = 0.0005
    depth_step: float = 0.001
    angular_step: float = 0.002
    heave_step: float = 0.0005
    dt: float = 0.05
    timestep: float = TIMESTEP
    contact_time: float = CONTACT_TIME
    effector_play: float = 0.0
    max_steps: int = 80
    force_limit: float = 40.0
    free_force: float = 5.0
    snap_angle: float = math.radians(5.0)
    step_cost: float = 0.05
    depth_scale: float = 1000.0
    force_cost: float = 0.02
    insertion_bonus: float = 20.0
    failure_cost: float = 5.0

    def __post_init__(self) -> None:
        peg = as_dataclass("ContactTask.peg", self.peg, Peg)  # from YAML it is a mapping
        object.__setattr__(self, "peg", peg)
        check_integer("ContactTask.max_steps", self.max_steps, 1)
        may_be_zero = {"position_error", "tilt_error", "force_noise", "moment_noise", "step_cost",
                       "depth_scale", "force_cost", "insertion_bonus", "failure_cost",
                       "effector_play"}  # fmt: skip
        for name in (field.name for field in fields(self)):
            if name not in ("peg", "max_steps", "friction"):
                above, high = name not in may_be_zero, _LARGEST.get(name, 1e4)
                check_number(f"ContactTask.{name}", getattr(self, name), 0.0, high, above=above)
        low, high = check_list("ContactTask.friction", self.friction, "two numbers", 2)
        low = check_number("ContactTask.friction[0]", low, 0.0, 2.0, above=True)
        high = check_number("ContactTask.friction[1]", high, low, 2.0)
        object.__setattr__(self, "friction", (low, high))
        if abs(self.substeps * self.timestep - self.dt) > 1e-9:
            raise ArgumentError(
                f"ContactTask.dt = {self.dt!r}: must be a whole number of timesteps of "
                f"{self.timestep} s"
            )
        if self.contact_time < 2.0 * self.timestep:
            raise ArgumentError(
                f"ContactTask.contact_time = {self.contact_time!r}: must be at least two timesteps "
                f"of {self.timestep} s, or the contact is softer than asked for"
            )
        if self.insertion_depth > peg.depth:
            raise ArgumentError(
                f"ContactTask.insertion_depth = {self.insertion_depth!r}: must be at most the "
                f"bore's depth, {peg.depth:g} m"
            )

    @property
    def substeps(self) -> int:
        """Timesteps of the simulation in a control step."""
        return max(1, round(self.dt / self.timestep))

    @property
    def increments(self) -> Floats:
        """One increment along x, y, z of the effector, roll, pitch and heave (6,)."""
        x, tilt = self.linear_step, self.angular_step
        return np.array([x, x, self.depth_step, tilt, tilt, self.heave_step])


LEVELS: Final = MappingProxyType(
    {
        "easy": ContactTask(peg=Peg(tip="capsule")),
        "standard": ContactTask(),
        "hard": ContactTask(peg=Peg(clearance=0.0003, chamfer=0.0005)),
    }
)


def resolve_task(value: Any) -> ContactTask:
    """A task from what a user gives: a level's name, a task, or a mapping of its fields.

    Raises:
        ArgumentError: it is none of these.
    """
    return as_dataclass("level", value, ContactTask, LEVELS)


def draw_error(task: ContactTask, rng: np.random.Generator) -> Floats:
    """A random error of a hole (4,): displacement along x, y, m, and tilt about x, y, rad."""
    radius, bearing, lean, side = rng.random(4)
    bearing, side = 2.0 * np.pi * bearing, 2.0 * np.pi * side
    offset = task.position_error * np.sqrt(radius)  # uniform over the disc
    tilt = task.tilt_error * lean
    return np.array([offset * np.cos(bearing), offset * np.sin(bearing),
                     tilt * np.cos(side), tilt * np.sin(side)])  # fmt: skip


def askew(error: Floats, pivot: Floats) -> list[float]:
    """Place of the 3-RRS's base for an error: tilted about ``pivot``, then displaced."""
    turn = roll_pitch_yaw_matrix([*error[2:], 0.0])
    aside = np.array([*error[:2], 0.0])
    return [*(pivot + aside - turn @ pivot), *error[2:]]


def start_configurations(machine: Machine, height: float) -> Floats:
    """For each hole the configuration (holes, 6) with the tip ``height`` above its mouth, aligned.

    Heave is where sigma_min is largest, so where the platform gives way least. NaN for a hole that
    this machine cannot present with sigma_min of at least ``start_sigma``.

    Raises:
        GeometryError: it can present none.
    """
    g, robot = machine.rrs, machine.delta
    # the third row of a 3-RRS's rotation is (-nx, -ny, nz), so R h = z has n = (-hx, -hy, hz)
    tilts = roll_pitch(np.array(machine.task.hole_normals) * [-1.0, -1.0, 1.0])
    low, high = g.heave_min + HEAVE_ROOM, g.heave_max - HEAVE_ROOM
    heaves = np.linspace(low, max(low, high), 7)
    poses = np.array([np.column_stack([tilts, np.full(len(tilts), heave)]) for heave in heaves])
    effector = rrs.platform_pose(poses, g).position.copy()
    effector[..., 2] += machine.task.dome_radius + height + robot.peg_length - robot.base_height
    valid = delta.is_valid(effector, robot)
    for room in (-HEAVE_ROOM, 0.0, HEAVE_ROOM):
        valid &= rrs.is_valid(poses + np.array([0.0, 0.0, room]), g)
    sigma = np.where(valid, rrs.signed_sigma_min(poses, g), -np.inf)
    best = np.argmax(sigma, axis=0), np.arange(len(tilts))
    good = sigma[best] >= machine.task.start_sigma
    if not good.any():
        raise GeometryError(
            "the 3-RRS can turn no hole upright with sigma_min of at least "
            f"{machine.task.start_sigma:g} and {1e3 * HEAVE_ROOM:g} mm of heave left both ways: "
            "choose another geometry, a wider range of heave, or other holes"
        )
    result = np.concatenate([effector[best], poses[best]], axis=1)
    return np.where(good[:, None], result, np.nan)


def split_options(options: Any) -> tuple[Options, Options]:
    """Reset options of the simulation, checked, and all others.

    Raises:
        ResetOptionError: an error or a friction is malformed or out of range.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ResetOptionError(f"options = {options!r}: must be a mapping")
    own: Options = {}
    rest = dict(options or {})
    error, friction = (rest.pop(name, None) for name in OWN_OPTIONS)
    if friction is not None:
        friction = check_number("friction", friction, 0.0, 2.0, above=True, error=ResetOptionError)
        own["friction"] = friction
    if error is not None:
        four = check_list("error", error, "x, y, m, and two tilts, rad", 4, ResetOptionError)
        own["error"] = [
            check_number(f"error[{i}]", number, -most, most, error=ResetOptionError)
            for i, (number, most) in enumerate(zip(four, _LARGEST_ERROR, strict=True))
        ]
    return own, rest
