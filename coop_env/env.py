"""The cooperative peg-in-hole task as a Gymnasium environment."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.errors import (
    ActionError,
    ArgumentError,
    StateError,
    as_dataclass,
    check_flag,
    check_integer,
)
from coop_env.geometry import DeltaGeometry, RRSGeometry, resolve_delta, resolve_rrs
from coop_env.rendering.modes import Rendered
from coop_env.rendering.scene import Scene, make_scene
from coop_env.simulation import batch, rewards, start_states, state
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask
from coop_env.simulation.observation import make_observation, observe_batch
from coop_env.simulation.sim_to_real import SimToReal, resolve
from coop_env.simulation.task import N_ACTIONS, TRAIL, EnvParams, make_params, pack

Observation = NDArray[np.float32]


class CoopInsertionEnv(Rendered):
    """A Delta carries a peg, a 3-RRS tilts a dome of holes; fill them one after another.

    ``docs/env.md`` holds the next five sections, the keys of ``info`` and the batched forms.

    **Action Space**

    ``Discrete(12)``. Even actions add one step on their axis, odd ones subtract it. A move lasts
    0.2 s. A move and its reverse cancel exactly.

    =======  =========================  ========
    Actions  Axis                       Step
    =======  =========================  ========
    0, 1     x of the Delta's effector  0.02 m
    2, 3     y                          0.02 m
    4, 5     z                          0.02 m
    6, 7     roll of the platform       0.03 rad
    8, 9     pitch                      0.03 rad
    10, 11   heave                      0.02 m
    =======  =========================  ========

    :meth:`action_masks` is True for moves that keep the limits of both workspaces, the reach of
    every limb and the joint limits. If no move is valid, all are True. An invalid or colliding move
    is not executed. It costs the violation penalty and a timestep.

    **Observation Space**

    ``Box(0, 1, (12,), float32)``, or ``(19,)`` with ``observation="markov"``. Each field is scaled
    from its bounds to [0, 1] and clipped. ``normalize=False`` leaves SI units. The
    bounds follow the geometry.

    =======  ==========================================================  =======  =================
    Field    Meaning                                                     Least    Largest
    =======  ==========================================================  =======  =================
    0, 1     x, y of the effector, Delta's frame                         -0.16 m  0.16 m
    2        z of the effector, Delta's frame                            -0.65 m  -0.25 m
    3, 4     roll, pitch                                                 -pi/4    pi/4
    5        heave                                                       0.21 m   0.25 m
    6 - 8    target hole's mouth minus tip, world frame                  -0.15 m  0.15 m
    9 - 11   outward normal of the target hole, world frame              -1       1
    12 - 17  hole filled (``markov`` only; as many as there are holes)   0        1
    18       time elapsed (``markov`` only)                              0 s      0.2 ``max_moves``
    =======  ==========================================================  =======  =================

    **Rewards**

    Flags v, z and u are 1 if their event happens and 0 otherwise. v is a violation (an invalid,
    colliding or singular move), z is a new insertion, u is the entry into a filled hole. d is the
    distance from tip to mouth in m, a is the angle between peg and normal in rad, N is the number
    of filled holes, and t is the time in s. Then::

        paper:     -3 v + (150 + 25 N + 80 (1 - t / 60)) z - u
                   without v, z, u:  -0.01 - d + 50 max(d_before - d, 0) + 200 max(0.03 - d, 0)
        progress:  -violation_penalty v + insertion_bonus z - duplicate_penalty u
                   - step_cost (1 - v) + distance_scale (d_before - d)
                   + angle_scale (a_before - a)

    An insertion is an executed move that ends with the tip within 10 mm of the mouth and the angle
    below 5 degrees. Under ``"progress"`` the last move of a failed episode pays
    ``-violation_penalty - step_cost n``. n is the number of moves left, the last move included. An
    episode fails at a singularity or, with ``collision="terminate"``, at a collision.

    **Starting State**

    sigma_min is the least singular value of the 3-RRS's Jacobian. It is 0 at a type II singularity.
    A start draws roll and pitch within +-0.5 rad, heave over its range, x and y within +-0.06 m and
    the tip 0.05 to 0.15 m above the dome's apex, uniformly. It is redrawn until valid, free of
    collision and with a sigma_min of at least 0.15. The target is uniform over the open holes.
    ``reset(options=...)`` takes ``configuration`` (x, y, z, roll, pitch, heave), ``target`` (a
    hole) and ``filled`` (holes that count as filled).

    **Episode End**

    1. Terminated: every active hole is filled, or signed sigma_min falls below 0.05
       (``info["singular"]``), or, with ``collision="terminate"``, a move would collide.
    2. Truncated: after 300 moves (60 s). Longer episodes need both limits:
       ``gymnasium.make("CoopInsertion-v0", max_moves=450, max_episode_steps=450)``.

    **Arguments**

    Most numbers above are defaults of ``geometry``, ``delta`` and ``task``. Each of these and
    ``sim_to_real`` may be a plain mapping of fields (from YAML, say). Twelve moves and six axes are
    structure, and no argument changes them.

    Args:
        geometry: ``"optimized"``, ``"initial"`` or an :class:`~coop_env.geometry.RRSGeometry`.
        reward: ``"paper"`` (the paper's equation) or ``"progress"``.
        reward_kwargs: scales of ``"progress"``, see
            ``coop_env.simulation.rewards.PROGRESS_DEFAULTS``.
        observation: ``"paper"``, 12 numbers, or ``"markov"``, with filled holes and time.
        normalize: observation in [0, 1], or in SI units.
        mask_singularities: action masks also exclude collisions and singular moves.
        mask_visited: they also exclude moves back to the last n (at most 64) configurations since
            the last insertion: 1 forbids undoing the last move, 0 nothing.
        mask_refused: they also exclude moves that were refused at the present configuration (an
            imperfect machine collides where its model does not). When all valid moves have been
            refused, all are allowed again.
        collision: a move that would collide is not executed: ``"refuse"`` goes on from there,
            ``"terminate"`` ends the episode in failure.
        stage: 0, the first holes (of the paper's, the four peripheral), or 1, all of them.
        pose_model: ``"exact"``, with parasitic motion, or ``"paper"``.
        max_moves: moves until truncation; 300 are the paper's 60 s.
        sim_to_real: None, ``"randomized"`` or a
            :class:`~coop_env.simulation.sim_to_real.SimToReal`.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``.
        delta: None, the standard robot, or a :class:`~coop_env.geometry.DeltaGeometry`.
        task: None, the paper's task, or an
            :class:`~coop_env.simulation.insertion_task.InsertionTask`: dome and holes, tolerances,
            steps, start ranges, bodies. Another number of holes compiles the kernels once more.

    Raises:
        ArgumentError: an argument is out of range (its message names the fix).
        RewardError: a reward or a scale is wrong.
        GeometryError: a robot cannot be assembled, or not at its home height.

    **Version History**

    * v0: initial version
    """

    step_batch: ClassVar[Callable[..., None]] = staticmethod(batch.step_batch)
    """The kernel of a move: arguments as :func:`coop_env.simulation.batch.step_batch`."""
    more_options: Sequence[str] = ()
    """Names of reset options that a subclass takes out before :meth:`check_options` does."""

    def __init__(
        self,
        geometry: str | RRSGeometry | Mapping[str, Any] = "optimized",
        reward: str = "paper",
        reward_kwargs: Mapping[str, float | None] | None = None,
        observation: str = "paper",
        normalize: bool = True,
        mask_singularities: bool = False,
        mask_visited: int = 0,
        mask_refused: bool = False,
        stage: int = 1,
        pose_model: str = "exact",
        max_moves: int = 300,
        sim_to_real: str | SimToReal | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        delta: DeltaGeometry | Mapping[str, Any] | None = None,
        task: InsertionTask | Mapping[str, Any] | None = None,
        collision: str = "refuse",
    ) -> None:
        if collision not in ("refuse", "terminate"):
            raise ArgumentError(f"collision = {collision!r}: must be 'refuse' or 'terminate'")
        self.set_stage(stage)
        self._task = as_dataclass("task", task, InsertionTask, {None: PAPER_TASK})
        self._set_render_mode(render_mode, self._task.dt)
        self._knobs = resolve(sim_to_real, self._task)
        self._params = make_params(
            resolve_rrs(geometry),
            rewards.make_reward(reward, reward_kwargs),
            pose_model=pose_model,
            delta=resolve_delta(delta),
            task=self._task,
            max_moves=check_integer("max_moves", max_moves, 1),
            mask_singularities=check_flag("mask_singularities", mask_singularities),
            visited=check_integer("mask_visited", mask_visited, 0, TRAIL),
            imperfect=self._knobs.active,
            refused=check_flag("mask_refused", mask_refused),
            fatal=collision == "terminate",
        )
        self._packed = pack(self._params)
        self.observation_space: spaces.Box
        self._observation, self.observation_space = make_observation(
            observation, normalize, self._params, self._task.error_bound
        )
        self.action_space: spaces.Discrete = spaces.Discrete(N_ACTIONS)
        self._states = np.zeros(1, state.state_dtype(len(self._task.holes)))
        self._outcomes = np.zeros(1, state.OUTCOME)
        self._rows = np.zeros((1, self._observation.shape[1]), np.float32)
        self._actions = np.zeros(1, np.int64)
        self._started = False

    @property
    def task(self) -> InsertionTask:
        """The task's numbers, as they were given."""
        return self._task

    @property
    def sim_to_real(self) -> SimToReal:
        """The sim-to-real knobs, which say how far the real machine may be from its model."""
        return self._knobs

    @property
    def params(self) -> EnvParams:
        """Everything fixed about this environment, as the kernels take it."""
        return self._params

    @property
    def stage(self) -> int:
        """The curriculum's stage from the next reset on, 0 (the first holes) or 1 (all); set it.

        Raises:
            ArgumentError: it is not 0 or 1.
        """
        return self._stage

    @stage.setter
    def stage(self, stage: int) -> None:
        self.set_stage(stage)

    def set_stage(self, stage: int) -> None:
        """Set :attr:`stage`, by ``env_method`` or ``call``."""
        self._stage = check_integer("stage", stage, 0, 1, hint=": the first holes, or all of them")

    @property
    def configuration(self) -> NDArray[np.float64]:
        """(x, y, z, roll, pitch, heave), (6,). Delta in its base frame, m; tilt, rad; height, m."""
        return self._started_rows()["configuration"][0].copy()

    @property
    def state(self) -> np.void:
        """A copy of the kernels' row, ``coop_env.simulation.state.state_dtype()``."""
        row: np.void = self._started_rows().copy()[0]  # row.copy() would go field by field
        return row

    @property
    def running(self) -> bool:
        """Whether an episode was started and is not over."""
        return self._started and not self._states["over"][0]

    def _started_rows(self) -> NDArray[np.void]:
        if not self._started:
            raise ResetNeeded("call reset() first: there is no state yet")
        return self._states

    def observe(self) -> Observation:
        """The present observation (size,), as the last reset or step gave it."""
        self._started_rows()
        return self._rows[0].copy()

    def configuration_status(self, configuration: Any) -> int:
        """0 valid, 1 invalid (workspace, joint limits, NaN), 2 collision, 3 singular.

        Raises:
            ResetOptionError: ``configuration`` is not six numbers.
        """
        c = np.array(start_states.as_configuration(configuration))
        return int(batch.status(c, self._packed))

    def action_masks(self) -> NDArray[np.bool_]:
        """(12,): True where the move leads to a valid configuration; all True if none does."""
        return self._masks_of(self._started_rows())[0]

    def _masks_of(self, states: NDArray[np.void]) -> NDArray[np.bool_]:
        """Action masks (n, actions) of rows of state (n,)."""
        return states["mask"].astype(bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds ``np_random``, the only source of randomness.
            options: any of ``configuration`` (6,), ``target`` (a hole) and ``filled`` (holes);
                what is not given is drawn.

        Raises:
            ResetOptionError: an option is malformed or cannot be taken; nothing changes. Or no
                start was found, and ``np_random`` has changed alone.
        """
        start = self.check_options(options)
        super().reset(seed=seed)
        self._states[:] = start_states.draw_start(start, self._params, self._knobs, self.np_random)
        self._started = True
        observe_batch(self._states, self._packed, self._observation, self._rows)
        batch.write_reset_outcome(self._states[0], self._outcomes[0])
        self._set_down()
        if self.render_mode is not None:
            self._follow(self._tip(), first=True)
        outcome: Any = self._outcomes.item(0)
        return self._rows[0].copy(), batch.make_info(outcome)

    def check_options(self, options: Mapping[str, Any] | None) -> start_states.StartOptions:
        """Options of :meth:`reset`, checked against the present stage; ResetOptionError."""
        active = self._task.active_holes(self._stage)
        return start_states.StartOptions(options, active, self._params, self.more_options)

    def _set_down(self) -> None:
        """Bring a subclass's own machine to the start, before anything is shown; here, nothing."""

    def _tip(self) -> NDArray[Any]:
        """The peg's tip (3,), world frame, m."""
        tip: NDArray[Any] = self._states["tip"][0]
        return tip

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make a move.

        Raises:
            ActionError: ``action`` is not one of the action space; nothing changes.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self.running:
            raise ResetNeeded("call reset() first: there is no running episode")
        self._actions[0] = check_action(action, int(self.action_space.n))
        self.step_batch(
            self._states, self._actions, self._packed, self._observation, self._outcomes, self._rows
        )
        outcome: Any = self._outcomes.item(0)
        if self.render_mode is not None:
            self._follow(self._tip())
        reward, terminated, truncated = outcome[-3:]
        return self._rows[0].copy(), reward, terminated, truncated, batch.make_info(outcome)

    def scene(self) -> Scene:
        """Every body of the scene at this instant, world frame."""
        state, collided = self._started_rows()[0], bool(self._outcomes["collision"][0])
        return make_scene(state, self._params, self._trace, collided)

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot: state, observation, random generator and stage."""
        return {
            # bytes, as NaN differs from NaN
            "params": (
                self._packed.tobytes(),
                self._observation.tobytes(),
                repr(self._knobs),
                repr(self._task),
                int(self.action_space.n),
            ),
            "states": self._states.copy(),
            "observations": self._rows.copy(),
            "started": self._started,
            "stage": self._stage,
            "rng": self.np_random.bit_generator.state,
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> Observation:
        """Return to a snapshot of :meth:`get_state`.

        Returns:
            The observation (size,) of that state, with the noise it had.

        Raises:
            StateError: the snapshot is of an environment with other arguments, or is none.
        """
        check_snapshot(snapshot, self.get_state())
        before = self._stage
        try:
            started = check_flag("started", snapshot["started"])
            self.set_stage(snapshot["stage"])
            self.np_random.bit_generator.state = snapshot["rng"]
        except (TypeError, ValueError, KeyError) as error:
            self._stage = before
            raise StateError(f"the snapshot's rng, stage or start is damaged: {error}") from error
        if self._states.tobytes() != snapshot["states"].tobytes():  # of another state
            self._outcomes[:] = np.zeros(1, state.OUTCOME)
        self._states[:] = snapshot["states"]
        self._rows[:] = snapshot["observations"]
        self._started = started
        self._trace = []
        return self._rows[0].copy()


def check_action(action: Any, n_actions: int = N_ACTIONS, name: str = "action") -> int:
    """The action as an int from 0 to ``n_actions - 1``; ActionError."""
    if isinstance(action, np.ndarray) and action.ndim == 0:
        action = action[()]
    return check_integer(name, action, 0, n_actions - 1, error=ActionError)


def check_snapshot(snapshot: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Raise StateError for a snapshot whose keys, shapes or parameters are not an environment's."""
    if not isinstance(snapshot, Mapping) or set(snapshot) != set(own):
        raise StateError(f"the snapshot must be a mapping with the keys {sorted(own)}")
    for key in ("states", "observations"):
        there, here = np.asarray(snapshot[key]), own[key]
        if there.dtype != here.dtype or there.shape != here.shape:
            raise StateError(
                f"the snapshot holds {there.shape} {key} of another layout than this "
                f"environment's {here.shape}: build it as the saved one was built"
            )
    if snapshot["params"] != own["params"]:
        raise StateError("the snapshot is of an environment with other arguments (geometry, ...)")
