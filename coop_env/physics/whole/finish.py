"""The end of an approach: a policy of the contact task inserts the peg in the whole task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from coop_env.physics.contact.batch import in_units
from coop_env.physics.contact.task import start_configurations
from coop_env.physics.joints import Floats
from coop_env.physics.whole.env import CoopInsertionPhysicsEnv
from coop_env.simulation.task import N_AXES

SETTLING: Final = 4
"""Control steps that each leg of the way to a hole takes at least, and rest above it."""
ROOM: Final = 0.005
"""By which the tip passes above where the contact task begins, m."""
Policy = Callable[[Any], Any]
"""From the contact task's observation (29,) to its increments (6,); a ``reset`` is called first."""


class Finish:
    """Goes to where the contact task begins, plays a policy of that task, and withdraws.

    Args:
        env: the whole task; its target is the hole.
        policy: what inserts.
    """

    def __init__(self, env: CoopInsertionPhysicsEnv, policy: Policy) -> None:
        self.env, self.policy = env, policy
        self._starts = start_configurations(env.twin.machine, env.task.start_height)

    def __call__(self) -> bool:
        """Whether the peg was 10 mm deep in the target; it is out again, unless the episode ended.

        A hole that the machine cannot present upright is not tried.
        """
        env, start = self.env, self._starts[self.env.target]
        if not np.isfinite(start).all():
            return False
        hole, above, up = env.target, start.copy(), env.configuration
        above[2] += ROOM
        up[2] = max(up[2], above[2])
        if self._go(up, above, start, start):
            self._play()
        if not env.failure:
            up = env.configuration
            up[2] = max(up[2], above[2])
            self._go(up, above)
        return bool(env.filled[hole])

    def _go(self, *way: Floats) -> bool:
        """Lead the machine from one configuration to the next; False where a failure ends it."""
        return all(self.env.lead(to, SETTLING) for to in way)

    def _play(self) -> None:
        env, hole = self.env, self.env.target
        getattr(self.policy, "reset", lambda: None)()
        first, action = env.configuration, np.zeros(N_AXES)
        joints = env.perceived()[1]
        for _ in range(env.task.max_steps):
            view, angles, wrench = env.perceived()
            offset = env.configuration - first
            seen = in_units(view, angles - joints, wrench, offset[None], action[None])[0]
            action = np.clip(np.asarray(self.policy(seen), np.float64), -1.0, 1.0)
            env.advance(env.configuration + action * env.task.increments)
            if env.failure or env.filled[hole]:
                return
