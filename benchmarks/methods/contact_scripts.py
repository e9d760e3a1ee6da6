"""Scripts for the contact task, which bound what learning adds there.

All but the stiff push are admittances: the command yields to the force on the peg, by a share of an
increment per newton, and presses until the force along the hole is ``hold``. They read only the
force, the moment, the command and the tip's height in the observation.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # it needs MuJoCo, and learners of other tasks come by here
    from coop_env.physics.env import CoopInsertionContactEnv

Floats = NDArray[np.float64]
TIP_Z: Final = 2
FORCE: Final = slice(11, 14)  # fields of the observation, and one unit of each in SI units
MOMENT: Final = slice(14, 17)
COMMAND: Final = slice(17, 20)
HEAVE: Final = 22
METRES: Final = 0.01
NEWTONS: Final = 10.0
NEWTON_METRES: Final = 0.05


@dataclass(frozen=True)
class Gains:
    """Gains of the scripts; each script uses those it needs."""

    hold: float = 3.0  # force along the hole at which the command stands still, N
    give: float = 0.1  # increments of depth per N beside that
    yielding: float = 0.15  # increments to the side per N across the peg
    touch: float = 2.0  # a force along the hole beyond this is contact, N
    guide: float = 0.5  # increments per mm by which the contact lies beside the tip
    pitch: float = 0.002  # between two turns of the spiral, m
    pace: float = 1.3  # of the spiral, increments per step
    drop: float = 0.001  # the tip is in the hole this far below its first touch, m
    rise: float = 0.003  # by which the platform comes up, m; more meets the peg at full speed


class StiffPush:
    """Goes straight down, whatever is in the way."""

    def __init__(self, env: "CoopInsertionContactEnv", gains: Gains) -> None:
        self.gains, self.task = gains, env.task

    def reset(self) -> None:
        """Begin an episode."""

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """The next action (6,) after an observation (29,)."""
        action = np.zeros(6)
        self.move(action, observation.astype(np.float64))
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def move(self, action: Floats, seen: Floats) -> None:
        """Write the increments to ``action`` (6,), unclipped."""
        action[TIP_Z] = -1.0


class CompliantPush(StiffPush):
    """Goes down to the first contact, then as the forces allow."""

    def move(self, action: Floats, seen: Floats) -> None:
        """As the stiff push, with the platform rising, while nothing is touched."""
        force, g = NEWTONS * seen[FORCE], self.gains
        free = force[TIP_Z] < 0.5 * g.touch
        action[TIP_Z] = -1.0 if free else g.give * (force[TIP_Z] - g.hold)
        if free:  # no further: a command beyond the limits is not taken at all
            left = g.rise - METRES * seen[HEAVE]
            action[-1] = max(0.0, min(1.0, left / self.task.heave_step))
        action[:2] = g.yielding * force[:2]


class MomentSearch(CompliantPush):
    """Moves away from where the peg stands on the rim, which the moment about its tip shows.

    A force N along the peg at (x, y) beside its tip makes the moment (y N, -x N).
    """

    def move(self, action: Floats, seen: Floats) -> None:
        """As the compliant push, and towards the unsupported side."""
        super().move(action, seen)
        pressing = NEWTONS * seen[FORCE][TIP_Z]
        if pressing > self.gains.touch:
            moment = NEWTON_METRES * seen[MOMENT]
            beside = np.array([-moment[1], moment[0]]) / pressing
            action[:2] -= self.gains.guide * 1e3 * beside


class SpiralSearch(CompliantPush):
    """Presses along an Archimedean spiral about the first contact until the tip drops."""

    def reset(self) -> None:
        """Nothing is touched yet."""
        self._first: Floats | None = None
        self._along, self._height, self._inside = 0.0, 0.0, False

    def move(self, action: Floats, seen: Floats) -> None:
        """As the compliant push, before the spiral and after it."""
        super().move(action, seen)
        g, command, height = self.gains, METRES * seen[COMMAND], METRES * seen[TIP_Z]
        if self._first is None:
            if NEWTONS * seen[FORCE][TIP_Z] < g.touch:
                return
            self._first, self._height = command[:2], height
        self._inside |= self._height - height > g.drop
        if self._inside:
            return
        self._along += g.pace * self.task.linear_step
        turn = math.sqrt(4.0 * math.pi * self._along / g.pitch)
        radius = g.pitch * turn / (2.0 * math.pi)
        target = self._first + radius * np.array([math.cos(turn), math.sin(turn)])
        action[:2] = (target - command[:2]) / self.task.linear_step


SCRIPTS: Final[dict[str, type[StiffPush]]] = {
    "stiff push": StiffPush,
    "compliant push": CompliantPush,
    "moment-guided search": MomentSearch,
    "spiral search": SpiralSearch,
}
GRIDS: Final[dict[str, dict[str, tuple[float, ...]]]] = {
    "stiff push": {},
    "compliant push": {"hold": (3.0, 6.0, 12.0), "yielding": (0.05, 0.15, 0.3)},
    "moment-guided search": {"hold": (3.0, 6.0), "guide": (0.25, 0.5, 1.0)},
    "spiral search": {"hold": (3.0, 6.0), "pitch": (0.0016, 0.0022, 0.0028), "pace": (0.9, 1.3)},
}
"""Gains to choose from, on validation episodes."""
