"""Insertion by contact as a Gymnasium environment, continuous and discrete."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.env import check_action
from coop_env.errors import ActionError, as_dataclass
from coop_env.geometry import DeltaGeometry, RRSGeometry, resolve_delta, resolve_rrs
from coop_env.physics.contact.batch import FAILURES, LIMIT, N_OBSERVED, ContactBatch, Outcome
from coop_env.physics.contact.scene import twin_scene
from coop_env.physics.contact.task import ContactTask, check_options, resolve_task
from coop_env.physics.joints import Floats
from coop_env.physics.model import Machine, Servos
from coop_env.rendering.modes import Rendered
from coop_env.rendering.scene import Scene
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams

Observation = NDArray[np.float32]
_SLACK: Final = 1e-6  # a float32 policy may miss the bound by its rounding


def make_machine(
    task: ContactTask,
    geometry: Any = "optimized",
    delta: Any = None,
    holes: Any = None,
    servos: Any = None,
) -> Machine:
    """The machine of an environment's arguments.

    Raises:
        ArgumentError: one of them is of the wrong kind or out of range.
        GeometryError: a robot is impossible.
    """
    return Machine(
        resolve_rrs(geometry),
        resolve_delta(delta),
        PAPER_TASK if holes is None else as_dataclass("holes", holes, InsertionTask),
        Servos() if servos is None else as_dataclass("servos", servos, Servos),
        task.peg,
        task.timestep,
        task.contact_time,
        task.effector_play,
    )


class CoopInsertionContactEnv(Rendered):
    """A peg stands over a hole that is not quite where the machine believes; put it in, by feel.

    Both robots are simulated with their masses, servos and contact (MuJoCo). ``docs/contact.md``
    says all of this at length.

    **Action Space**

    ``Box(-1, 1, (6,))``: increments of the commanded configuration, from which inverse kinematics
    make joint commands, held for one control step of 0.05 s. One is 0.5, 0.5, 1 mm of x, y, z of
    the effector; 2, 2 mrad of roll, pitch and 0.5 mm of heave of the platform. A command beyond the
    robots' limits is not taken (``info["violation"]``).

    **Observation Space**

    ``Box(-5, 5, (29,), float32)``, everything in the units of the last column:

    =======  ====================================================================  ================
    Field    Meaning                                                               One is
    =======  ====================================================================  ================
    0 - 2    tip - mouth, as measured joints and the nominal model have it, world  0.01 m
    3, 4     x, y of the hole's normal, by the same belief                         0.05
    5 - 10   joint angles theta, q, from those at the start                        0.05 rad
    11 - 13  mean force on the peg over the control step, with noise               10 N
    14 - 16  mean moment on it about its tip, with noise                           0.05 N m
    17 - 22  command, from that at the start (x, y, z, roll, pitch, heave)         0.01 m, 0.05 rad
    23 - 28  last action                                                           1
    =======  ====================================================================  ================

    **Rewards**

    =============  ======================================================
    Term           Reward
    =============  ======================================================
    ``depth``      1 per mm that the tip gains along the real hole's axis
    ``step``       -0.05
    ``force``      -0.1 per 5 N of the step's peak force above 5 N
    ``insertion``  20
    ``failure``    -5 at the end by force, snap or diverging
    =============  ======================================================

    Depth beyond the required 10 mm pays nothing. At a failure ``step`` is charged for all steps
    that were left, and ``depth`` is zero: ending it never pays.

    **Starting State**

    A hole is drawn among those that the 3-RRS can turn upright; the tip stands 10 mm above where
    its mouth is believed to be, aligned. Really it stands up to 3 mm to the side (uniform over the
    disc) and is tilted up to 1 degree about its mouth, because the 3-RRS's base stands askew.
    Friction is drawn in 0.1 to 0.4. Options of :meth:`reset`: ``hole``; ``error``, the displacement
    along x, y (m) and tilt about x, y (rad); ``friction``.

    **Episode End**

    1. Termination, success: the tip is 10 mm deep in the bore.
    2. Termination, ``info["failure"]``: ``"force"`` (peak above 40 N), ``"snap"`` (the platform
       more than 5 degrees off its command: another assembly mode) or ``"diverged"`` (the
       simulation).
    3. Truncation, ``"time"``: 80 control steps.

    Args:
        level: ``"easy"`` (round tip), ``"standard"``, ``"hard"`` (less clearance and chamfer), or a
            :class:`~coop_env.physics.contact.task.ContactTask`.
        geometry: ``"optimized"``, ``"initial"`` or an :class:`~coop_env.geometry.RRSGeometry`.
        delta: None, the standard robot, or a :class:`~coop_env.geometry.DeltaGeometry`.
        holes: None, the paper's dome, or a
            :class:`~coop_env.simulation.insertion_task.InsertionTask`.
        servos: None, or :class:`~coop_env.physics.model.Servos`. Each of these five may be a plain
            mapping of fields.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``; no OpenGL.

    Raises:
        DependencyNotInstalled: on import, if MuJoCo is missing; it names the extra.
        ArgumentError: an argument is unknown or out of range, or the servos cannot hold home.
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.

    **Version History**

    * v0: initial version
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        **Rendered.metadata,
        "render_fps": round(1.0 / ContactTask().dt),
    }
    discrete = False

    def __init__(
        self,
        level: str | ContactTask | Mapping[str, Any] = "standard",
        geometry: str | RRSGeometry | Mapping[str, Any] = "optimized",
        delta: DeltaGeometry | Mapping[str, Any] | None = None,
        holes: InsertionTask | Mapping[str, Any] | None = None,
        servos: Servos | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._set_render_mode(render_mode)
        self.task = resolve_task(level)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.task.dt))}
        machine = make_machine(self.task, geometry, delta, holes, servos)
        self.batch = ContactBatch(self.task, machine)
        self.observation_space, self.action_space = make_spaces(self.discrete)
        self._running = False
        self._status = "running"

    @property
    def params(self) -> EnvParams:
        """The nominal machine as the kinematic kernels take it."""
        return self.batch.twin.machine.kernel_params()

    @property
    def increments(self) -> Floats:
        """What one is of each increment (6,); m and rad."""
        return self.task.increments

    @property
    def configuration(self) -> Floats:
        """The commanded (x, y, z, roll, pitch, heave), (6,); m and rad."""
        return self.batch.command[0].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; ``options`` may set ``hole``, ``error`` and ``friction``.

        Raises:
            ResetOptionError: an option is malformed. The environment is left as it was.
        """
        given = check_options(options, self.batch.starts)
        super().reset(seed=seed)
        info = self.batch.reset(0, given, self.np_random)
        self._running, self._status = True, "running"
        if self.render_mode is not None:
            self._follow(self.batch.twin.readings().tip[0], first=True)
        return self.batch.observation[0].copy(), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one control step.

        Raises:
            ActionError: the action is not in the action space. The environment is left as it was.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self._running:
            raise ResetNeeded("call reset() first: there is no running episode")
        outcome = self.batch.step(self.increments_of(action)[None], [self.np_random])
        ended = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._running = not any(ended)
        reward, info = float(outcome.reward[0]), row_info(self.batch, outcome, 0)
        self._status = "success" if info["success"] else info["failure"] or "running"
        if self.render_mode is not None:
            self._follow(self.batch.twin.readings().tip[0])
        return outcome.observation[0], reward, *ended, info

    def scene(self) -> Scene:
        """Every body of the scene at this instant, where it really is; world frame."""
        return twin_scene(self.batch, 0, self._status, self._trace)

    def close(self) -> None:
        """End the simulation."""
        super().close()
        self.batch.twin.close()
        self._running = False

    def increments_of(self, action: Any) -> Floats:
        """An action as increments (6,), each of -1 to 1.

        Raises:
            ActionError: it is not in the action space.
        """
        return move(check_action(action)) if self.discrete else check_increments(action, (N_AXES,))


class CoopInsertionContactDiscreteEnv(CoopInsertionContactEnv):
    """The contact task in twelve moves, for Rainbow and DQN.

    ``Discrete(12)``: action ``2 k`` is one whole increment along axis ``k`` of x, y, z, roll,
    pitch, heave, ``2 k + 1`` takes it away; all else is
    :class:`CoopInsertionContactEnv`'s.
    """

    discrete = True


def make_spaces(discrete: bool) -> tuple[spaces.Box, spaces.Space[Any]]:
    """Observation and action space of one environment, its own: a space has a generator."""
    observations = spaces.Box(-LIMIT, LIMIT, (N_OBSERVED,), np.float32)
    if discrete:
        return observations, spaces.Discrete(N_ACTIONS)
    return observations, spaces.Box(-1.0, 1.0, (N_AXES,), np.float32)


def move(action: int) -> Floats:
    """The increments (6,) of one of the twelve moves."""
    found = np.zeros(N_AXES)
    found[action // 2] = 1.0 - 2.0 * (action % 2)
    return found


def check_increments(actions: Any, shape: tuple[int, ...]) -> Floats:
    """Actions as floats within [-1, 1].

    Raises:
        ActionError: the shape is wrong, or one is no number, not finite or out of range.
    """
    try:
        found = np.asarray(actions, np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"action = {actions!r}: must be numbers of shape {shape}") from error
    if found.shape != shape:
        raise ActionError(f"action has shape {found.shape}: must be {shape}")
    if not (np.abs(found) <= 1.0 + _SLACK).all():
        raise ActionError(f"action = {actions!r}: must be finite and within -1 to 1")
    return np.clip(found, -1.0, 1.0)


def row_info(batch: ContactBatch, outcome: Outcome, row: int) -> dict[str, Any]:
    """One episode's ``info`` after a step."""
    terms = {name: float(part[row]) for name, part in outcome.info["reward_terms"].items()}
    found = {
        name: part[row].copy() if part.ndim > 1 else part[row].item()
        for name, part in outcome.info.items()
        if name != "reward_terms"
    }
    success = bool(outcome.success[row])
    return {
        "success": success,
        "is_success": success,
        "failure": FAILURES[int(outcome.failure[row])],
        **found,
        **batch.episode(row),
        "reward_terms": terms,
    }
