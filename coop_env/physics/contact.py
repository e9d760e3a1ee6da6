"""Episodes of the contact task: one peg above one hole."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.errors import ResetOptionError, check_keys
from coop_env.physics.batch import LIMIT, OBSERVED, PhysicsBatch
from coop_env.physics.joints import Floats
from coop_env.physics.task import OWN_OPTIONS, draw_error, split_options, start_configurations
from coop_env.simulation.collision import peg_tip
from coop_env.simulation.task import N_AXES

UNITS: Final = np.repeat([0.01, 0.05, 0.05, 10.0, 0.05, 0.01, 0.05, 0.01, 1.0], OBSERVED)
"""Units of the contact task's 29 fields: m, rad, N, N m."""


def in_units(fields: Floats) -> NDArray[np.float32]:
    """Observations (n, 29) of the contact task, of fields (n, 29) in SI units."""
    return np.clip(fields / UNITS, -LIMIT, LIMIT).astype(np.float32)


class ContactBatch(PhysicsBatch):
    """Episodes of the contact task: one peg above one hole.

    ``starts`` (holes, 6) are the configurations above the holes, NaN where one cannot be presented.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.n_observed, self.increments = len(UNITS), self.task.increments
        self.starts = start_configurations(self.machine, self.task.start_height)
        self._open = np.flatnonzero(np.isfinite(self.starts[:, 0]))
        self._to_tip = np.array(peg_tip(0.0, 0.0, 0.0, self.machine.kernel_params().delta))
        self._believed, self._paid = np.zeros((self.n, N_AXES)), np.zeros(self.n)

    def check_options(self, options: Any) -> dict[str, Any]:
        own, rest = split_options(options)
        hole, choices = rest.pop("hole", None), self._open.tolist()
        check_keys("options", rest, ["hole", *OWN_OPTIONS], ResetOptionError)
        if hole is None:
            return own
        whole = isinstance(hole, (int, np.integer)) and not isinstance(hole, bool)
        if not whole or hole not in choices:
            raise ResetOptionError(f"hole = {hole!r}: must be one of {choices}")
        return {**own, "hole": int(hole)}

    def reset(self, row: int, options: Any, rng: np.random.Generator) -> None:
        error = draw_error(self.task, rng)  # drawn whether or not an option sets it
        hole, friction = int(rng.choice(self._open)), float(rng.uniform(*self.task.friction))
        self.hole[row] = hole = options.get("hole", hole)
        self.active[row] = self._wanted[row] = np.arange(len(self.starts)) == hole
        self.filled[row] = False
        start = self.starts[hole]
        mouth = start[:3] + self._to_tip - [0.0, 0.0, self.task.start_height]
        self._place(row, start, mouth, options, (error, friction), rng)
        self._first[row] = self._believed[row] = start
        self._paid[row] = self.insertion[row, 0]
        rows = slice(row, row + 1)
        self._first_joints[row] = self._joints(rows)[0]

    def step(self, actions: Floats) -> None:
        task = self.task
        self._action = np.array(actions, np.float64)
        self._advance(self.command + actions * self.increments)
        depth = self.insertion[:, 0]
        self.success = (depth >= task.insertion_depth) & (self.failure == "")
        self.filled = self.active & self.success[:, None]
        paid = np.minimum(depth, task.insertion_depth)
        terms = self._terms("depth", task.depth_scale * (paid - self._paid), self.success)
        self._paid = paid
        self._conclude(terms, self.success | (self.failure != ""))

    def columns(self) -> dict[str, Any]:
        return {**super().columns(), "hole": self.hole.copy()}

    def _near(self, rows: slice) -> Floats:
        return self._believed[rows]

    def observe(self, rows: slice) -> NDArray[np.float32]:
        return in_units(self._felt(rows))
