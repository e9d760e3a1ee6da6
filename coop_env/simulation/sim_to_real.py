"""Knobs between simulation and reality: off by default, drawn anew at every reset from the seed.

The controller goes on believing in its nominal model: masks, configurations and observations are
the model's (plus noise). Collisions, singularities, insertions, rewards and ``info`` are the real
machine's. The kinematic environments have one part of the knobs, those with contact another.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop_env.errors import ArgumentError, as_dataclass, check_flag, check_integer, keep_number
from coop_env.simulation.insertion_task import InsertionTask
from coop_env.simulation.task import EnvParams

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SimToReal:
    """How far the real machine may be from its model. Errors are drawn uniformly within +-bound.

    The environments with contact alone take the last five, and have their ``level`` in place of
    ``observation_noise``, ``base_position_error``, ``base_tilt_error``, ``chamfer_error`` and
    ``insertion_probability``.

    FORGE (Noseworthy et al. 2024, arXiv 2408.04587) has published ranges for the last five, in the
    file ``forge_env_cfg.py`` of Isaac Lab: gains times or divided by up to 1.41; a dead zone of up
    to 5 N and 1 N m; the held part's mass up to 5 g more or less; the fixed part's friction 0.25 to
    1.25; a force noise of 1 N. ``FORGE`` takes them over to this machine.

    Attributes:
        observation_noise: standard deviation of Gaussian noise on the first 12 fields of the
            observation, as a fraction of each field's range.
        link_length_error: bound of every link's and radius's relative error.
        base_position_error: bound of the 3-RRS's base's displacement along x, y and z, m.
        base_tilt_error: bound of that base's tilt about x and about y, rad.
        backlash: play of each actuated joint, from one side to the other, rad.
        joint_resolution: step to which joint commands are rounded, rad.
        latency: 1 executes each action one step late; the first step then does nothing.
        chamfer_error: bound of the error of the chamfer and of the tolerance with it, m.
        insertion_probability: chance that a move which meets the criterion inserts; the chamfer
            catches the peg otherwise, and the next move is another attempt.
        randomize: at every reset scale each bound, the noise and the play by a uniform factor in
            [0, 1], draw the latency with one half, and the probability between it and 1.
        servo_gain_error: bound of the error of each servo's stiffness, which is multiplied or
            divided by up to 1 plus this.
        servo_dead_zone: torque that dry friction at each servo takes up, N m.
        mass_error: bound of the relative error of the mass of each kind of link and of the peg;
            gravity compensation goes on carrying the nominal one.
        friction_error: bound of the error of the episode's friction, as for the servos' stiffness.
        force_noise: standard deviation of noise on each observed force, besides the level's, N.

    Raises:
        ArgumentError: a value is out of its range.
    """

    observation_noise: float = 0.0
    link_length_error: float = 0.0
    base_position_error: float = 0.0
    base_tilt_error: float = 0.0
    backlash: float = 0.0
    joint_resolution: float = 0.0
    latency: int = 0
    chamfer_error: float = 0.0
    insertion_probability: float = 1.0
    randomize: bool = False
    servo_gain_error: float = 0.0
    servo_dead_zone: float = 0.0
    mass_error: float = 0.0
    friction_error: float = 0.0
    force_noise: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "observation_noise": 1.0, "link_length_error": 0.05, "base_position_error": 0.05,
            "base_tilt_error": 0.2, "backlash": 0.1, "joint_resolution": 0.1,
            "chamfer_error": 0.1, "insertion_probability": 1.0, "servo_gain_error": 4.0,
            "servo_dead_zone": 10.0, "mass_error": 0.9, "friction_error": 4.0, "force_noise": 10.0,
        }  # fmt: skip
        for name, limit in limits.items():
            keep_number(self, name, 0.0, limit)
        # plain Python values, whose text is compared when a snapshot is loaded
        latency = check_integer("SimToReal.latency", self.latency, 0, 1, hint=" step")
        object.__setattr__(self, "latency", latency)
        object.__setattr__(self, "randomize", check_flag("SimToReal.randomize", self.randomize))

    @property
    def active(self) -> bool:
        """Whether any knob is turned."""
        return bool(self.turned)

    @property
    def turned(self) -> set[str]:
        """Names of the knobs that are turned."""
        knobs = (f for f in fields(self) if f.name != "randomize")
        return {f.name for f in knobs if getattr(self, f.name) != f.default}


NOMINAL: Final = SimToReal()
RANDOMIZED: Final = SimToReal(
    observation_noise=0.01,
    link_length_error=0.002,
    base_position_error=0.002,
    base_tilt_error=math.radians(0.5),
    backlash=math.radians(0.2),
    joint_resolution=math.radians(0.1),
    latency=1,
    chamfer_error=0.002,
    insertion_probability=0.9,
    randomize=True,
)
"""The domain-randomization preset: each episode another machine, from ideal to this far off."""
FORGE: Final = SimToReal(
    link_length_error=RANDOMIZED.link_length_error,
    backlash=RANDOMIZED.backlash,
    joint_resolution=RANDOMIZED.joint_resolution,
    latency=RANDOMIZED.latency,
    servo_gain_error=0.41,
    servo_dead_zone=0.33,
    mass_error=0.17,
    friction_error=1.24,
    force_noise=1.0,
    randomize=True,
)
"""The same for machines with contact, by FORGE's ranges where it has any: 5 N at the peg are some
0.33 N m at each of three arms of 0.2 m, 5 g a sixth of the peg's 30 g, and 0.25 to 1.25 their
geometric mean times or divided by 2.24."""

CONTACT_KNOBS: Final = frozenset(
    {"servo_gain_error", "servo_dead_zone", "mass_error", "friction_error", "force_noise"}
)
KINEMATIC_KNOBS: Final = frozenset(
    {"observation_noise", "base_position_error", "base_tilt_error", "chamfer_error",
     "insertion_probability"}
)  # fmt: skip


def _knobs(value: Any, preset: SimToReal, others: frozenset[str], hint: str) -> SimToReal:
    knobs = as_dataclass("sim_to_real", value, SimToReal, {None: NOMINAL, "randomized": preset})
    if wrong := sorted(knobs.turned & others):
        raise ArgumentError(f"SimToReal.{wrong[0]}: {hint}")
    return knobs


def resolve_contact(value: str | SimToReal | Mapping[str, Any] | None) -> SimToReal:
    """The knobs of an environment with contact; ``"randomized"`` is ``FORGE``."""
    return _knobs(value, FORGE, KINEMATIC_KNOBS, "the machine has contact here; see level")


def resolve(value: str | SimToReal | Mapping[str, Any] | None, task: InsertionTask) -> SimToReal:
    """The knobs of a kinematic environment: None, ``"randomized"``, the knobs or their fields.

    Raises:
        ArgumentError: it is none of these, a knob of the environments with contact is turned, or
            the chamfer of ``task`` may vanish.
    """
    hint = "only the environments with contact have it (CoopInsertionContact-v0, for one)"
    knobs = _knobs(value, RANDOMIZED, CONTACT_KNOBS, hint)
    least = min(task.chamfer, task.tolerance)
    if knobs.chamfer_error >= least:
        raise ArgumentError(
            f"SimToReal.chamfer_error = {knobs.chamfer_error!r}: must be below the task's chamfer "
            f"and tolerance, {least:g} m"
        )
    return knobs


def draw_machine(m: Any, knobs: SimToReal, p: EnvParams, rng: np.random.Generator) -> None:
    """Write a machine within the knobs' bounds to a record of ``machine.MACHINE``."""
    scale = rng.random(9) if knobs.randomize else np.ones(9)
    nominal = np.array([*p.rrs[:4], *p.delta[:4]])
    m["lengths"] = nominal * (1.0 + scale[0] * knobs.link_length_error * rng.uniform(-1.0, 1.0, 8))
    m["base"][:3] = scale[1] * knobs.base_position_error * rng.uniform(-1.0, 1.0, 3)
    m["base"][3:] = scale[2] * knobs.base_tilt_error * rng.uniform(-1.0, 1.0, 2)
    m["backlash"] = scale[3] * knobs.backlash
    m["resolution"] = scale[4] * knobs.joint_resolution
    m["noise"] = scale[5] * knobs.observation_noise
    error = scale[6] * knobs.chamfer_error * rng.uniform(-1.0, 1.0)
    m["chamfer"], m["tolerance"] = p.task.chamfer + error, p.task.tolerance + error
    m["insertion_probability"] = 1.0 - scale[7] * (1.0 - knobs.insertion_probability)
    m["latency"] = knobs.latency == 1 and (not knobs.randomize or scale[8] < 0.5)
    m["pending"] = -1
    m["key"] = rng.integers(2**63)


class Disturbance(NamedTuple):
    """Errors of one machine with contact; factors of 1 and zeros are those of the nominal one."""

    lengths: Floats  # (8,), factors, in the order of ``machine.MACHINE``
    gains: Floats  # (6,), factors of the servos' stiffness, Delta first
    masses: Floats  # (7,), factors, in the order of :data:`MASSES`
    friction: float  # factor
    dead_zone: float  # N m
    backlash: float  # rad
    resolution: float  # rad
    latency: float  # control steps, 0 or 1
    force_noise: float  # N


MASSES: Final = (
    "rrs_proximal", "rrs_distal", "platform", "delta_proximal", "delta_rod", "effector", "peg",
)  # fmt: skip
"""Bodies of the twin whose masses have errors, by the beginning of their names."""


def draw_disturbance(knobs: SimToReal, rng: np.random.Generator) -> Disturbance:
    """A machine with contact within the knobs' bounds; each knob has draws of its own."""
    scale = rng.random(9) if knobs.randomize else np.ones(9)
    lengths, masses = rng.uniform(-1.0, 1.0, 8), rng.uniform(-1.0, 1.0, len(MASSES))
    sizes, signs = rng.random(7), rng.choice([-1.0, 1.0], 7)  # of six gains and the friction
    gains = (1.0 + scale[1] * knobs.servo_gain_error * sizes[:6]) ** signs[:6]
    return Disturbance(
        1.0 + scale[0] * knobs.link_length_error * lengths,
        gains,
        1.0 + scale[2] * knobs.mass_error * masses,
        float((1.0 + scale[3] * knobs.friction_error * sizes[6]) ** signs[6]),
        float(scale[4] * knobs.servo_dead_zone),
        float(scale[5] * knobs.backlash),
        float(scale[6] * knobs.joint_resolution),
        float(knobs.latency == 1 and (not knobs.randomize or scale[7] < 0.5)),
        float(scale[8] * knobs.force_noise),
    )


UNDISTURBED: Final = draw_disturbance(NOMINAL, np.random.default_rng(0))
