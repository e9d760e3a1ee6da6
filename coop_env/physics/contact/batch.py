"""n episodes of the contact task side by side: what the single and the vectorised form share."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop_env.physics import kernels
from coop_env.physics.contact.task import (
    ContactOptions,
    ContactTask,
    askew,
    draw_error,
    start_configurations,
)
from coop_env.physics.joints import Floats
from coop_env.physics.model import Machine
from coop_env.physics.twin import Readings, Twin, last
from coop_env.simulation.collision import peg_tip
from coop_env.simulation.task import N_AXES

Bools = NDArray[np.bool_]

N_OBSERVED: Final = 29
LIMIT: Final = 5.0
"""Observations are clipped to this much of their unit."""
_LENGTH, _ANGLE, _FORCE, _MOMENT = 0.01, 0.05, 10.0, 0.05  # units of the observation
UNITS: Final[Floats] = np.array(
    [*[_LENGTH] * 3, *[_ANGLE] * 2, *[_ANGLE] * 6, *[_FORCE] * 3, *[_MOMENT] * 3,
     *[_LENGTH] * 3, *[_ANGLE] * 2, _LENGTH, *[1.0] * 6]
)  # fmt: skip
"""What 1 means in each of the 29 fields: m, rad, N, N m."""
FAILURES: Final = ("", "force", "snap", "diverged", "time")
"""Causes, by the number under ``failure`` of an :class:`Outcome`; the last one truncates."""


class Outcome(NamedTuple):
    """What a control step came to, a row for each episode."""

    observation: NDArray[np.float32]  # (n, 29)
    reward: Floats
    terminated: Bools
    truncated: Bools
    success: Bools
    failure: NDArray[np.int64]  # an index of FAILURES
    info: dict[str, Any]  # columns (n, ...)


def _length(vectors: Floats) -> Floats:
    """Norms (...) of vectors (..., 3); half the time of numpy's own on few of them."""
    found: Floats = np.sqrt(np.einsum("...i,...i", vectors, vectors))
    return found


def in_units(*fields: Floats) -> NDArray[np.float32]:
    """Observations (n, 29) of fields (n, ...) in SI units, in their order."""
    found = np.concatenate(fields, axis=1) / UNITS
    return np.clip(found, -LIMIT, LIMIT).astype(np.float32)


class ContactBatch:
    """Episodes of one task on one kind of machine.

    Args:
        task: the task.
        machine: robots, dome and servos; its peg is the task's.
        n: how many.
        threads: of the simulation.
        limit: control steps until truncation; None takes the task's.

    Raises:
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.
        ArgumentError: the servos cannot hold the machine, or the holes do not fit the dome.
    """

    def __init__(
        self, task: ContactTask, machine: Machine, n: int = 1, threads: int = 1,
        limit: int | None = None,
    ) -> None:  # fmt: skip
        self.task, self.n = task, n
        self._limit = task.max_steps if limit is None else limit
        self.twin = Twin(machine, n, threads)
        self.starts = start_configurations(machine, task.start_height)
        self._open = np.flatnonzero(np.isfinite(self.starts[:, 0]))
        self._noise = np.array([task.force_noise] * 3 + [task.moment_noise] * 3)
        peg = machine.peg
        self._mouth_radius = machine.delta.peg_radius + peg.clearance + peg.chamfer
        self._packed = self.twin.packed
        self._to_tip = np.array(peg_tip(0.0, 0.0, 0.0, machine.kernel_params().delta))
        self.steps = np.zeros(n, np.int64)
        self.hole = np.zeros(n, np.int64)
        self.command, self.first = np.zeros((n, N_AXES)), np.zeros((n, N_AXES))
        self._targets = np.zeros((n, N_AXES))
        self.error, self.friction = np.zeros((n, 4)), np.zeros(n)
        self._joints, self._tare = np.zeros((n, N_AXES)), np.zeros((n, N_AXES))
        self._believed, self._action = np.zeros((n, N_AXES)), np.zeros((n, N_AXES))
        self._paid, self.peak_force = np.zeros(n), np.zeros(n)
        self.observation = np.zeros((n, N_OBSERVED), np.float32)

    def reset(self, row: int, options: ContactOptions, rng: np.random.Generator) -> dict[str, Any]:
        """Start an episode in one row: writes its observation, returns its info."""
        task = self.task
        error = draw_error(task, rng)  # drawn whether or not an option sets it
        hole, friction = int(rng.choice(self._open)), float(rng.uniform(*task.friction))
        self.hole[row] = hole if options.hole is None else options.hole
        self.error[row] = error if options.error is None else options.error
        self.friction[row] = friction if options.friction is None else options.friction
        start = self.starts[self.hole[row]]
        only = slice(row, row + 1)
        tip = start[:3] + self._to_tip
        mouth = tip - [0.0, 0.0, task.start_height]
        base = askew(self.error[row], mouth)
        readings = self.twin.place(row, start, base, self.friction[row])
        self.command[row] = self.first[row] = self._believed[row] = start
        self._joints[row] = readings.joints
        self._tare[row] = readings.wrench
        self._action[row], self.steps[row], self.peak_force[row] = 0.0, 0, 0.0
        alone = Readings(*(part[None] for part in readings))
        depth, lateral, angle = self._insertion(alone, only)[0].tolist()
        self._paid[row] = depth
        noise = rng.normal(size=(1, N_AXES)) * self._noise
        self.observation[row] = self._observe(only, alone.joints, noise)[0]
        return {
            "depth": depth, "lateral_error": lateral, "alignment_error": angle,
            **self.episode(row),
        }  # fmt: skip

    def episode(self, row: int) -> dict[str, Any]:
        """What was drawn, or set, for the episode in a row."""
        return {"hole": int(self.hole[row]), "friction": float(self.friction[row]),
                "error": self.error[row].copy()}  # fmt: skip

    def step(self, actions: Floats, rngs: list[np.random.Generator]) -> Outcome:
        """Move all episodes by increments (n, 6) in [-1, 1]."""
        task, twin = self.task, self.twin
        wanted = self.command + actions * task.increments
        taken = kernels.take_commands(self.command, wanted, self._packed, self._targets)
        self._action = np.array(actions, np.float64)
        self.steps += 1
        readings = twin.advance(self._targets, task.substeps)
        sensed = readings.wrench - self._tare[:, None]
        peaks = _length(sensed[..., :3]).max(axis=1)
        wrench, now = sensed.mean(axis=1), last(readings)
        depth, lateral, angle = self._insertion(now, slice(None)).T
        success = (depth >= task.insertion_depth) & ~twin.diverged
        snapped = twin.platform_error(now, self.command) > task.snap_angle
        failure = np.where(snapped, 2, 0)
        failure[peaks > task.force_limit] = 1
        failure[twin.diverged] = 3
        success &= failure == 0
        failed = failure > 0
        terminated = success | failed
        truncated = ~terminated & (self.steps >= self._limit)
        failure[truncated] = FAILURES.index("time")
        paid = np.minimum(depth, task.insertion_depth)
        steps = np.where(failed, self._limit - self.steps + 1, 1)  # a failure never saves any
        terms = {
            "depth": task.depth_scale * np.where(failed, 0.0, paid - self._paid),
            "step": -task.step_cost * steps,
            "force": -task.force_cost * np.maximum(peaks - task.free_force, 0.0),
            "insertion": task.insertion_bonus * success,
            "failure": -task.failure_cost * failed,
        }
        self._paid = paid
        self.peak_force = np.maximum(self.peak_force, peaks)
        noise = np.array([rng.normal(size=N_AXES) for rng in rngs]) * self._noise
        self.observation = self._observe(slice(None), now.joints, wrench + noise)
        info = {
            "depth": depth,
            "lateral_error": lateral,
            "alignment_error": angle,
            "force": wrench[:, :3],
            "moment": wrench[:, 3:],
            "peak_force": self.peak_force.copy(),
            "violation": ~taken,
            "time": self.steps * task.dt,
            "reward_terms": terms,
        }
        reward = sum(terms.values(), np.zeros(self.n))
        return Outcome(
            self.observation.copy(), reward, terminated, truncated, success, failure, info
        )

    def _insertion(self, readings: Readings, rows: slice) -> Floats:
        """Depth, distance from the axis, misalignment (n, 3) of where things really are."""
        tip, platform, rotation = (
            np.ascontiguousarray(part)
            for part in (readings.tip, readings.platform, readings.rotation)
        )
        found: Floats = kernels.insertion(
            tip, platform, rotation, self.hole[rows], self._mouth_radius, self._packed
        )
        return found

    def _observe(self, rows: slice, joints: Floats, wrench: Floats) -> NDArray[np.float32]:
        """Observations of rows: the nominal model's view of measured joints, and forces."""
        view = kernels.perceive(
            np.ascontiguousarray(joints), self._believed[rows], self.hole[rows], self._packed
        )
        travel, offset = joints - self._joints[rows], self.command[rows] - self.first[rows]
        return in_units(view, travel, wrench, offset, self._action[rows])
