"""The whole task with real contact as a Gymnasium environment, in continuous increments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ResetOptionError, check_integer
from coop_env.geometry import DeltaGeometry, RRSGeometry
from coop_env.physics import kernels
from coop_env.physics.contact.env import check_increments, make_machine
from coop_env.physics.contact.scene import twin_scene
from coop_env.physics.contact.task import (
    ContactTask,
    askew,
    check_error,
    check_friction,
    draw_error,
    resolve_task,
)
from coop_env.physics.joints import Floats
from coop_env.physics.model import Servos
from coop_env.physics.twin import Readings, Twin, last
from coop_env.rendering.modes import Rendered
from coop_env.rendering.scene import Scene
from coop_env.simulation.insertion_task import InsertionTask
from coop_env.simulation.task import N_AXES, EnvParams

Observation = NDArray[np.float32]
MAX_STEPS: Final = 2400
"""120 s in control steps, twice the kinematic task's time, as contact takes some."""
LIMIT: Final = 5.0
_UNITS: Final[Floats] = np.array(
    [*[0.1] * 3, *[1.0] * 2, *[1.0] * 6, *[10.0] * 3, *[0.05] * 3, *[0.1] * 3, *[0.5] * 2, 0.1,
     *[1.0] * 6]
)  # fmt: skip
_ANGLE_SCALE: Final = 150.0
HELD_OPTIONS: Final = ("error", "friction")
"""Reset options beside the kinematic task's."""


class CoopInsertionPhysicsEnv(Rendered):
    """Bring the peg from far away to six holes one after another and push it in, by feel.

    The start states and holes of ``CoopInsertion-v0`` on the twin of
    :class:`~coop_env.physics.contact.env.CoopInsertionContactEnv`: the same seed gives both the
    same start. ``docs/physics_task.md`` says more.

    **Action Space**

    ``Box(-1, 1, (6,))``: increments of the commanded configuration, over which joint commands are
    led within a control step of 0.05 s. One is a quarter of a move of the kinematic task: 5 mm of
    x, y, z, 7.5 mrad of roll, pitch, 5 mm of heave. A command beyond the robots' limits is not
    taken (``info["violation"]``).

    **Observation Space**

    ``Box(-5, 5, (30 + holes,), float32)``, everything in the units of the last column:

    =======  ===================================================================  ===============
    Field    Meaning                                                              One is
    =======  ===================================================================  ===============
    0 - 2    tip - target's mouth, by measured joints and the nominal model       0.1 m
    3, 4     x, y of the target's normal, likewise                                1
    5 - 10   joint angles theta, q, from those at home                            1 rad
    11 - 13  mean force on the peg over the control step, with noise, world       10 N
    14 - 16  mean moment on it about its tip, with noise                          0.05 N m
    17 - 22  command, from home (x, y, z, roll, pitch, heave)                     0.1 m, 0.5 rad
    23 - 28  last action                                                          1
    29 -     hole filled, one field a hole; then the share of the time gone       1
    =======  ===================================================================  ===============

    **Rewards**

    ``progress``, 1 per mm by which the tip nears the point 10 mm deep in the target's real bore,
    and 150 per rad by which the bore turns upright; ``step``, ``force``, ``insertion`` and
    ``failure`` as in the contact task.

    **Starting State**

    That of ``CoopInsertion-v0``. The 3-RRS's base stands askew by the contact task's unknown
    ``position_error`` and ``tilt_error``, about the point where the mouth of an aligned hole is.
    Options of :meth:`reset`: ``configuration``, ``target``, ``filled`` of the kinematic task,
    ``error`` and ``friction`` of the contact task.

    **Episode End**

    1. Termination: the peg was 10 mm deep in every active hole; the nearest open one is always the
       next target.
    2. Termination, ``info["failure"]``: ``"force"``, ``"snap"`` or ``"diverged"``, as in the
       contact task.
    3. Truncation, ``"time"``: ``max_steps`` control steps.

    Args:
        level: ``"easy"``, ``"standard"``, ``"hard"`` or a
            :class:`~coop_env.physics.contact.task.ContactTask`, whose errors, peg, friction, noise,
            control period and limits hold; ``{"position_error": 0, "tilt_error": 0}`` has no error.
        geometry: ``"optimized"``, ``"initial"`` or an :class:`~coop_env.geometry.RRSGeometry`.
        delta: None, the standard robot, or a :class:`~coop_env.geometry.DeltaGeometry`.
        holes: None, the paper's task, or an
            :class:`~coop_env.simulation.insertion_task.InsertionTask`.
        servos: None, or :class:`~coop_env.physics.model.Servos`. Each of these five may be a plain
            mapping of fields.
        stage: 0, the four peripheral holes, or 1, all.
        max_steps: control steps until truncation.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``; no OpenGL.

    Raises:
        DependencyNotInstalled: on import, if MuJoCo is missing; it names the extra.
        ArgumentError: an argument is unknown or out of range, or the servos cannot hold home.
        GeometryError: a robot cannot be assembled.

    **Version History**

    * v0: initial version
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        **Rendered.metadata,
        "render_fps": round(1.0 / ContactTask().dt),
    }

    def __init__(
        self,
        level: str | ContactTask | Mapping[str, Any] = "standard",
        geometry: str | RRSGeometry | Mapping[str, Any] = "optimized",
        delta: DeltaGeometry | Mapping[str, Any] | None = None,
        holes: InsertionTask | Mapping[str, Any] | None = None,
        servos: Servos | Mapping[str, Any] | None = None,
        stage: int = 1,
        max_steps: int = MAX_STEPS,
        render_mode: str | None = None,
    ) -> None:
        self._set_render_mode(render_mode)
        self.task = resolve_task(level)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.task.dt))}
        self.max_steps = check_integer("max_steps", max_steps, 1)
        machine = make_machine(self.task, geometry, delta, holes, servos)
        self._starts = CoopInsertionEnv(machine.rrs, delta=delta, task=machine.task, stage=stage)
        self.twin = Twin(machine)
        self._packed = self.twin.packed
        move = np.array(machine.task.steps)
        self.increments: Floats = move * min(1.0, self.task.dt / machine.task.dt)
        gains = (machine.servos.delta_stiffness, machine.servos.rrs_stiffness)
        self._lag = np.repeat([machine.servos.damping(kp) / kp for kp in gains], 3)  # s
        self._home = machine.home()
        self._home_joints = self.twin.servo_targets(self._home)
        dome = machine.task.dome_radius
        self._pivot = np.array([0.0, 0.0, machine.rrs.home_heave + dome])
        peg = machine.peg
        self._mouth_radius = machine.delta.peg_radius + peg.clearance + peg.chamfer
        n = len(machine.task.holes)
        size = 30 + n
        self.observation_space = spaces.Box(-LIMIT, LIMIT, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (N_AXES,), np.float32)
        self.command = np.zeros((1, N_AXES))
        self.hole, self.steps = np.zeros(1, np.int64), np.zeros(1, np.int64)
        self.active, self.filled = np.zeros(n, bool), np.zeros(n, bool)
        self._targets = np.zeros((1, N_AXES))
        self.failure = ""
        self._begun = self._running = False

    @property
    def params(self) -> EnvParams:
        """The nominal machine as the kinematic kernels take it."""
        return self.twin.machine.kernel_params()

    @property
    def configuration(self) -> Floats:
        """The commanded (x, y, z, roll, pitch, heave), (6,); m and rad."""
        return self.command[0].copy()

    @property
    def target(self) -> int:
        """The hole to aim at."""
        return int(self.hole[0])

    @property
    def over(self) -> bool:
        """Whether every active hole is filled, or the episode has failed."""
        return bool(self.failure) or not np.any(self.active & ~self.filled)

    @property
    def _success(self) -> bool:
        """Whether this episode has filled a hole."""
        return int(self.filled.sum()) > self._at_first

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Raises:
            ResetOptionError: an option is malformed. The environment is left as it was.
        """
        held, rest = split_options(options)
        self._starts.check_options(rest)
        super().reset(seed=seed)
        self._starts.np_random = self.np_random  # one stream: a seed's start is the kinematic one's
        self._starts.reset(options=rest)
        self.begin(self._starts.state, held)
        if self.render_mode is not None:
            self._follow(self.twin.readings().tip[0], first=True)
        return self._observe(), {**self._info(), "reward_terms": {}}

    def begin(self, state: np.void, held: Mapping[str, Any]) -> None:
        """Set the machine down at a state of the kinematic task.

        Args:
            state: a row of ``coop_env.simulation.state.state_dtype()``.
            held: ``error`` and ``friction``, drawn from ``np_random`` where they are not given.
        """
        error = draw_error(self.task, self.np_random)
        friction = float(self.np_random.uniform(*self.task.friction))
        self.error = np.array(held.get("error", error))
        self.friction = float(held.get("friction", friction))
        start = np.array(state["configuration"])
        base = askew(self.error, self._pivot)
        readings = self.twin.place(0, start, base, self.friction)
        self.command[0] = start
        self._targets[0] = self.twin.servo_targets(start)
        self.hole[0], self.steps[0] = state["target"], 0
        self.active, self.filled = state["active"].astype(bool), state["filled"].astype(bool)
        self._at_first = int(self.filled.sum())
        self.given_up: list[int] = []
        self._tare = readings.wrench
        self._wrench, self._action = np.zeros(N_AXES), np.zeros(N_AXES)
        self.taken, self.inserted = True, -1
        self.peak = self.peak_force = 0.0  # of the last control step, and of the episode, N
        self._measure(self.twin.readings())
        self.aimed = self.distance, self.alignment_error
        self.failure, self._begun, self._running = "", True, True

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one control step.

        Raises:
            ActionError: the action is not in the action space. The environment is left as it was.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self._running:
            raise ResetNeeded("call reset() first: there is no running episode")
        self._action = self.increments_of(action)
        task, aimed = self.task, self.target
        before = self._left_to(aimed)
        inserted = self.advance(self.command[0] + self._action * self.increments)
        truncated = not self.over and int(self.steps[0]) >= self.max_steps
        self._running = not (self.over or truncated)
        nearer = before - self._left_to(aimed)
        failed = bool(self.failure)
        steps = self.max_steps - int(self.steps[0]) + 1 if failed else 1  # it never saves any
        terms = {
            "progress": (task.depth_scale * nearer[0] + _ANGLE_SCALE * nearer[1]) * (not failed),
            "step": -task.step_cost * steps,
            "force": -task.force_cost * max(self.peak - task.free_force, 0.0),
            "insertion": task.insertion_bonus * (inserted >= 0),
            "failure": -task.failure_cost * failed,
        }
        if truncated:
            self.failure = "time"
        if self.render_mode is not None:
            self._follow(self.twin.readings().tip[0])
        info = {**self._info(), "reward_terms": {key: float(v) for key, v in terms.items()}}
        reward = float(sum(terms.values()))
        return self._observe(), reward, self.over and not truncated, truncated, info

    def increments_of(self, action: Any) -> Floats:
        """An action as increments (6,), each of -1 to 1.

        Raises:
            ActionError: it is not in the action space.
        """
        return check_increments(action, (N_AXES,))

    def advance(self, wanted: Floats) -> int:
        """One control step, in which the joints are led evenly to a configuration (6,).

        Returns:
            The hole that this step has filled, or -1; the next one is the target then.
        """
        task = self.task
        first = self._targets.copy()
        self.taken = bool(
            kernels.take_commands(self.command, wanted[None], self._packed, self._targets)[0]
        )
        way = self._targets - first
        share = np.arange(1, task.substeps + 1)[:, None] / task.substeps
        # a servo damps all motion: led by velocity too, it does not fall behind
        led = first + share * way + self._lag * way / task.dt
        readings = self.twin.advance(led[None], task.substeps)
        self.steps += 1
        sensed = readings.wrench[0] - self._tare
        self._wrench = sensed.mean(axis=0)
        self.peak = float(np.linalg.norm(sensed[:, :3], axis=1).max())
        self.peak_force = max(self.peak_force, self.peak)
        now = last(readings)
        snapped = self.twin.platform_error(now, self.command)[0] > task.snap_angle
        self._measure(now)
        if self.twin.diverged[0]:
            self.failure = "diverged"
        elif self.peak > task.force_limit:
            self.failure = "force"
        elif snapped:
            self.failure = "snap"
        self.inserted = -1
        if not self.failure and self.depth >= task.insertion_depth and not self.filled[self.target]:
            self.fill()
        return self.inserted

    def lead(self, to: Floats, steps: int = 1, touch: float = math.inf) -> bool:
        """Lead the machine straight to a configuration (6,), in increments of at most 1.

        Args:
            to: where.
            steps: at least so many control steps.
            touch: a mean force beyond this is a contact that stops it, N.

        Returns:
            Whether it arrived, and no contact, failure or command that was not taken stopped it.
        """
        way, start = to - self.command[0], self.configuration
        n = max(steps, math.ceil(float(np.max(np.abs(way) / self.increments)) - 1e-9))
        for k in range(1, n + 1):
            self.advance(start + way * (k / n))
            if self.failure or not self.taken or self.force > touch:
                return False
        return True

    def fill(self) -> None:
        """Count the target as filled, and aim at the next."""
        self.inserted, self.aimed = self.target, (self.distance, self.alignment_error)
        self.filled[self.target] = True
        self._next()

    def give_up(self) -> None:
        """Leave the target for good, and aim at the next; without one the episode is over."""
        self.active[self.target] = False
        self.given_up.append(self.target)
        if self.over and not self._success:
            self.failure = "not inserted"
        self._next()

    def reached(self) -> bool:
        """Whether the tip really meets the kinematic task's criterion at the target."""
        task = self.twin.machine.task
        return self.distance < task.tolerance and self.alignment_error < task.angle_tolerance

    @property
    def force(self) -> float:
        """Mean force on the peg over the last control step, without noise, N."""
        return float(np.linalg.norm(self._wrench[:3]))

    def perceived(self) -> tuple[Floats, Floats, Floats]:
        """What a controller has to go by, with the sensors' noise, which is drawn now.

        Returns:
            The target (1, 5), tip - mouth, m, and x, y of its normal; joint angles (1, 6), rad;
            wrench on the peg (1, 6), N, N m.
        """
        task = self.task
        joints = np.ascontiguousarray(self.twin.readings().joints)
        view = kernels.perceive(joints, self.command.copy(), self.hole, self._packed)
        noise = self.np_random.normal(size=N_AXES)
        noise *= [task.force_noise] * 3 + [task.moment_noise] * 3
        return view, joints, (self._wrench + noise)[None]

    def scene(self) -> Scene:
        """Every body of the scene at this instant, where it really is; world frame.

        Raises:
            ResetNeeded: there was no reset yet.
        """
        if not self._begun:
            raise ResetNeeded("call reset() first: there is no state yet")
        won = self._success and not np.any(self.active & ~self.filled)
        status = "success" if won else self.failure or "running"
        found = twin_scene(self, 0, status, self._trace)
        return replace(found, active=self.active.copy(), filled=self.filled.copy())

    def close(self) -> None:
        """End the simulation."""
        super().close()
        self.twin.close()
        self._running = False

    def _next(self) -> None:
        """Aim at the open hole that is nearest to the tip by the nominal model; else stay."""
        open_holes = np.flatnonzero(self.active & ~self.filled)
        if len(open_holes) == 0:
            return
        joints = np.ascontiguousarray(self.twin.readings().joints)
        n = len(open_holes)
        command = np.repeat(self.command, n, axis=0)
        views = kernels.perceive(np.repeat(joints, n, axis=0), command, open_holes, self._packed)
        self.hole[0] = open_holes[np.argmin(np.linalg.norm(views[:, :3], axis=1))]

    def _measure(self, readings: Readings) -> None:
        """Where the tip of readings (1, ...) really is, as the target has it."""
        tip, platform, rotation = (
            np.ascontiguousarray(part)
            for part in (readings.tip, readings.platform, readings.rotation)
        )
        found = kernels.insertion(
            tip, platform, rotation, self.hole, self._mouth_radius, self._packed
        )
        self.depth, self.lateral_error, self.alignment_error = found[0].tolist()
        self.distance = float(np.linalg.norm(self._from_mouth(self.target)[0]))

    def _from_mouth(self, hole: int) -> tuple[Floats, Floats]:
        """The tip from a hole's mouth, m, and the hole's normal (3,), as they really are."""
        readings, task = self.twin.readings(), self.twin.machine.task
        normal = readings.rotation[0] @ task.hole_normals[hole]
        return readings.tip[0] - readings.platform[0] - task.dome_radius * normal, normal

    def _left_to(self, hole: int) -> Floats:
        """(2,): from the tip to the point where a hole counts as filled, m; misalignment, rad."""
        tip, normal = self._from_mouth(hole)
        away = np.linalg.norm(tip + self.task.insertion_depth * normal)
        return np.array([away, math.atan2(math.hypot(normal[0], normal[1]), normal[2])])

    def _observe(self) -> Observation:
        view, joints, wrench = self.perceived()
        gone = int(self.steps[0]) / self.max_steps
        felt = np.concatenate(
            [view[0], joints[0] - self._home_joints, wrench[0], self.command[0] - self._home,
             self._action]
        )  # fmt: skip
        fields = np.concatenate([felt / _UNITS, self.filled, [gone]])
        return np.clip(fields, -LIMIT, LIMIT).astype(np.float32)

    def _info(self) -> dict[str, Any]:
        return {
            "success": self._success,
            "is_success": self._success,
            "failure": self.failure,
            "n_filled": int(self.filled.sum()),
            "inserted": self.inserted >= 0,
            "inserted_hole": self.inserted,
            "target": self.target,
            **self.measured(),
        }

    def measured(self) -> dict[str, Any]:
        """What the simulation has of the episode: the ``info`` that no other task's has."""
        return {
            "distance": self.distance,
            "depth": self.depth,
            "lateral_error": self.lateral_error,
            "alignment_error": self.alignment_error,
            "force": self._wrench[:3].copy(),
            "moment": self._wrench[3:].copy(),
            "peak_force": self.peak_force,
            "violation": not self.taken,
            "time": float(self.steps[0]) * self.task.dt,
            "friction": self.friction,
            "error": self.error.copy(),
        }


def split_options(options: Any) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Reset options of the simulation, checked, and those that are the kinematic task's.

    Raises:
        ResetOptionError: an error or a friction is malformed or out of range.
    """
    if options is None:
        return {}, None
    if not isinstance(options, Mapping):
        raise ResetOptionError(f"options = {options!r}: must be a mapping")
    held: dict[str, Any] = {}
    if options.get("error") is not None:
        held["error"] = check_error(options["error"])
    if options.get("friction") is not None:
        held["friction"] = check_friction(options["friction"])
    return held, {name: value for name, value in options.items() if name not in HELD_OPTIONS}
