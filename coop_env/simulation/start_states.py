"""Start states: random ones by rejection, and those that a caller's reset options name.

Both are built in a scratch row, so a start that fails leaves the environment as it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.errors import ArgumentError, ResetOptionError
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import dynamics, state
from coop_env.simulation.sim_to_real import SimToReal, draw_machine
from coop_env.simulation.state import STATE, VALID, Record
from coop_env.simulation.task import (
    DOME_RADIUS,
    N_AXES,
    N_HOLES,
    STAGE_HOLES,
    START_CLEARANCE,
    START_PLANAR,
    START_SIGMA,
    START_TILT,
    EnvParams,
)

OPTIONS: Final = ("configuration", "target", "filled")
_BLOCK: Final = 16
_MAX_BLOCKS: Final = 512
_MAX_MACHINES: Final = 100
_STATUS: Final = {
    state.INVALID: "outside a robot's workspace or joint limits",
    state.COLLISION: "a collision",
    state.SINGULAR: "singular (signed sigma_min below 0.05)",
}


@njit(cache=True)
def _draw_configuration(
    s: Record, draws: np.ndarray, active: np.ndarray, filled: np.ndarray, p: EnvParams
) -> bool:
    """Begin at the first acceptable row of ``draws (k, 6)``, uniform in [0, 1)."""
    low, high = START_CLEARANCE
    for i in range(draws.shape[0]):
        u = draws[i]
        roll, pitch = (2.0 * u[0] - 1.0) * START_TILT, (2.0 * u[1] - 1.0) * START_TILT
        heave = p.rrs.heave_min + u[2] * (p.rrs.heave_max - p.rrs.heave_min)
        x, y = (2.0 * u[3] - 1.0) * START_PLANAR, (2.0 * u[4] - 1.0) * START_PLANAR
        tip_z = heave + DOME_RADIUS + low + u[5] * (high - low)
        z = tip_z + p.delta.peg_length - p.delta.base_height
        if not rrs_kernels.is_valid(roll, pitch, heave, p.rrs):
            continue
        if not rrs_kernels.sigma_at(roll, pitch, heave, p.rrs) >= START_SIGMA:
            continue
        if dynamics.begin(s, (x, y, z, roll, pitch, heave), active, filled, p) != VALID:
            continue
        if s.inside.sum() == 0:
            return True
    return False


def check_stage(stage: object) -> int:
    """The curriculum's stage as an int.

    Raises:
        ArgumentError: it is not 0 or 1.
    """
    if isinstance(stage, bool) or not isinstance(stage, (int, np.integer)):
        raise ArgumentError(f"stage = {stage!r}: must be 0 (four peripheral holes) or 1 (all six)")
    if not 0 <= stage < len(STAGE_HOLES):
        raise ArgumentError(f"stage = {stage!r}: must be 0 (four peripheral holes) or 1 (all six)")
    return int(stage)


class StartOptions:
    """Reset options, checked before anything is drawn or written.

    Raises:
        ResetOptionError: an unknown key, a malformed value, a hole that is not active, a target
            that is filled, or a configuration that is invalid, in collision or singular.
    """

    def __init__(self, options: Mapping[str, Any] | None, stage: int, p: EnvParams) -> None:
        given = dict(options or {})
        unknown = sorted(str(k) for k in set(given) - set(OPTIONS))
        if unknown:
            raise ResetOptionError(f"reset options {unknown} are unknown; known: {list(OPTIONS)}")
        self.active = np.array(STAGE_HOLES[stage], np.uint8)
        self.filled = _filled(given.get("filled"), self.active)
        self.target = _target(given.get("target"), self.active, self.filled)
        self.configuration = _configuration(given.get("configuration"), p)


def draw_start(
    options: StartOptions, p: EnvParams, knobs: SimToReal, rng: np.random.Generator
) -> NDArray[np.void]:
    """A start state, as an array (1,) of :data:`coop_env.simulation.state.STATE`.

    Raises:
        ResetOptionError: no acceptable start was found: the geometry has hardly any workspace
            with sigma_min of at least 0.15, or no machine within the knobs can stand there.
    """
    scratch = np.zeros(1, STATE)
    for _ in range(_MAX_MACHINES):
        if options.configuration is not None:
            dynamics.begin(scratch[0], options.configuration, options.active, options.filled, p)
        else:
            _draw_until_accepted(scratch, options, p, rng)
        if not p.task.imperfect:
            break
        draw_machine(scratch[0]["machine"], knobs, p, rng)
        if dynamics.settle(scratch[0], p) == VALID:
            break
    else:
        raise ResetOptionError(
            f"none of {_MAX_MACHINES} machines within {knobs} can stand at a start state: "
            "turn the sim-to-real knobs down, or choose another configuration"
        )
    target = options.target
    if target is None:
        open_holes = np.flatnonzero((options.active == 1) & (options.filled == 0))
        target = int(open_holes[rng.integers(open_holes.size)])
    state.aim(scratch[0], target)
    return scratch


def _draw_until_accepted(
    scratch: NDArray[np.void], options: StartOptions, p: EnvParams, rng: np.random.Generator
) -> None:
    for _ in range(_MAX_BLOCKS):
        draws = rng.random((_BLOCK, N_AXES))
        if _draw_configuration(scratch[0], draws, options.active, options.filled, p):
            return
    raise ResetOptionError(
        f"no start state in {_BLOCK * _MAX_BLOCKS} draws: this geometry has too little workspace "
        f"with sigma_min >= {START_SIGMA} within +-{START_TILT} rad of tilt; choose another"
    )


def _hole_index(value: object, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise ResetOptionError(f"{what} = {value!r}: must be a hole, an integer 0 to {N_HOLES - 1}")
    if not 0 <= value < N_HOLES:
        raise ResetOptionError(f"{what} = {value!r}: must be a hole, an integer 0 to {N_HOLES - 1}")
    return int(value)


def _filled(value: Any, active: NDArray[np.uint8]) -> NDArray[np.uint8]:
    filled = np.zeros(N_HOLES, np.uint8)
    if value is None:
        return filled
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ResetOptionError(f"filled = {value!r}: must be a collection of hole indices")
    for item in value:
        filled[_hole_index(item, "an entry of filled")] = 1
    if not np.any((active == 1) & (filled == 0)):
        raise ResetOptionError(
            f"filled = {np.flatnonzero(filled).tolist()}: leaves no active hole to fill"
        )
    return filled


def _target(value: object, active: NDArray[np.uint8], filled: NDArray[np.uint8]) -> int | None:
    if value is None:
        return None
    target = _hole_index(value, "target")
    if not active[target]:
        raise ResetOptionError(
            f"target = {target}: not active at this stage, unlike {np.flatnonzero(active).tolist()}"
        )
    if filled[target]:
        raise ResetOptionError(f"target = {target}: is among the filled holes")
    return target


def as_configuration(value: object) -> state.Configuration:
    """Six floats (x, y, z, roll, pitch, heave).

    Raises:
        ResetOptionError: the value is not six numbers.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ResetOptionError(f"configuration = {value!r}: must be six numbers") from error
    if array.shape != (N_AXES,):
        raise ResetOptionError(
            f"configuration has shape {array.shape}: must be (6,), x, y, z, roll, pitch, heave"
        )
    x, y, z, roll, pitch, heave = array.tolist()
    return x, y, z, roll, pitch, heave


def _configuration(value: object, p: EnvParams) -> state.Configuration | None:
    if value is None:
        return None
    configuration = as_configuration(value)
    if not np.all(np.isfinite(configuration)):
        raise ResetOptionError(f"configuration = {configuration}: must be finite")
    status = state.configuration_status(configuration, p)
    if status != VALID:
        raise ResetOptionError(f"configuration = {configuration}: is {_STATUS[status]}")
    return configuration
