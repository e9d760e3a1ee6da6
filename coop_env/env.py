"""The cooperative peg-in-hole task as a Gymnasium environment."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from numpy.typing import NDArray

from coop_env.compilation import report_compilation
from coop_env.errors import ActionError, ArgumentError, StateError
from coop_env.geometry import GEOMETRIES, GeometryError, RRSGeometry
from coop_env.kinematics import rrs_kernels
from coop_env.rendering.scene import Scene, make_scene
from coop_env.simulation import batch, rewards, start_states, state, task
from coop_env.simulation.observation import make_observation, observe_batch
from coop_env.simulation.sim_to_real import SimToReal, resolve
from coop_env.simulation.task import N_ACTIONS, EnvParams, TaskParams

Observation = NDArray[np.float32]


class CoopInsertionEnv(gym.Env[Any, Any]):
    """A Delta carries a peg, a 3-RRS tilts a dome of six holes; fill them one after another.

    The class is documented in ``docs/env.md``: spaces, reward, episode end, arguments.

    Args:
        geometry: ``"optimized"``, ``"initial"`` or an :class:`~coop_env.geometry.RRSGeometry`.
        reward: ``"paper"`` (equation (reward) to the letter) or ``"progress"``.
        reward_kwargs: scales of ``"progress"``, see
            :data:`coop_env.simulation.rewards.PROGRESS_DEFAULTS`.
        observation: ``"paper"``, 12 numbers, or ``"markov"``, 19 with filled holes and time.
        normalize: observation in [0, 1], or in SI units.
        mask_singularities: action masks also exclude collisions and singular moves.
        mask_visited: they also exclude moves back to the last so many configurations (at most 64)
            visited since the last insertion: 1 forbids undoing the last move, 0 nothing.
        stage: 0, the four peripheral holes, or 1, all six.
        pose_model: ``"exact"``, with parasitic motion, or ``"paper"``.
        max_moves: moves until truncation; 300 are the paper's 60 s.
        sim_to_real: None, ``"randomized"`` or a
            :class:`~coop_env.simulation.sim_to_real.SimToReal`.
        render_mode: None, ``"rgb_array"``, ``"human"`` or ``"ansi"``.

    Raises:
        ArgumentError: an argument is unknown or out of range (its message names the mend).
        RewardError: so is a reward or one of its scales.
        GeometryError: the 3-RRS cannot be assembled at its home height.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array", "human", "ansi"],
        "render_fps": round(1.0 / task.DT),
    }
    render_kwargs: Mapping[str, Any] = MappingProxyType({})
    """``size``, ``camera``, ``panel``, ``samples`` of :func:`coop_env.rendering.render_frame` for
    the modes ``"rgb_array"`` and ``"human"``; set it on the instance, for a window before reset."""

    def __init__(
        self,
        geometry: str | RRSGeometry = "optimized",
        reward: str = "paper",
        reward_kwargs: Mapping[str, float | None] | None = None,
        observation: str = "paper",
        normalize: bool = True,
        mask_singularities: bool = False,
        mask_visited: int = 0,
        stage: int = 1,
        pose_model: str = "exact",
        max_moves: int = 300,
        sim_to_real: str | SimToReal | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            modes = self.metadata["render_modes"]
            raise ArgumentError(f"render_mode = {render_mode!r}: must be None or one of {modes}")
        self.render_mode = render_mode
        self._stage = start_states.check_stage(stage)
        self._knobs = resolve(sim_to_real)
        self._params = _params(
            _geometry(geometry),
            rewards.make_reward(reward, reward_kwargs),
            pose_model,
            _task(max_moves, mask_singularities, mask_visited, self._knobs.active),
        )
        self._packed = task.pack(self._params)
        self.observation_space: spaces.Box
        self._observation, self.observation_space = make_observation(
            observation, normalize, self._params
        )
        self.action_space = spaces.Discrete(N_ACTIONS)
        self._states = np.zeros(1, state.STATE)
        self._outcomes = np.zeros(1, state.OUTCOME)
        self._rows = np.zeros((1, self._observation.shape[1]), np.float32)
        self._actions = np.zeros(1, np.int64)
        self._started = False
        self._trace: list[NDArray[np.float64]] = []
        self._window: Any = None

    @property
    def params(self) -> EnvParams:
        """Everything fixed about this environment, as the kernels take it."""
        return self._params

    @property
    def stage(self) -> int:
        """The curriculum's stage from the next reset on; set it, or call :meth:`set_stage`."""
        return self._stage

    @stage.setter
    def stage(self, stage: int) -> None:
        self.set_stage(stage)

    def set_stage(self, stage: int) -> None:
        """Choose the active holes from the next reset on: 0 the four peripheral, 1 all six."""
        self._stage = start_states.check_stage(stage)

    @property
    def configuration(self) -> NDArray[np.float64]:
        """(x, y, z, roll, pitch, heave), (6,): Delta in its base frame, m; tilt, rad; height, m."""
        return self._row["configuration"].copy()

    @property
    def state(self) -> np.void:
        """A copy of the row of :data:`coop_env.simulation.state.STATE` that the kernels work on."""
        return self._row.copy()

    @property
    def _row(self) -> np.void:
        if not self._started:
            raise ResetNeeded("call reset() first: there is no state yet")
        row: np.void = self._states[0]
        return row

    def configuration_status(self, configuration: Any) -> int:
        """0 valid, 1 invalid (workspace, joint limits, NaN), 2 collision, 3 singular.

        Raises:
            ResetOptionError: ``configuration`` is not six numbers.
        """
        c = start_states.as_configuration(configuration)
        return int(state.configuration_status(c, self._params))

    def action_masks(self) -> NDArray[np.bool_]:
        """(12,): True where the move leads to a valid configuration; all True if none does."""
        return self._row["mask"].astype(bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds ``np_random``, the only source of randomness.
            options: any of ``configuration`` (6,), ``target`` (a hole) and ``filled`` (holes);
                what is not given is drawn.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken. The
                environment is left as it was.
        """
        start = start_states.StartOptions(options, self._stage, self._params)
        super().reset(seed=seed)
        self._states[:] = start_states.draw_start(start, self._params, self._knobs, self.np_random)
        self._started = True
        observe_batch(self._states, self._packed, self._observation, self._rows)
        report_compilation()
        if self.render_mode is not None:
            self._trace = [self._states["tip"][0].copy()]
            self._show()
        return self._rows[0].copy(), self._reset_info()

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make a move.

        Raises:
            ActionError: ``action`` is not an integer 0 to 11. The environment is left as it was.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self._started or self._states["over"][0]:
            raise ResetNeeded("call reset() first: there is no running episode")
        self._actions[0] = check_action(action)
        batch.step_batch(
            self._states, self._actions, self._packed, self._observation, self._outcomes, self._rows
        )
        report_compilation()
        outcome: Any = self._outcomes.item(0)
        if self.render_mode is not None:
            self._trace.append(self._states["tip"][0].copy())
            self._show()
        reward, terminated, truncated = outcome[-3:]
        return self._rows[0].copy(), reward, terminated, truncated, batch.make_info(outcome)

    def _reset_info(self) -> dict[str, Any]:
        """The keys of a move's info, before any move."""
        row = self._states[0]
        outcome: Any = np.zeros(1, state.OUTCOME)
        outcome["n_filled"] = row["filled"].sum()
        outcome["inserted_hole"] = -1
        outcome["sigma_min"] = row["sigma"]
        outcome["alignment_error"] = row["angle"]
        outcome["distance"] = row["distance"]
        outcome["target"] = row["target"]
        return batch.make_info(outcome.item(0))

    def scene(self) -> Scene:
        """Every body of the scene at this instant, world frame."""
        return make_scene(self._row, self._params, self._trace)

    def render(self) -> Any:
        """A frame (height, width, 3) of uint8, text, or None, as ``render_mode`` says.

        Raises:
            DependencyNotInstalled: what the mode needs is not installed.
        """
        if self.render_mode is None:
            gym.logger.warn("render() without a render_mode does nothing: give one to make()")
            return None
        if self.render_mode == "ansi":
            return self.scene().describe()
        if self.render_mode == "human":
            return self._show()
        return _rendering("render_frame")(self.scene(), **self.render_kwargs)

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            fps = self.metadata["render_fps"]
            self._window = _rendering("open_window")(fps, **self.render_kwargs)
        self._window.show(self.scene())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def get_state(self) -> dict[str, Any]:
        """An exact, picklable snapshot: the state, the random generator and the stage."""
        return {
            "params": (self._params, self._knobs),
            "states": self._states.copy(),
            "started": self._started,
            "stage": self._stage,
            "rng": self.np_random.bit_generator.state,
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a snapshot of :meth:`get_state`.

        Raises:
            StateError: the snapshot is of an environment with other arguments, or is none.
        """
        check_snapshot(snapshot, self.get_state())
        self._states[:] = snapshot["states"]
        self._started = snapshot["started"]
        self._stage = snapshot["stage"]
        self.np_random.bit_generator.state = snapshot["rng"]
        self._trace = []

    def _attach(
        self,
        states: NDArray[np.void],
        outcomes: NDArray[np.void],
        rows: NDArray[np.float32],
    ) -> None:
        """Work on one row (1, ...) of a batch's arrays instead of arrays of its own."""
        self._states, self._outcomes, self._rows = states, outcomes, rows


def _rendering(name: str) -> Any:
    """A function of :mod:`coop_env.rendering`, imported only when something is to be seen."""
    try:
        return getattr(importlib.import_module("coop_env.rendering"), name)
    except (ImportError, AttributeError) as error:
        raise DependencyNotInstalled(
            f"rendering needs pip install 'sb3-rainbow-coop[render]': {error}"
        ) from error


def check_action(action: Any) -> int:
    """The action as an int.

    Raises:
        ActionError: it is not an integer 0 to 11.
    """
    if isinstance(action, np.ndarray) and action.ndim == 0:
        action = action[()]
    if not isinstance(action, (int, np.integer)) or isinstance(action, bool):
        raise ActionError(f"action = {action!r}: must be an integer 0 to {N_ACTIONS - 1}")
    if not 0 <= action < N_ACTIONS:
        raise ActionError(f"action = {action!r}: must be an integer 0 to {N_ACTIONS - 1}")
    return int(action)


def check_snapshot(snapshot: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Compare a snapshot with one of the environment that is to take it.

    Raises:
        StateError: its keys, its shapes or its parameters differ.
    """
    if not isinstance(snapshot, Mapping) or set(snapshot) != set(own):
        raise StateError(f"the snapshot must be a mapping with the keys {sorted(own)}")
    states = snapshot["states"]
    if states.dtype != own["states"].dtype or states.shape != own["states"].shape:
        raise StateError(
            f"the snapshot holds {states.shape} states of another layout than this "
            f"environment's {own['states'].shape}: build it as the saved one was built"
        )
    if repr(snapshot["params"]) != repr(own["params"]):  # repr, as NaN does not equal itself
        raise StateError("the snapshot is of an environment with other arguments (geometry, ...)")


def _geometry(geometry: str | RRSGeometry) -> RRSGeometry:
    if isinstance(geometry, RRSGeometry):
        return geometry
    if isinstance(geometry, str) and geometry in GEOMETRIES:
        return GEOMETRIES[geometry]
    raise ArgumentError(
        f"geometry = {geometry!r}: must be one of {sorted(GEOMETRIES)} or an RRSGeometry"
    )


def _task(
    max_moves: int, mask_singularities: bool, mask_visited: int, imperfect: bool
) -> TaskParams:
    if isinstance(max_moves, bool) or not isinstance(max_moves, (int, np.integer)):
        raise ArgumentError(f"max_moves = {max_moves!r}: must be an integer of at least 1")
    if max_moves < 1:
        raise ArgumentError(f"max_moves = {max_moves!r}: must be an integer of at least 1")
    if not isinstance(mask_singularities, bool):
        raise ArgumentError(f"mask_singularities = {mask_singularities!r}: must be True or False")
    if (
        isinstance(mask_visited, bool)
        or not isinstance(mask_visited, (int, np.integer))
        or not 0 <= mask_visited <= task.TRAIL
    ):
        raise ArgumentError(
            f"mask_visited = {mask_visited!r}: must be an integer from 0 to {task.TRAIL}"
        )
    return TaskParams(
        max_moves=int(max_moves),
        mask_singularities=mask_singularities,
        visited=int(mask_visited),
        imperfect=imperfect,
    )


def _params(
    geometry: RRSGeometry, reward: task.RewardParams, pose_model: str, task_params: TaskParams
) -> EnvParams:
    if pose_model not in ("exact", "paper"):
        raise ArgumentError(f"pose_model = {pose_model!r}: must be 'exact' or 'paper'")
    p = task.make_params(geometry, reward, pose_model=pose_model, task=task_params)
    if not rrs_kernels.is_valid(0.0, 0.0, geometry.home_heave, p.rrs):
        raise GeometryError(
            f"the 3-RRS cannot take its home pose at home_heave = {geometry.home_heave} m within "
            "its joint limits: choose other lengths, another height or wider limits"
        )
    return p
