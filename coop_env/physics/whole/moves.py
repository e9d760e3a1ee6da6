"""The whole task in the kinematic task's twelve moves: its policies and planners play in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv, Observation, check_action
from coop_env.errors import ArgumentError, StateError, check_number
from coop_env.physics.whole import kernels
from coop_env.physics.whole.env import CoopInsertionPhysicsEnv, split_options
from coop_env.physics.whole.finish import Finish, Policy
from coop_env.rendering.scene import Scene
from coop_env.simulation import batch, start_states
from coop_env.simulation.observation import observe_batch

TOUCH: Final = 10.0
"""A mean force beyond this stops a move, N; of 15 N some push the 3-RRS over, at weak holes."""


class CoopInsertionPhysicsDiscreteEnv(CoopInsertionEnv):
    """``CoopInsertion-v0`` on the twin: a move leads the servos of the simulated machine.

    Spaces, masks, observation, rewards, start states and ``info`` are those of
    :class:`~coop_env.env.CoopInsertionEnv`, which is the nominal model here: masks, observation and
    rewards go by where the machine was commanded to be. What happens is the twin's:

    * a move takes 0.2 s, in which joint commands are led along it;
    * one that meets a force above ``touch`` stops; it is taken back and counts as a collision,
      unless the target is reached there;
    * without ``finish`` a hole is filled by the kinematic task's criterion, met by the real tip
      and the real hole at the end of a move;
    * with ``finish`` a move whose end meets that criterion by the nominal model is not made;
      instead the machine goes to where the contact task begins, 10 mm above the mouth and aligned,
      and the policy inserts until the peg is 10 mm deep in the bore or 80 control steps are over.
      Then the peg is withdrawn, and the lattice of moves begins anew where it stands, 15 mm above
      the mouth. A hole that was not filled is given up: it is no target any more.

    ``info`` also has ``failure`` (``"force"``, ``"snap"``, ``"diverged"`` end the episode, as does
    ``"not inserted"``, where every hole was given up and none filled; ``"time"``), ``given_up``
    (holes), ``depth``, ``lateral_error``, ``force``, ``moment``,
    ``peak_force``, ``friction`` and ``error``; ``distance``, ``alignment_error`` and ``time`` are
    the simulation's, and ``singular`` is a snap. :meth:`reset` also takes ``error`` and
    ``friction``.

    Args:
        finish: a policy of the contact task, from its observation (29,) to increments (6,), or
            None.
        touch: mean force that stops a move, N.
        level: as for :class:`~coop_env.physics.whole.env.CoopInsertionPhysicsEnv`.
        servos: likewise.
        arguments: as for :class:`~coop_env.env.CoopInsertionEnv`, without ``sim_to_real``,
            ``pose_model`` and ``collision``.

    Raises:
        DependencyNotInstalled: on import, if MuJoCo is missing; it names the extra.
        ArgumentError: an argument is unknown or out of range, or the servos cannot hold home.
        RewardError: so is a reward or one of its scales.
        GeometryError: a robot cannot be assembled.

    **Version History**

    * v0: initial version
    """

    def __init__(
        self,
        finish: Policy | None = None,
        touch: float = TOUCH,
        level: Any = "standard",
        servos: Any = None,
        **arguments: Any,
    ) -> None:
        for name in ("sim_to_real", "pose_model", "collision"):
            if name in arguments:
                raise ArgumentError(f"{name}: the machine is simulated here; see level and servos")
        super().__init__(**arguments)
        if finish is not None and not callable(finish):
            raise ArgumentError(f"finish = {finish!r}: must be None, or a callable")
        self.touch = check_number("touch", touch, 0.0, above=True)
        shared = {name: arguments[name] for name in ("geometry", "delta") if name in arguments}
        self.physics = CoopInsertionPhysicsEnv(level, holes=self.task, servos=servos, **shared)
        self._finish = None if finish is None else Finish(self.physics, finish)
        self._steps = max(1, round(self.task.dt / self.physics.task.dt))
        self._held: dict[str, Any] = {}

    def check_options(self, options: Any) -> start_states.StartOptions:
        """Reset options as :meth:`reset` takes them, checked against the present stage.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken.
        """
        held, rest = split_options(options)
        found = super().check_options(rest)
        self._held = held
        return found

    def _set_down(self) -> None:
        self.physics.np_random = self.np_random
        self.physics.begin(self._states[0], self._held)

    def _tip(self) -> NDArray[Any]:
        tip: NDArray[Any] = self.physics.twin.readings().tip[0]
        return tip

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; options ``error`` and ``friction`` beside the kinematic task's.

        Raises:
            ResetOptionError: an option is malformed, or names a state that cannot be taken. The
                environment is left as it was.
        """
        observation, info = super().reset(seed=seed, options=options)
        return observation, self._tell(info)

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Make a move.

        Raises:
            ActionError: ``action`` is not one of the action space. The environment is left as it
                was.
            ResetNeeded: the episode is over, or none was started.
        """
        if not self.running:
            raise ResetNeeded("call reset() first: there is no running episode")
        made, body = check_action(action), self.physics
        before, filled = self._states.copy(), body.filled.copy()
        violation = not self._move(made)
        new = body.filled & ~filled
        row = self._states[0]
        inside = row["inside"].astype(bool) & filled & ~before[0]["inside"].astype(bool)
        row["filled"], row["active"] = body.filled, body.active
        kernels.conclude(
            self._states, before,
            (violation, bool(new.any()), not violation and bool(inside.any()), body.over,
             bool(body.failure)),
            body.target, self._packed, self._outcomes,
        )  # fmt: skip
        observe_batch(self._states, self._packed, self._observation, self._rows)
        outcome: Any = self._outcomes.item(0)
        reward, terminated, truncated = outcome[-3:]
        if truncated:
            body.failure = "time"
        info = self._tell(batch.make_info(outcome))
        info["collision"] = violation and body.taken
        if self.render_mode is not None:
            self._follow(self._tip())
        return self._rows[0].copy(), reward, terminated, truncated, info

    def _move(self, action: int) -> bool:
        """Lead the machine along a move; False where it was not made."""
        body, before = self.physics, self._states.copy()
        target, back = body.target, body.configuration
        if not kernels.take(self._states, action, self._packed):
            body.lead(back, self._steps)
            body.taken = False
            return False
        if self._finish is not None and self._states["inside"][0][target]:
            if not self._finish() and not body.failure:
                body.give_up()
            kernels.begin_again(self._states, body.command[0], self._packed)
            return True
        arrived = body.lead(self._states["configuration"][0], self._steps, self.touch)
        if body.failure or body.filled[target]:
            return not body.failure
        if self._finish is None and body.reached():
            body.fill()
        elif not arrived:
            self._states[:] = before
            kernels.refuse(self._states, action, self._packed)
            body.lead(back)
            return False
        return True

    def _tell(self, info: dict[str, Any]) -> dict[str, Any]:
        body = self.physics
        found = {**info, **body.measured(), "failure": body.failure}
        found["violation"], found["singular"] = info["violation"], body.failure == "snap"
        if info["inserted"]:  # by now the next hole is the target
            found["distance"], found["alignment_error"] = body.aimed
        return {**found, "given_up": list(body.given_up)}

    def scene(self) -> Scene:
        """Every body of the scene at this instant, where it really is; world frame."""
        trace = np.array(self._trace, np.float64).reshape(-1, 3)
        return replace(self.physics.scene(), trace=trace)

    def close(self) -> None:
        """End the simulation."""
        super().close()
        self.physics.close()

    def get_state(self) -> dict[str, Any]:
        """There is no snapshot of a simulation.

        Raises:
            StateError: always.
        """
        raise StateError("the physics environments have no snapshots: reset with the same seed")

    def set_state(self, snapshot: Any) -> Observation:
        """There is no snapshot of a simulation.

        Raises:
            StateError: always.
        """
        raise StateError("the physics environments have no snapshots: reset with the same seed")
