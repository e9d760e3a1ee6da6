"""Episodes side by side on one kind of machine: the part that both tasks share.

A batch of one is what a single environment plays, so it and the vector form agree to the last bit.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.errors import ArgumentError, as_dataclass, check_flag, check_integer, check_number
from coop_env.geometry import GeometryError, resolve_delta, resolve_rrs
from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import roll_pitch_yaw_matrix
from coop_env.physics import kernels
from coop_env.physics.joints import Floats
from coop_env.physics.model import Machine, Servos
from coop_env.physics.task import Options, askew, resolve_task
from coop_env.physics.twin import Readings, Twin, closed_at, last
from coop_env.rendering.scene import RRS_JOINTS, Scene, posed
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask
from coop_env.simulation.sim_to_real import MASSES, UNDISTURBED, draw_disturbance, resolve_contact
from coop_env.simulation.state import joints_of
from coop_env.simulation.task import N_AXES

Bools = NDArray[np.bool_]

LIMIT: Final = 5.0
"""Observations are clipped to this much of their unit."""
OBSERVED: Final = (3, 2, 6, 3, 3, 3, 2, 1, 6)
"""Fields that both tasks observe: tip, normal, joints, force, moment, command (3), last action."""
TRIES: Final = 20
"""Machines drawn until one can take the start."""
MAX_FRICTION: Final = 2.0
PRIVILEGED: Final = MappingProxyType(
    {
        "tip - mouth": (3, 1.0),  # in the observation's unit of length
        "normal": (3, 1.0),
        "force": (3, 10.0),  # N, without noise
        "moment": (3, 0.05),  # N m
        "friction": (1, 1.0),
        "base": (4, 0.05),  # the hole's displacement along x, y, 0.05 m, and tilts, rad
        "lengths": (8, 0.01),  # relative errors of the 3-RRS and the Delta, as are the next three
        "gains": (6, 1.0),
        "masses": (len(MASSES), 1.0),
        "friction's error": (1, 1.0),
        "dead zone": (1, 1.0),  # N m
        "backlash": (1, 0.01),  # rad
        "resolution": (1, 0.01),  # rad
        "latency": (1, 1.0),  # control steps
        "force noise": (1, 1.0),  # N
    }
)
"""Fields of the privileged state: size and unit of each; true values, world frame."""
PRIVILEGED_UNITS: Final[Floats] = np.repeat(
    [unit for _, unit in PRIVILEGED.values()], [size for size, _ in PRIVILEGED.values()]
)


class PhysicsBatch(ABC):
    """``n`` episodes of a task on the twin; the tasks are subclasses.

    Arguments are :class:`~coop_env.physics.env.CoopInsertionContactEnv`'s; ``max_steps`` are
    control steps until truncation, None for the task's.
    """

    n_observed: int
    length_unit = 0.01
    """Unit of length in the observation, m."""
    increments: Floats
    """Size of each increment (6,); m and rad."""
    outcome: tuple[Any, Floats, Bools, Bools, dict[str, Any]]
    """Observation, reward, terminated, truncated and info of the last step, a row each."""

    def __init__(
        self, level: Any = "standard", geometry: Any = "optimized", delta: Any = None,
        holes: Any = None, servos: Any = None, *, sim_to_real: Any = None,
        reward_scale: float = 1.0, privileged: bool = False, n: int = 1, threads: int = 1,
        max_steps: int | None = None,
    ) -> None:  # fmt: skip
        self.task = task = resolve_task(level)
        self.knobs = resolve_contact(sim_to_real)
        self.reward_scale = check_number("reward_scale", reward_scale, 0.0, 1e6, above=True)
        self.is_dict = check_flag("privileged", privileged)
        dome = as_dataclass("holes", holes, InsertionTask, {None: PAPER_TASK})
        drives = as_dataclass("servos", servos, Servos, {None: Servos()})
        self.machine = machine = Machine(
            resolve_rrs(geometry), resolve_delta(delta), dome, drives, task.peg, task.timestep,
            task.contact_time, task.effector_play,
        )  # fmt: skip
        self.n = n
        most = task.max_steps if max_steps is None else max_steps
        self.max_steps = check_integer("max_steps", most, 1)
        self.twin = Twin(machine, n, threads)
        self._packed = self.twin.packed
        self._noise = np.tile([task.force_noise] * 3 + [task.moment_noise] * 3, (n, 1))
        self._mouth_radius = machine.bore.radius + machine.bore.chamfer
        self.rngs: list[Any] = [None] * n  # generators, once an episode was started
        self.steps, self.hole = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self.failure = np.full(n, "", object)  # the cause; "time" truncates
        self.success, self.taken = np.zeros(n, bool), np.ones(n, bool)
        self.command, self._targets, self._action, self._wrench, self._tare = (
            np.zeros((n, N_AXES)) for _ in range(5)
        )
        self._first, self._first_joints = np.zeros((n, N_AXES)), np.zeros((n, N_AXES))
        self.error, self.friction = np.zeros((n, 4)), np.zeros(n)
        self.peak, self.peak_force = np.zeros(n), np.zeros(n)  # of the last step, of the episode, N
        self.disturbances = [UNDISTURBED] * n
        self._machine_errors = np.zeros((n, np.hstack(UNDISTURBED).size))
        self._hole_normals = np.array(machine.task.hole_normals)
        holes_each = (n, len(self._hole_normals))
        self.active, self.filled, self._wanted = (np.zeros(holes_each, bool) for _ in range(3))
        """Holes that can be filled, are filled, and were to be filled at first, (n, holes)."""
        self._late = np.zeros((n, task.substeps, N_AXES))  # joint commands not yet carried out
        self._geared = np.zeros((n, N_AXES))  # joint commands behind the play
        self._askew = np.zeros(n)  # by link errors the platform is off its command from the start
        self.insertion = np.zeros((n, 4))
        """True depth and errors of the tip: :func:`coop_env.physics.kernels.insertion`, (n, 4)."""

    @abstractmethod
    def check_options(self, options: Any) -> Any:
        """Reset options as :meth:`reset` takes them, or a ``ResetOptionError``."""

    @abstractmethod
    def reset(self, row: int, options: Any, rng: np.random.Generator) -> None:
        """Start an episode in one row, which draws from ``rng``."""

    @abstractmethod
    def step(self, actions: Floats) -> None:
        """Move all episodes by increments (n, 6) in [-1, 1]; writes ``outcome``."""

    @abstractmethod
    def observe(self, rows: slice) -> NDArray[np.float32]:
        """Observations of rows (n, fields), with newly drawn noise."""

    def seen(self, rows: slice) -> Any:
        """Observations of rows: arrays, or with ``privileged`` dictionaries of them."""
        own = self.observe(rows)
        return {"observation": own, "privileged": self.privileged(rows)} if self.is_dict else own

    def privileged(self, rows: slice) -> NDArray[np.float32]:
        """Privileged state (n, 44), for a critic; see ``PRIVILEGED``."""
        now, radius = self.twin.readings(), self.machine.task.dome_radius
        # the rounding of einsum would depend on the number of rows
        normals = (now.rotation[rows] * self._hole_normals[self.hole[rows], None]).sum(axis=2)
        tips = now.tip[rows] - now.platform[rows] - radius * normals
        parts = [tips / self.length_unit, normals, self._wrench[rows], self.friction[rows, None],
                 self.error[rows], self._machine_errors[rows]]  # fmt: skip
        fields = np.concatenate(parts, axis=1) / PRIVILEGED_UNITS
        return np.clip(fields, -LIMIT, LIMIT).astype(np.float32)

    def status(self, row: int) -> str:
        """``"running"``, ``"success"``, or the cause of an episode's failure."""
        won = self.success[row] and not np.any(self.active[row] & ~self.filled[row])
        return "success" if won else self.failure[row] or "running"

    def scene(self, row: int, trace: Sequence[Floats]) -> Scene:
        """Every body at its true place; links follow from the measured joints."""
        if self.rngs[row] is None:
            raise ResetNeeded("call reset() first: there is no state yet")
        machine, readings, base = self.machine, self.twin.readings(), self.twin.base[row]
        closed = closed_at(readings.joints[row], self.command[row], machine)
        configuration = np.where(np.isfinite(closed), closed, self.command[row])
        fields = posed(configuration, machine.kernel_params(), trace)
        turn = roll_pitch_yaw_matrix([*base[3:], 0.0])
        for name in RRS_JOINTS:
            fields[name] = fields[name] @ turn.T + base[:3]
        rotation, centre = readings.rotation[row].copy(), readings.platform[row]
        normals = self._hole_normals @ rotation.T
        mouths = centre + machine.task.dome_radius * normals
        hole = int(self.hole[row])
        fields |= {"platform_centre": centre, "platform_rotation": rotation}
        return Scene(
            **fields,
            tip=readings.tip[row],
            hole_mouths=mouths,
            hole_normals=normals,
            active=self.active[row].copy(),
            filled=self.filled[row].copy(),
            target=hole,
            distance=float(np.linalg.norm(mouths[hole] - readings.tip[row])),
            alignment_error=float(np.arccos(np.clip(normals[hole, 2], -1.0, 1.0))),
            sigma_min=float(rrs.signed_sigma_min(configuration[3:], machine.rrs)),
            time=float(self.steps[row]) * self.task.dt,
            status=self.status(row),
        )

    def _place(
        self, row: int, start: Floats, pivot: Floats, own: Options,
        drawn: tuple[Floats, float], rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Set a machine down at rest; its base stands askew about ``pivot``.

        ``drawn`` are the error and the friction that hold where none is in the options.
        """
        self.error[row] = own.get("error", drawn[0])
        base = askew(self.error[row], pivot)
        if self.knobs.active:
            self._disturb(row, start, base, rng.spawn(1)[0])
        friction = min(drawn[1] * self.disturbances[row].friction, MAX_FRICTION)
        self.friction[row] = own.get("friction", friction)
        self._targets[row] = self._late[row] = self._geared[row] = self.twin.servo_targets(start)
        self._tare[row] = self.twin.place(row, start, base, self.friction[row]).wrench
        self.rngs[row] = rng
        self.command[row] = start
        now = self.twin.readings()
        self._askew[row] = self.twin.platform_error(now, self.command)[row]
        self._action[row], self._wrench[row] = 0.0, 0.0
        self.steps[row], self.failure[row], self.peak[row], self.peak_force[row] = 0, "", 0.0, 0.0
        self.success[row], self.taken[row] = False, True
        rows = slice(row, row + 1)
        self.insertion[rows] = self._measure(now, rows, self.hole)

    def _disturb(
        self, row: int, start: Floats, base: list[float], rng: np.random.Generator
    ) -> None:
        """Draw a machine that stands at ``start`` without contact; ``rng`` serves nothing else."""
        for _ in range(TRIES):
            errors = draw_disturbance(self.knobs, rng)
            try:
                self.twin.disturb(row, errors)
                self.twin.place(row, start, base)
            except (GeometryError, ArgumentError):
                continue
            if self.twin.inspect(row)[1].ncon:
                continue
            self.disturbances[row] = errors
            self._machine_errors[row] = np.hstack(errors) - np.hstack(UNDISTURBED)
            self._noise[row, :3] = np.hypot(self.task.force_noise, errors.force_noise)
            return
        lengths = self.knobs.link_length_error
        raise GeometryError(
            f"{f'link_length_error = {lengths:g}' if lengths else 'sim_to_real'}: none of {TRIES} "
            f"machines drawn can take the start {start.round(4).tolist()} with error = "
            f"{self.error[row].round(4).tolist()}: choose smaller errors, or another start"
        )

    def _carried_out(self, led: Floats) -> Floats:
        """The commands (n, 1 or substeps, 6) as they reach the joints (n, substeps, 6)."""
        now = np.broadcast_to(led, self._late.shape)
        late, resolution, play = (
            np.array([getattr(errors, name) for errors in self.disturbances])[:, None, None]
            for name in ("latency", "resolution", "backlash")
        )
        result = np.where(late, self._late, now)
        self._late = now.copy()
        counts = np.where(resolution, resolution, 1.0)
        result = np.where(resolution, counts * np.round(result / counts), result)
        for k in range(result.shape[1]):  # a joint moves once its play is taken up
            least, most = result[:, k] - play[:, 0] / 2.0, result[:, k] + play[:, 0] / 2.0
            self._geared = np.clip(self._geared, least, most)
            result[:, k] = self._geared
        return result

    def _advance(self, wanted: Floats) -> None:
        """Make one control step towards configurations (n, 6), and measure its results."""
        task, before = self.task, self._targets
        targets, self.taken = joints_of(wanted, self._packed)
        taken = self.taken[:, None]
        self.command = np.where(taken, wanted, self.command)
        self._targets = np.where(taken, targets, before)
        self.steps += 1
        led = self._lead(before)
        led = self._carried_out(led) if self.knobs.active else led
        readings = self.twin.advance(led, task.substeps)
        sensed = readings.wrench - self._tare[:, None]
        # sqrt of einsum takes half the time of numpy's norm on few vectors
        self.peak = np.sqrt(np.einsum("...i,...i", sensed[..., :3], sensed[..., :3])).max(axis=1)
        self.peak_force = np.maximum(self.peak_force, self.peak)
        self._wrench = sensed.mean(axis=1)
        now = last(readings)
        self.insertion = self._measure(now, slice(None), self.hole)
        off = self.twin.platform_error(now, self.command) - self._askew
        self.failure[:] = np.where(off > task.snap_angle, "snap", "")
        self.failure[self.peak > task.force_limit] = "force"
        self.failure[self.twin.diverged] = "diverged"

    def _lead(self, before: Floats) -> Floats:
        """Joint commands of a control step: (n, 1, 6), held, or (n, substeps, 6)."""
        return self._targets[:, None]

    def _measure(self, readings: Readings, rows: slice, holes: NDArray[np.int64]) -> Floats:
        tip, platform, rotation = (
            np.ascontiguousarray(part[rows])
            for part in (readings.tip, readings.platform, readings.rotation)
        )
        result: Floats = kernels.insertion(
            tip, platform, rotation, holes[rows], self._mouth_radius, self._packed
        )
        return result

    def _joints(self, rows: slice) -> Floats:
        return np.ascontiguousarray(self.twin.readings().joints[rows])

    def perceived(self, rows: slice) -> tuple[Floats, Floats, Floats]:
        """What a controller perceives, with newly drawn sensor noise.

        The target (n, 5): tip - mouth, m, and x, y of its normal; joint angles (n, 6), rad; wrench
        on the peg (n, 6), N, N m.
        """
        joints, near = self._joints(rows), self._near(rows)
        view = kernels.perceive(joints, near, self.hole[rows], self._packed)
        draws = [rng.normal(size=N_AXES) for rng in self.rngs[rows]]
        return view, joints, self._wrench[rows] + np.array(draws) * self._noise[rows]

    def _near(self, rows: slice) -> Floats:
        """Nearby configurations (n, 6), from which the 3-RRS's branch is followed."""
        return self.command[rows].copy()

    def _felt(self, rows: slice) -> Floats:
        """The 29 fields that both tasks observe, SI units."""
        view, joints, wrench = self.perceived(rows)
        joints, command = joints - self._first_joints[rows], self.command[rows] - self._first[rows]
        return np.concatenate([view, joints, wrench, command, self._action[rows]], axis=1)

    def _terms(self, name: str, gained: Floats, inserted: Bools) -> dict[str, Floats]:
        """Reward terms (n,) of a step; a failure gains nothing and saves no step costs."""
        task, failed = self.task, self.failure != ""
        steps = np.where(failed, self.max_steps - self.steps + 1, 1)
        terms = {
            name: np.where(failed, 0.0, gained),
            "step": -task.step_cost * steps,
            "force": -task.force_cost * np.maximum(self.peak - task.free_force, 0.0),
            "insertion": task.insertion_bonus * inserted,
            "failure": -task.failure_cost * failed,
        }
        return {name: self.reward_scale * term for name, term in terms.items()}

    def _conclude(self, terms: dict[str, Floats], over: Bools) -> None:
        """Write the step's outcome; truncate episodes at their last step."""
        truncated = ~over & (self.steps >= self.max_steps)
        self.failure[truncated] = "time"
        reward = sum(terms.values(), np.zeros(self.n))
        info = {**self.columns(), "reward_terms": terms}
        self.outcome = self.seen(slice(None)), reward, over, truncated, info

    def columns(self) -> dict[str, Any]:
        """``info`` of all episodes, but the reward's terms, in columns (n, ...)."""
        depth, lateral, angle, _ = self.insertion.T
        return {
            "success": self.success.copy(),
            "is_success": self.success.copy(),
            "all_filled": np.all(self._wanted <= self.filled, axis=1),
            "failure": self.failure.copy(),
            "depth": depth.copy(),
            "lateral_error": lateral.copy(),
            "alignment_error": angle.copy(),
            "force": self._wrench[:, :3].copy(),
            "moment": self._wrench[:, 3:].copy(),
            "peak_force": self.peak_force.copy(),
            "violation": ~self.taken,
            "time": self.steps * self.task.dt,
            "friction": self.friction.copy(),
            "error": self.error.copy(),
            "privileged": self.privileged(slice(None)),
        }


def row_of(columns: Any, row: int) -> Any:
    """One episode's own copy of ``info`` or of its observation."""
    if isinstance(columns, Mapping):
        return {name: row_of(part, row) for name, part in columns.items()}
    return columns[row].copy() if columns.ndim > 1 else columns.item(row)
