"""Knobs between simulation and reality: off by default, drawn anew at every reset from the seed.

The controller goes on believing in its nominal model: masks, configurations and observations are
the model's (plus noise). Collisions, singularities, insertions, rewards and ``info`` are the real
machine's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from coop_env.errors import ArgumentError, as_dataclass, check_flag, check_integer, check_number
from coop_env.simulation.insertion_task import InsertionTask
from coop_env.simulation.task import EnvParams


@dataclass(frozen=True, slots=True)
class SimToReal:
    """How far the real machine may be from its model. Errors are drawn uniformly within +-bound.

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

    def __post_init__(self) -> None:
        limits = {
            "observation_noise": 1.0, "link_length_error": 0.05, "base_position_error": 0.05,
            "base_tilt_error": 0.2, "backlash": 0.1, "joint_resolution": 0.1,
            "chamfer_error": 0.1, "insertion_probability": 1.0,
        }  # fmt: skip
        for name, limit in limits.items():
            number = check_number(f"SimToReal.{name}", getattr(self, name), 0.0, limit)
            object.__setattr__(self, name, number)
        check_integer("SimToReal.latency", self.latency, 0, 1, hint=" step")
        check_flag("SimToReal.randomize", self.randomize)

    @property
    def active(self) -> bool:
        """Whether any knob is turned."""
        return any(
            getattr(self, f.name) != f.default for f in fields(self) if f.name != "randomize"
        )


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


def resolve(value: str | SimToReal | Mapping[str, Any] | None, task: InsertionTask) -> SimToReal:
    """The knobs of a constructor argument: None, ``"randomized"``, the knobs or their fields.

    Raises:
        ArgumentError: it is none of these, or the chamfer of ``task`` may vanish.
    """
    if value is None:
        return NOMINAL
    if isinstance(value, str):
        if value != "randomized":
            raise ArgumentError(
                f"sim_to_real = {value!r}: must be None, 'randomized' or a coop_env.SimToReal"
            )
        value = RANDOMIZED
    knobs = as_dataclass("sim_to_real", value, SimToReal)
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
    rrs, delta = p.rrs, p.delta
    nominal = np.array(
        [
            rrs.base_radius, rrs.proximal_length, rrs.platform_radius, rrs.distal_length,
            delta.base_radius, delta.effector_radius, delta.proximal_length, delta.distal_length,
        ]
    )  # fmt: skip
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
