"""Start states: random ones by rejection, and those named by reset options.

Both are built in a scratch row, so a start that fails leaves the environment as it was.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.errors import ResetOptionError, check_integer, check_list
from coop_env.simulation import dynamics, state
from coop_env.simulation.sim_to_real import SimToReal, draw_machine
from coop_env.simulation.state import VALID, Record, state_dtype
from coop_env.simulation.task import N_AXES, EnvParams

OPTIONS: Final = ("configuration", "target", "filled")
_BLOCK: Final = 16
_MAX_BLOCKS: Final = 512
_MAX_MACHINES: Final = 100
_STATUS: Final = {
    state.INVALID: "outside a robot's workspace or joint limits",
    state.COLLISION: "a collision",
    state.SINGULAR: "singular (signed sigma_min below {margin:g})",
}


@njit(cache=True)
def _draw_configuration(
    s: Record, draws: np.ndarray, active: np.ndarray, filled: np.ndarray, p: EnvParams
) -> bool:
    """Begin at the first acceptable row of ``draws (k, 6)``, uniform in [0, 1)."""
    lay = p.layout
    low, high = lay.clearance_min, lay.clearance_max
    tilt, planar = lay.start_tilt, lay.start_planar
    for i in range(draws.shape[0]):
        u = draws[i]
        roll, pitch = (2.0 * u[0] - 1.0) * tilt, (2.0 * u[1] - 1.0) * tilt
        heave = p.rrs.heave_min + u[2] * (p.rrs.heave_max - p.rrs.heave_min)
        x, y = (2.0 * u[3] - 1.0) * planar, (2.0 * u[4] - 1.0) * planar
        tip_z = heave + lay.dome_radius + low + u[5] * (high - low)
        z = tip_z + p.delta.peg_length - p.delta.base_height
        if dynamics.begin(s, (x, y, z, roll, pitch, heave), active, filled, p) != VALID:
            continue
        if s.sigma >= lay.start_sigma and state.bits(s.inside) == 0:
            return True
    return False


class StartOptions:
    """Reset options, checked before anything is drawn or written.

    Args:
        options: of ``OPTIONS``, or None.
        active: 1 for each hole that is active, 0 for the others.
        p: the environment's parameters.
        more: names of options that the environment has taken out before.

    Raises:
        ResetOptionError: an unknown key, a malformed value, a hole that is not active, a target
            that is filled, or a configuration that is invalid, in collision or singular.
    """

    def __init__(
        self, options: Mapping[str, Any] | None, active: tuple[int, ...], p: EnvParams,
        more: Sequence[str] = (),
    ) -> None:  # fmt: skip
        if options is not None and not isinstance(options, Mapping):
            raise ResetOptionError(f"reset options = {options!r}: must be a mapping or None")
        given = dict(options or {})
        if unknown := sorted(str(key) for key in given if key not in OPTIONS):
            known = [*OPTIONS, *more]
            raise ResetOptionError(f"reset options {unknown} are unknown; known: {known}")
        self.active = np.array(active, np.uint8)
        self.filled = _filled(given.get("filled"), self.active)
        self.target = _target(given.get("target"), self.active, self.filled)
        self.configuration = _configuration(given.get("configuration"), p)


def draw_start(
    options: StartOptions, p: EnvParams, knobs: SimToReal, rng: np.random.Generator
) -> NDArray[np.void]:
    """A start state, as an array (1,) of :func:`coop_env.simulation.state.state_dtype`.

    Raises:
        ResetOptionError: no acceptable start was found: the geometry has hardly any workspace
            with sigma_min of at least ``start_sigma``, or no machine within the knobs can stand.
    """
    scratch = np.zeros(1, state_dtype(len(options.active)))
    for _ in range(_MAX_MACHINES):
        if options.configuration is not None:
            dynamics.begin(scratch[0], options.configuration, options.active, options.filled, p)
        else:
            _draw_until_accepted(scratch, options, p, rng)
        if not p.task.imperfect:
            break
        draw_machine(scratch[0]["machine"], knobs, p, rng)
        drawn = options.configuration is None
        # a given configuration may be in a hole, as on the nominal machine
        if dynamics.settle(scratch[0], p) == VALID and not (drawn and scratch[0]["inside"].any()):
            break
    else:
        raise ResetOptionError(
            f"none of {_MAX_MACHINES} machines within {knobs} can stand at a start state: "
            "turn the sim-to-real knobs down, or choose another configuration"
        )
    target = options.target
    if target is None:
        open_holes = np.flatnonzero(options.active > options.filled)
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
        f"no start state in {_BLOCK * _MAX_BLOCKS} draws: these robots have too little workspace "
        f"with sigma_min >= {p.layout['start_sigma']:g} within +-{p.layout['start_tilt']:g} rad of "
        "tilt; choose another geometry or other start ranges of the task"
    )


def _hole_index(value: object, name: str, n_holes: int) -> int:
    return check_integer(name, value, 0, n_holes - 1, hint=": a hole", error=ResetOptionError)


def _filled(value: Any, active: NDArray[np.uint8]) -> NDArray[np.uint8]:
    filled = np.zeros(active.size, np.uint8)
    if value is None:
        return filled
    of = "a collection of hole indices"
    for item in check_list("filled", value, of, error=ResetOptionError):
        filled[_hole_index(item, "an entry of filled", active.size)] = 1
    if not (active > filled).any():
        raise ResetOptionError(
            f"filled = {np.flatnonzero(filled).tolist()}: leaves no active hole to fill"
        )
    return filled


def _target(value: object, active: NDArray[np.uint8], filled: NDArray[np.uint8]) -> int | None:
    if value is None:
        return None
    target = _hole_index(value, "target", active.size)
    if not active[target]:
        raise ResetOptionError(
            f"target = {target}: not active at this stage, unlike {np.flatnonzero(active).tolist()}"
        )
    if filled[target]:
        raise ResetOptionError(f"target = {target}: is among the filled holes")
    return target


def as_configuration(value: object) -> state.Configuration:
    """The value as six floats (x, y, z, roll, pitch, heave); ResetOptionError."""
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
        reason = _STATUS[status].format(margin=p.layout["singular_margin"])
        raise ResetOptionError(f"configuration = {configuration}: is {reason}")
    return configuration
