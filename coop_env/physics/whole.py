"""Episodes of the whole task: bring the peg from far away to one hole after another, and insert."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ResetOptionError, check_integer
from coop_env.physics import kernels
from coop_env.physics.batch import LIMIT, OBSERVED, Bools, PhysicsBatch
from coop_env.physics.joints import Floats
from coop_env.physics.task import OWN_OPTIONS, Options, askew, draw_error, split_options

MAX_STEPS: Final = 2400
"""120 s in control steps, twice the kinematic task's time, as contact takes some."""
_UNITS: Final = np.repeat([0.1, 1.0, 1.0, 10.0, 0.05, 0.1, 0.5, 0.1, 1.0], OBSERVED)
_ANGLE_SCALE: Final = 150.0


class WholeBatch(PhysicsBatch):
    """Episodes of the whole task, at a ``stage`` of the kinematic task's."""

    length_unit = 0.1

    def __init__(
        self, *arguments: Any, stage: int = 1, max_steps: int = MAX_STEPS, **more: Any
    ) -> None:
        limit = check_integer("max_steps", max_steps, 1)
        super().__init__(*arguments, max_steps=limit, **more)
        machine, task, n = self.machine, self.machine.task, self.n
        self._starts = CoopInsertionEnv(machine.rrs, delta=machine.delta, task=task, stage=stage)
        self._starts.more_options = OWN_OPTIONS
        self.increments = np.array(task.steps) * min(1.0, self.task.dt / task.dt)
        stiffness, damping = machine.servos.gains
        self._lag = damping / stiffness  # s
        self._first[:] = machine.home()
        self._first_joints[:] = self.twin.servo_targets(self._first)
        self._pivot = np.array([0.0, 0.0, machine.rrs.home_heave + task.dome_radius])
        self.n_observed = 30 + len(task.holes)
        self.given_up: list[list[int]] = [[] for _ in range(n)]
        self.inserted = np.full(n, -1)
        self.distance, self.aimed = np.zeros(n), np.zeros((n, 2))
        """Tip to target's mouth (n,), m; that and the angle, rad, at the last insertion (n, 2)."""

    def check_options(self, options: Any) -> tuple[Options, Options]:
        own, rest = split_options(options)
        self.require_free(self._starts.check_options(rest).configuration, own)
        return own, rest

    def require_free(self, configuration: Any, own: Options) -> None:
        """Refuse a given start in which bodies of the nominal machine overlap."""
        if configuration is None:
            return
        base = askew(own.get("error", np.zeros(4)), self._pivot)
        if bodies := self.twin.overlap(configuration, base):
            raise ResetOptionError(
                f"configuration = {[*configuration]}: {bodies[0]!r} and {bodies[1]!r} of the "
                "simulated machine overlap there: choose another"
            )

    def reset(self, row: int, options: Any, rng: np.random.Generator) -> None:
        own, rest = options
        self._starts.np_random = rng  # one stream: a seed's start is the kinematic one's
        self._starts.reset(options=rest)
        self.begin(row, self._starts.state, own, rng)

    def begin(self, row: int, state: np.void, own: Options, rng: np.random.Generator) -> None:
        """Set a machine down at a state of the kinematic task; ``rng`` draws what ``own`` lacks."""
        drawn = draw_error(self.task, rng), float(rng.uniform(*self.task.friction))
        start = np.array(state["configuration"])
        self.hole[row] = state["target"]
        self._place(row, start, self._pivot, own, drawn, rng)
        self.active[row] = self._wanted[row] = state["active"]
        self.filled[row] = state["filled"]
        self.given_up[row], self.inserted[row] = [], -1
        self.distance[row] = self._to_mouth()[row]

    def step(self, actions: Floats) -> None:
        self._action = np.array(actions, np.float64)
        aimed = self.hole.copy()
        before = self._left_to(aimed)
        self.advance(self.command + actions * self.increments)
        distance, angle = (before - self._left_to(aimed)).T
        gained = self.task.depth_scale * distance + _ANGLE_SCALE * angle
        terms = self._terms("progress", gained, self.inserted >= 0)
        self._conclude(terms, self.over)

    def advance(self, wanted: Floats) -> None:
        """One control step, in which joints are led evenly to configurations (n, 6).

        ``inserted`` becomes the hole that was filled, or -1; after a fill the target is the next.
        """
        self._advance(wanted)
        self.inserted[:] = -1
        deep = (self.failure == "") & (self.insertion[:, 0] >= self.task.insertion_depth)
        self.distance = self._to_mouth()
        for row in np.flatnonzero(deep).tolist():
            if not self.filled[row, self.hole[row]]:
                self.fill(row)

    def _lead(self, before: Floats) -> Floats:
        way, substeps = (self._targets - before)[:, None], self.task.substeps
        share = np.arange(1, substeps + 1)[:, None] / substeps
        # a servo damps all motion: led by velocity too, it does not fall behind
        led: Floats = before[:, None] + share * way + self._lag * way / self.task.dt
        return led

    @property
    def over(self) -> Bools:
        """Whether every active hole is filled, or the episode has failed."""
        return (self.failure != "") | ~np.any(self.active & ~self.filled, axis=1)

    def fill(self, row: int) -> None:
        """Count a machine's target as filled, and aim at the next."""
        self.inserted[row] = self.hole[row]
        self.aimed[row] = self.distance[row], self.insertion[row, 2]
        self.filled[row, self.hole[row]] = self.success[row] = True
        self._next(row)

    def give_up(self, row: int) -> None:
        """Leave the target for good, and aim at the next; without one the episode is over."""
        self.active[row, self.hole[row]] = False
        self.given_up[row].append(int(self.hole[row]))
        if self.over[row] and not self.success[row]:
            self.failure[row] = "not inserted"
        self._next(row)

    def _next(self, row: int) -> None:
        """Aim at the open hole that is nearest to the tip by the nominal model; else stay."""
        open_holes = np.flatnonzero(self.active[row] & ~self.filled[row])
        if len(open_holes) == 0:
            return
        joints = np.tile(self.twin.readings().joints[row], (len(open_holes), 1))
        command = np.tile(self.command[row], (len(open_holes), 1))
        views = kernels.perceive(joints, command, open_holes, self._packed)
        self.hole[row] = open_holes[np.argmin(np.linalg.norm(views[:, :3], axis=1))]

    def _to_mouth(self) -> Floats:
        """Distances (n,) of the tips from their targets' mouths, m."""
        result: Floats = np.hypot(self.insertion[:, 1], self.insertion[:, 3])
        return result

    def _left_to(self, holes: NDArray[np.int64]) -> Floats:
        """(n, 2): from the tip to the point where a hole counts as filled, m; misalignment, rad."""
        _, lateral, angle, depth = self._measure(self.twin.readings(), slice(None), holes).T
        return np.column_stack([np.hypot(lateral, self.task.insertion_depth - depth), angle])

    def observe(self, rows: slice) -> NDArray[np.float32]:
        gone = self.steps[rows, None] / self.max_steps
        fields = [self._felt(rows) / _UNITS, self.filled[rows], gone]
        return np.clip(np.concatenate(fields, axis=1), -LIMIT, LIMIT).astype(np.float32)

    def columns(self) -> dict[str, Any]:
        return {
            **super().columns(),
            "distance": self.distance.copy(),
            "n_filled": self.filled.sum(axis=1),
            "inserted": self.inserted >= 0,
            "inserted_hole": self.inserted.copy(),
            "target": self.hole.copy(),
        }
