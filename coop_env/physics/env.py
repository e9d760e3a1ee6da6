"""Both tasks with real contact as Gymnasium environments: one hole by feel, and all of them."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from coop_env.env import check_action
from coop_env.errors import ActionError, ArgumentError
from coop_env.geometry import DeltaGeometry, RRSGeometry
from coop_env.physics.batch import LIMIT, PRIVILEGED_UNITS, PhysicsBatch, row_of
from coop_env.physics.contact import ContactBatch
from coop_env.physics.joints import Floats
from coop_env.physics.model import Servos
from coop_env.physics.task import ContactTask
from coop_env.physics.whole import WholeBatch
from coop_env.rendering.modes import Rendered
from coop_env.rendering.scene import Scene
from coop_env.simulation.insertion_task import InsertionTask
from coop_env.simulation.sim_to_real import SimToReal
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams

Observation = Any  # an array, or with the privileged state a dictionary of two
_SLACK: Final = 1e-6  # a float32 policy may miss the bound by its rounding


class PhysicsRow(Rendered):
    """An environment that plays a row of a batch, which its owner moves."""

    def __init__(self, batch: Any, row: int, discrete: bool, render_mode: str | None) -> None:
        self.batch, self.task, self._row = batch, batch.task, row
        self._set_render_mode(render_mode, self.task.dt)
        own = spaces.Box(-LIMIT, LIMIT, (batch.n_observed,), np.float32)
        self.observation_space: Any = with_privileged(own) if batch.is_dict else own
        increments = spaces.Box(-1.0, 1.0, (N_AXES,), np.float32)
        self.action_space: Any = spaces.Discrete(N_ACTIONS) if discrete else increments
        self._running = False

    @property
    def configuration(self) -> Floats:
        """The commanded (x, y, z, roll, pitch, heave), (6,); m and rad."""
        return self.batch.command[self._row].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class says which ``options`` there are.

        Raises:
            ResetOptionError: an option is malformed, or bodies of the simulated machine overlap at
                the configuration; nothing has changed.
            GeometryError: no machine drawn within ``sim_to_real`` can take the start.
            ClosedEnvironmentError: :meth:`close` was called.
        """
        checked, row = self.batch.check_options(options), self._row
        self.batch.twin.require_open()
        super().reset(seed=seed)
        self._running = False  # until the machine stands
        self.batch.reset(row, checked, self.np_random)
        self._running = True
        if self.render_mode is not None:
            self._follow(self.batch.twin.readings().tip[row], first=True)
        info = row_of(self.batch.columns(), row)
        return row_of(self.batch.seen(slice(row, row + 1)), 0), info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """The outcome of the batch's last control step."""
        seen, reward, terminated, truncated, info = (
            row_of(part, self._row) for part in self.batch.outcome
        )
        self._running = not (terminated or truncated)
        if self.render_mode is not None:
            self._follow(self.batch.twin.readings().tip[self._row])
        return seen, reward, terminated, truncated, info

    def scene(self) -> Scene:
        """Every body of the scene at this instant, at its true place; world frame."""
        return self.batch.scene(self._row, self._trace)

    def close(self) -> None:
        """End the simulation."""
        super().close()
        self.batch.twin.close()
        self._running = False


class PhysicsEnv(PhysicsRow):
    """An environment with a batch of its own, of one row; the tasks are subclasses."""

    batch_class: type[PhysicsBatch] = ContactBatch
    discrete = False

    def __init__(
        self,
        level: str | ContactTask | Mapping[str, Any] = "standard",
        geometry: str | RRSGeometry | Mapping[str, Any] = "optimized",
        delta: DeltaGeometry | Mapping[str, Any] | None = None,
        holes: InsertionTask | Mapping[str, Any] | None = None,
        servos: Servos | Mapping[str, Any] | None = None,
        *,
        sim_to_real: str | SimToReal | Mapping[str, Any] | None = None,
        reward_scale: float = 1.0,
        privileged: bool = False,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        if more := {"n", "threads"} & set(arguments):
            raise ArgumentError(f"{min(more)}: of a batch, see make_vec; this is one machine")
        batch: Any = self.batch_class(
            level, geometry, delta, holes, servos, sim_to_real=sim_to_real,
            reward_scale=reward_scale, privileged=privileged, **arguments,
        )  # fmt: skip
        super().__init__(batch, 0, self.discrete, render_mode)

    @property
    def params(self) -> EnvParams:
        """The nominal machine as the kinematic kernels take it."""
        return self.batch.machine.kernel_params()

    @property
    def increments(self) -> Floats:
        """Size of each increment (6,); m and rad."""
        return self.batch.increments

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make one control step.

        Raises:
            ActionError: the action is not in the action space; nothing has changed.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self._running:
            raise ResetNeeded("call reset() first: there is no running episode")
        self.batch.step(self.increments_of(action)[None])
        return super().step(action)

    def increments_of(self, action: Any) -> Floats:
        """An action as increments (6,), each of -1 to 1.

        Raises:
            ActionError: it is not in the action space.
        """
        return move(check_action(action)) if self.discrete else check_increments(action, (N_AXES,))


class CoopInsertionContactEnv(PhysicsEnv):
    """A peg stands over a hole that is not quite where the machine believes; put it in, by feel.

    Both robots are simulated with their masses, servos and contact (MuJoCo). ``docs/contact.md``
    says more.

    **Action Space**

    ``Box(-1, 1, (6,))``: increments of the commanded configuration, held for one control step of
    0.05 s. One is 0.5, 0.5, 1 mm of x, y, z of the effector; 2, 2 mrad of roll, pitch and 0.5 mm of
    heave of the platform. A command beyond the robots' limits is not taken
    (``info["violation"]``).

    **Observation Space**

    ``Box(-5, 5, (29,), float32)``, everything in the units of the last column:

    =======  ====================================================================  ================
    Field    Meaning                                                               Unit
    =======  ====================================================================  ================
    0 - 2    tip - mouth, as measured joints and the nominal model have it, world  0.01 m
    3, 4     x, y of the hole's normal, by the same belief                         0.05
    5 - 10   joint angles theta, q, minus those at the start                       0.05 rad
    11 - 13  mean force on the peg over the control step, with noise               10 N
    14 - 16  mean moment on it about its tip, with noise                           0.05 N m
    17 - 22  command, minus that at the start (x, y, z, roll, pitch, heave)        0.01 m, 0.05 rad
    23 - 28  last action                                                           1
    =======  ====================================================================  ================

    **Rewards**

    ``depth``, 1 per mm that the tip gains along the real hole's axis, up to 10 mm; ``step``, -0.05;
    ``force``, -0.1 per 5 N of the step's peak force above 5 N; ``insertion``, 20; ``failure``, -5.
    At a failure ``step`` is charged for all steps that were left, and ``depth`` is zero: ending
    early never pays.

    **Starting State**

    A hole is drawn among those that the 3-RRS can turn upright. The tip stands 10 mm above where
    its mouth is believed to be; really the hole is up to 3 mm to the side (uniform over the disc)
    and tilted up to 1 degree about its mouth. Friction is 0.1 to 0.4. Options of ``reset``:
    ``hole``; ``error``, displacement along x, y (m) and tilt about x, y (rad); ``friction``.

    **Episode End**

    1. Termination, success: the tip is 10 mm deep in the bore.
    2. Termination, ``info["failure"]``: ``"force"`` (peak above 40 N), ``"snap"`` (the platform
       more than 5 degrees off its command: another assembly mode), ``"diverged"``.
    3. Truncation, ``"time"``: 80 control steps.

    Args:
        level: ``"easy"`` (round tip), ``"standard"``, ``"hard"`` (less clearance and chamfer), or a
            :class:`~coop_env.physics.task.ContactTask`.
        geometry: ``"optimized"``, ``"initial"`` or an :class:`~coop_env.geometry.RRSGeometry`.
        delta: None, the standard robot, or a :class:`~coop_env.geometry.DeltaGeometry`.
        holes: None, the paper's dome, or a ``coop_env.InsertionTask``.
        servos: None, or :class:`~coop_env.physics.model.Servos`. Each of these five may be a plain
            mapping of fields.
        sim_to_real: None, ``"randomized"`` (``sim_to_real.FORGE``) or a
            ``coop_env.SimToReal``: each episode has another machine.
        reward_scale: what all rewards are multiplied by.
        privileged: observations are dictionaries of ``observation`` and ``privileged``, which is
            ``info["privileged"]``: ``coop_env.physics.batch.PRIVILEGED``.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``; no OpenGL.

    Raises:
        DependencyNotInstalled: on import, if MuJoCo is missing; it names the extra.
        ArgumentError: an argument is out of range, or the servos cannot hold home.
        GeometryError: a robot cannot be assembled, or no hole can be turned upright.

    **Version History**

    * v0: initial version
    """


class CoopInsertionContactDiscreteEnv(CoopInsertionContactEnv):
    """The contact task in twelve moves, for Rainbow and DQN.

    ``Discrete(12)``: action ``2 k`` is one whole increment along axis ``k`` of x, y, z, roll,
    pitch, heave, ``2 k + 1`` takes it away.
    """

    discrete = True


class CoopInsertionPhysicsEnv(PhysicsEnv):
    """Bring the peg from far away to six holes one after another and push it in, by feel.

    The start states and holes are ``CoopInsertion-v0``'s: the same seed gives both the same start.
    ``docs/physics_task.md`` says more.

    **Action Space**

    ``Box(-1, 1, (6,))``: increments of the commanded configuration, spread over a control step of
    0.05 s. One is a quarter of a move of the kinematic task: 5 mm of x, y, z, 7.5 mrad of roll,
    pitch, 5 mm of heave. A command beyond the robots' limits is not taken (``info["violation"]``).

    **Observation Space**

    ``Box(-5, 5, (30 + holes,), float32)``: the contact task's 29 fields, joint angles and command
    relative to home; then for each hole whether it is filled; then the share of the time gone.
    Units: 0.1 m; 1 (normal); 1 rad (joint), 0.5 rad (tilt); 10 N; 0.05 N m.

    **Rewards**

    ``progress``, 1 per mm by which the tip nears the point 10 mm deep in the target's real bore,
    and 150 per rad by which the bore turns upright; ``step``, ``force``, ``insertion`` and
    ``failure`` as in the contact task.

    **Starting State**

    That of ``CoopInsertion-v0``. The 3-RRS's base stands askew by the contact task's unknown
    ``position_error`` and ``tilt_error``, about the point where the mouth of an aligned hole is.
    Options of ``reset``: ``configuration``, ``target``, ``filled`` of the kinematic task,
    ``error`` and ``friction`` of the contact task.

    **Episode End**

    1. Termination: the peg was 10 mm deep in every active hole, the nearest always next.
    2. Termination, ``info["failure"]``: ``"force"``, ``"snap"``, ``"diverged"``, as in contact.
    3. Truncation, ``"time"``: ``max_steps`` control steps.

    Args:
        level: as for :class:`CoopInsertionContactEnv`, whose errors, peg, friction, noise, control
            period and limits hold; ``{"position_error": 0, "tilt_error": 0}`` has no error.
        stage: 0, the four peripheral holes, or 1, all.
        max_steps: control steps until truncation.
        arguments: the others of that class, whose errors it raises.

    **Version History**

    * v0: initial version
    """

    batch_class = WholeBatch


def with_privileged(own: spaces.Space[Any]) -> spaces.Dict:
    """The space of observations that have the privileged state as well."""
    more = spaces.Box(-LIMIT, LIMIT, PRIVILEGED_UNITS.shape, np.float32)
    return spaces.Dict({"observation": own, "privileged": more})


def move(action: int) -> Floats:
    """The increments (6,) of one of the twelve moves."""
    result = np.zeros(N_AXES)
    result[action // 2] = 1.0 - 2.0 * (action % 2)
    return result


def check_increments(actions: Any, shape: tuple[int, ...]) -> Floats:
    """Actions as floats within [-1, 1].

    Raises:
        ActionError: the shape is wrong, or one is no number, not finite or out of range.
    """
    try:
        result = np.asarray(actions, np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError(f"action = {actions!r}: must be numbers of shape {shape}") from error
    if result.shape != shape:
        raise ActionError(f"action has shape {result.shape}: must be {shape}")
    if not (np.abs(result) <= 1.0 + _SLACK).all():
        raise ActionError(f"action = {actions!r}: must be finite and within -1 to 1")
    return np.clip(result, -1.0, 1.0)
