"""Proof by enumeration: from no lattice point does a shielded move lead to harm, on the way too."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.errors import ArgumentError
from coop_env.shield.kernels import free_share, is_certified, way_point
from coop_env.shield.shield import Floats, KinematicShield
from coop_env.simulation.collision import ceiling, lowest
from coop_env.simulation.state import VALID, configuration_status
from coop_env.simulation.task import N_AXES, EnvParams, axis_bounds, pack, unpack

CHUNK = 64  # 3-RRS points between two reports of progress


class Certificate(NamedTuple):
    """Certified configurations, certified moves there and back, harmful moves, dead ends.

    On the way or at the end of a harmful move the nominal machine collides, is singular, or leaves
    its limits. A dead end is a certified configuration without a certified move.
    """

    points: int
    moves: int
    harmful: int
    dead_ends: int

    def __add__(self, other: object) -> Certificate:
        if not isinstance(other, Certificate):
            return NotImplemented
        return Certificate(*(a + b for a, b in zip(self, other, strict=True)))


NOTHING = Certificate(0, 0, 0, 0)


@njit(cache=True)
def _harms(c: np.ndarray, a: np.ndarray, looks: int, p: EnvParams) -> bool:
    for i in range(looks + 1):
        if configuration_status(way_point(c, a, i / looks), p) != VALID:
            return True
    return False


@njit(cache=True)
def _check(
    delta: np.ndarray, rrs: np.ndarray, steps: np.ndarray, looks: int, tight: np.ndarray,
    nominal: np.ndarray, reach: float, clearance: float, result: np.ndarray,
) -> None:  # fmt: skip
    p, q = unpack(tight), unpack(nominal)
    c, a = np.empty(N_AXES), np.zeros(N_AXES)
    for r in range(rrs.shape[0]):
        c[3:] = rrs[r]
        for d in range(delta.shape[0]):
            c[:3] = delta[d]
            if not is_certified(way_point(c, a, 0.0), p, reach, clearance):
                continue
            result[0] += 1
            degree = 0
            for move in range(2 * N_AXES):
                k = move // 2
                # ways back are counted with the ways there: look at one only to rule out a dead end
                if move % 2 == 1 and degree > 0:
                    continue
                a[k] = steps[k] * (1 - 2 * (move % 2))
                if free_share(c, a, p, reach, clearance) == 1.0:
                    degree += 1
                    if move % 2 == 0:
                        result[1] += 2
                        result[2] += _harms(c, a, looks, q)
                a[k] = 0.0
            result[3] += degree == 0


def check_product(
    shield: KinematicShield, params: EnvParams, delta: Floats, rrs: Floats, looks: int = 7
) -> Certificate:
    """Look at all moves from each pair of a Delta's point (n, 3) and a 3-RRS's (m, 3).

    ``params`` is the nominal task, which decides what is harmful. Each way is looked at in
    ``looks`` pieces, best no divisor of the shield's own number.
    """
    result = np.zeros(4, np.int64)
    keeps = (*shield.keeps, result)
    _check(delta, rrs, shield.steps, looks, shield.packed, pack(params), *keeps)
    return Certificate(*result.tolist())


def lattice(params: EnvParams, origin: Floats) -> tuple[Floats, Floats]:
    """The Delta's points (n, 3) and the 3-RRS's (m, 3) of the lattice through a configuration."""
    low, high = axis_bounds(params)
    steps = params.layout["step"]
    first = np.ceil((low - origin) / steps - 1e-9)
    last = np.floor((high - origin) / steps + 1e-9)
    axes = [origin[k] + steps[k] * np.arange(first[k], last[k] + 1) for k in range(N_AXES)]
    delta, rrs = (np.meshgrid(*part, indexing="ij") for part in (axes[:3], axes[3:]))
    return np.stack(delta, -1).reshape(-1, 3), np.stack(rrs, -1).reshape(-1, 3)


def near_points(shield: KinematicShield, params: EnvParams, delta: Floats) -> NDArray[np.bool_]:
    """Which of the Delta's points (n, 3) are within a move of where it may meet the 3-RRS."""
    tight = shield.margin.tighten(params)
    top = ceiling(params.rrs.heave_max, params) + params.layout["step"][2]
    return np.array([lowest(z, tight) < top for z in delta[:, 2].tolist()], bool)


def certify_lattice(
    shield: KinematicShield,
    params: EnvParams,
    origin: Floats,
    progress: Callable[[float], None] = lambda share: None,
) -> Certificate:
    """All moves of the lattice through a configuration: a superset of what can be reached.

    Where all of the Delta hangs above all of the 3-RRS the robots do not concern each other, and
    each robot's points are looked at beside one of the other's.

    Raises:
        ArgumentError: of the Delta's high points none is certified beside the flat platform.
    """
    delta, rrs = lattice(params, origin)
    near = near_points(shield, params, delta)
    low, high = delta[near], delta[~near]
    home = np.array([[0.0, 0.0, origin[5]]])
    alone = high[[shield.is_certified([*p, *home[0]]) for p in high]][:1]
    if len(high) > len(alone) == 0:
        raise ArgumentError(
            f"origin: with the platform flat at its heave, {origin[5]:g} m, no point is certified, "
            "so that moves high above it cannot be looked at: choose another origin"
        )
    total = check_product(shield, params, high, home)
    for i in range(0, len(rrs), CHUNK):
        some = rrs[i : i + CHUNK]
        total += check_product(shield, params, low, some)
        total += check_product(shield, params, alone, some)
        progress(min(1.0, (i + CHUNK) / len(rrs)))
    return total
