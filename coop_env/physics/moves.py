"""The whole task in the kinematic task's twelve moves: its policies and planners play in it."""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv, Observation
from coop_env.errors import ActionError, ArgumentError, StateError, check_number
from coop_env.physics import kernels
from coop_env.physics.batch import row_of
from coop_env.physics.contact import in_units
from coop_env.physics.env import with_privileged
from coop_env.physics.joints import Floats
from coop_env.physics.task import OWN_OPTIONS, split_options, start_configurations
from coop_env.physics.whole import WholeBatch
from coop_env.rendering.scene import Scene
from coop_env.simulation import start_states
from coop_env.simulation.observation import observe_batch
from coop_env.simulation.task import N_AXES

SETTLING: Final = 4
"""Least control steps of each leg of the way to a hole, and of the rest above it."""
ROOM: Final = 0.005
"""Height of the tip's path above where the contact task begins, m."""
TOUCH: Final = 10.0
"""A mean force beyond this stops a move, N; at weak holes 15 N may push the 3-RRS over."""
Policy = Callable[[Any], Any]
"""From the contact task's observation (29,) to its increments (6,); a ``reset`` is called first."""


class Lead(WholeBatch):
    """One machine of the whole task, led from configuration to configuration."""

    def __init__(self, finish: Policy | None, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.finish = finish
        if finish is not None:
            self._above = start_configurations(self.machine, self.task.start_height)

    @property
    def configuration(self) -> Floats:
        """The commanded (x, y, z, roll, pitch, heave), (6,); m and rad."""
        return self.command[0].copy()

    @property
    def target(self) -> int:
        """The hole to aim at."""
        return int(self.hole[0])

    def reached(self) -> bool:
        """Whether the tip really meets the kinematic task's criterion at the target."""
        task, angle = self.machine.task, self.insertion[0, 2]
        return bool(self.distance[0] < task.tolerance and angle < task.angle_tolerance)

    def lead(self, to: Floats, steps: int = 1, touch: float = math.inf) -> bool:
        """Lead the machine straight to a configuration (6,), in at least so many control steps.

        Returns whether it arrived: a mean force beyond ``touch`` (N), a failure or a command that
        was not taken stop it.
        """
        way, start = to - self.command[0], self.configuration
        n = max(steps, math.ceil(float(np.max(np.abs(way) / self.increments)) - 1e-9))
        for k in range(1, n + 1):
            self.advance((start + way * (k / n))[None])
            touched = np.linalg.norm(self._wrench[0, :3]) > touch
            if self.failure[0] or not self.taken[0] or touched:
                return False
        return True

    def insert(self) -> bool:
        """Go to where the contact task begins, play the policy of that task, and withdraw.

        Returns whether the peg was 10 mm deep in the target. A hole that the machine cannot present
        upright is not tried.
        """
        start, hole = self._above[self.target], self.target
        if not np.isfinite(start).all():
            return False
        above = start.copy()
        above[2] += ROOM
        if all(self.lead(to, SETTLING) for to in (self._raised(above), above, start, start)):
            self._feel(self.finish)
        if not self.failure[0]:
            all(self.lead(to, SETTLING) for to in (self._raised(above), above))
        return bool(self.filled[0, hole])

    def _raised(self, above: Floats) -> Floats:
        """The configuration now, with the tip at least as high as there."""
        result = self.configuration
        result[2] = max(result[2], above[2])
        return result

    def _feel(self, policy: Any) -> None:
        """Play a policy of the contact task, which begins here."""
        hole, rows = self.target, slice(0, 1)
        getattr(policy, "reset", lambda: None)()
        self._first[0], self._action[0] = self.command[0], 0.0
        self._first_joints = self.perceived(rows)[1]
        for _ in range(self.task.max_steps):
            seen = in_units(self._felt(rows))[0]
            self._action = _within(policy(seen))[None]
            self.advance(self.command + self._action * self.task.increments)
            if self.failure[0] or self.filled[0, hole]:
                return


def _within(answer: Any) -> Floats:
    """A finish's answer as increments (6,) within [-1, 1]."""
    try:
        result = np.asarray(answer, np.float64)
    except (TypeError, ValueError):
        result = np.empty(0)
    if result.shape != (N_AXES,) or np.isnan(result).any():
        raise ActionError(f"finish gave {answer!r}: must be {N_AXES} increments")
    return np.clip(result, -1.0, 1.0)


class CoopInsertionPhysicsDiscreteEnv(CoopInsertionEnv):
    """``CoopInsertion-v0`` on the twin: a move leads the servos of the simulated machine.

    Spaces, masks, observation, rewards, start states and ``info`` are those of
    :class:`~coop_env.env.CoopInsertionEnv`, for where the nominal model was commanded to be. What
    happens is the twin's (``docs/physics_task.md``):

    * a move takes 0.2 s, in which joint commands are led along it;
    * one that meets a force above ``touch`` is taken back and counts as a collision, unless it
      reaches the target: there the lattice of moves begins anew;
    * without ``finish`` a hole is filled by the kinematic task's criterion, met by the real tip
      and the real hole at the end of a move;
    * with ``finish`` a move whose end meets that criterion by the nominal model is not made: the
      machine goes to where the contact task begins and the policy inserts, for 80 control steps at
      most. Then the peg is withdrawn, and the lattice of moves begins anew where it stands, 15 mm
      above the mouth. A hole that was not filled is given up: it is no target any more.

    ``info`` also has ``failure`` (``"force"``, ``"snap"``, ``"diverged"`` end the episode, as does
    ``"not inserted"``, where every hole was given up and none filled; ``"time"``), ``given_up``
    (holes), ``depth``, ``lateral_error``, ``force``, ``moment``, ``peak_force``, ``friction`` and
    ``error``; ``distance``, ``alignment_error`` and ``time`` are the simulation's, and ``singular``
    is a snap. :meth:`reset` also takes ``error`` and ``friction``.

    Args:
        finish: a policy of the contact task, from its observation (29,) to increments (6,), or
            None.
        touch: mean force that stops a move, N.
        level: as for :class:`~coop_env.physics.env.CoopInsertionPhysicsEnv`, as are ``servos``,
            ``sim_to_real`` and ``privileged``.
        arguments: as for :class:`~coop_env.env.CoopInsertionEnv`, without ``pose_model`` and
            ``collision``.

    Raises:
        DependencyNotInstalled: on import, if MuJoCo is missing; it names the extra.
        ArgumentError: an argument is out of range, or the servos cannot hold home.
        RewardError: a reward or a scale is wrong.
        GeometryError: a robot cannot be assembled.

    **Version History**

    * v0: initial version
    """

    more_options = OWN_OPTIONS

    def __init__(
        self,
        finish: Policy | None = None,
        touch: float = TOUCH,
        level: Any = "standard",
        servos: Any = None,
        sim_to_real: Any = None,
        privileged: bool = False,
        **arguments: Any,
    ) -> None:
        for name in ("pose_model", "collision"):
            if name in arguments:
                raise ArgumentError(f"{name}: the machine is simulated here; see level and servos")
        super().__init__(**arguments)
        if finish is not None and not callable(finish):
            raise ArgumentError(f"finish = {finish!r}: must be None, or a callable")
        self.touch = check_number("touch", touch, 0.0, above=True)
        robots: Any = {name: arguments[name] for name in ("geometry", "delta") if name in arguments}
        self.physics = Lead(
            finish, level, holes=self.task, servos=servos, sim_to_real=sim_to_real,
            privileged=privileged, **robots,
        )  # fmt: skip
        self._knobs = self.physics.knobs
        if privileged:
            self.observation_space: Any = with_privileged(self.observation_space)
        self._steps = max(1, round(self.task.dt / self.physics.task.dt))
        self._own: dict[str, Any] = {}

    def check_options(self, options: Any) -> start_states.StartOptions:
        own, rest = split_options(options)
        start = super().check_options(rest)
        self.physics.require_free(start.configuration, own)
        self._own = own
        return start

    def _set_down(self) -> None:
        self._started = False  # until the machine stands
        self.physics.begin(0, self._states[0], self._own, self.np_random)
        self._started = True

    def observe(self) -> Any:
        return self._seen(super().observe())

    def _tip(self) -> NDArray[Any]:
        tip: NDArray[Any] = self.physics.twin.readings().tip[0]
        return tip

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.physics.twin.require_open()
        observation, info = super().reset(seed=seed, options=options)
        return self._seen(observation), self._merge(info)

    def step(self, action: np.int64 | int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return self._seen(observation), reward, terminated, truncated, self._merge(info)

    def step_batch(self, *_: Any) -> None:
        """Make the move on the twin, and write the outputs that a kernel would."""
        body, row = self.physics, self._states[0]
        filled, was_inside = body.filled[0].copy(), row["inside"].astype(bool)
        try:
            violation = not self._move(int(self._actions[0]))
        except BaseException:  # of a finish, half-way
            self._started = False
            raise
        new = body.filled[0] & ~filled
        duplicate = not violation and bool(
            (row["inside"].astype(bool) & filled & ~was_inside).any()
        )
        row["filled"], row["active"] = body.filled[0], body.active[0]
        flags = (violation, bool(new.any()), duplicate, bool(body.over[0]), bool(body.failure[0]))
        kernels.conclude(self._states, flags, body.target, self._packed, self._outcomes)
        observe_batch(self._states, self._packed, self._observation, self._rows)
        if self._outcomes["truncated"][0]:
            body.failure[0] = "time"

    def _seen(self, own: Observation) -> Any:
        if not self.physics.is_dict:
            return own
        return {"observation": own, "privileged": self.physics.privileged(slice(0, 1))[0]}

    def _move(self, action: int) -> bool:
        """Lead the machine along a move; False where it was not made."""
        body, before = self.physics, self._states.copy()
        target, back = body.target, body.configuration
        if not kernels.take(self._states, action, self._packed):
            body.lead(back, self._steps)
            body.taken[0] = False
            return False
        if body.finish is not None and self._states["inside"][0][target]:
            if not body.insert() and not body.failure[0]:
                body.give_up(0)
            kernels.begin_again(self._states, body.command[0], self._packed)
            return True
        arrived = body.lead(self._states["configuration"][0], self._steps, self.touch)
        if body.failure[0]:
            return False
        if body.finish is None and not body.filled[0, target] and body.reached():
            body.fill(0)
        if arrived:
            return True
        self._states[:] = before
        if body.filled[0, target]:  # a contact cut the move short
            kernels.begin_again(self._states, body.command[0], self._packed)
            return True
        kernels.refuse(self._states, action, self._packed)
        body.lead(back)
        return False

    def _merge(self, info: dict[str, Any]) -> dict[str, Any]:
        """The kinematic task's ``info`` and the simulation's; where things are is the latter's."""
        real = row_of(self.physics.columns(), 0)
        if info["inserted"]:  # by now the next hole is the target
            real["distance"], real["alignment_error"] = self.physics.aimed[0].tolist()
        own = ("distance", "alignment_error", "time", "all_filled")
        measured = {name: real[name] for name in own}
        gone = real["failure"] in ("snap", "diverged")
        return {
            **real,
            **info,
            **measured,
            "collision": info["violation"] and bool(self.physics.taken[0]) and not gone,
            "singular": real["failure"] == "snap",
            "given_up": [*self.physics.given_up[0]],
        }

    def scene(self) -> Scene:
        return self.physics.scene(0, self._trace)

    def close(self) -> None:
        super().close()
        self.physics.twin.close()
        self._started = False

    def get_state(self) -> dict[str, Any]:
        """There is no snapshot of a simulation: a ``StateError``, as of :meth:`set_state`."""
        raise StateError("the physics environments have no snapshots: reset with the same seed")

    def set_state(self, snapshot: Any) -> Any:
        return self.get_state()
