"""The observation: its fields, fixed bounds, and the kernel that writes it."""

from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.errors import ArgumentError, check_flag
from coop_env.kinematics import rrs_kernels
from coop_env.simulation import machine
from coop_env.simulation.collision import hole, peg_tip
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import Record
from coop_env.simulation.task import EnvParams, axis_bounds, unpack

PAPER_FIELDS: Final = (
    "x", "y", "z", "roll", "pitch", "heave",
    "e_x", "e_y", "e_z", "n_x", "n_y", "n_z",
)  # fmt: skip


def markov_fields(n_holes: int) -> tuple[str, ...]:
    """Fields of the observation ``"markov"``."""
    return (*PAPER_FIELDS, *(f"filled_{i}" for i in range(n_holes)), "time")


Transform = NDArray[np.float64]
"""(5, size): offset, scale, least, largest and the range that noise is a fraction of; a field
becomes ``clip((v - offset) scale + noise)``."""


def make_observation(
    observation: str, normalize: bool, p: EnvParams, error_bound: float = PAPER_TASK.error_bound
) -> tuple[Transform, spaces.Box]:
    """The kernel's transform and the Gymnasium space of an observation.

    Args:
        observation: ``"paper"``, 12 fields, or ``"markov"``, which appends the filled holes and
            the time elapsed, both of which the reward depends on.
        normalize: fields scaled to [0, 1] and clipped, or plain SI units.
        p: the environment's parameters.
        error_bound: half-width of the normalized hole - tip, m.
    """
    if observation not in ("paper", "markov"):
        raise ArgumentError(f"observation = {observation!r}: must be 'paper' or 'markov'")
    check_flag("normalize", normalize)
    fields = len(PAPER_FIELDS) if observation == "paper" else None
    low, high = (bound[:fields] for bound in _bounds(p, error_bound))
    zeros, ones = np.zeros_like(low), np.ones_like(low)
    if normalize:
        transform = np.stack([low, 1.0 / (high - low), zeros, ones, ones])
        return transform, spaces.Box(0.0, 1.0, low.shape, np.float32)
    spans = high - low
    low, high = (bound[:fields] for bound in _bounds(p, _largest_error(p)))
    transform = np.stack([zeros, ones, low, high, spans])
    return transform, spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def _bounds(p: EnvParams, error: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    n_holes, time = int(p.layout["n_holes"]), p.task.max_moves * float(p.layout["dt"])
    low, high = axis_bounds(p)
    low = np.array([*low, *[-error] * 3, *[-1.0] * 3, *[0.0] * (n_holes + 1)])
    return low, np.array([*high, *[error] * 3, *[1.0] * (3 + n_holes), time])


def _largest_error(p: EnvParams) -> float:
    """A bound on every component of hole - tip, m, from the two workspaces."""
    d, r, dome = p.delta, p.rrs, float(p.layout["dome_radius"])
    planar = d.planar_limit + dome + r.platform_radius
    tip_low = d.base_height - d.peg_length - d.proximal_length - d.distal_length
    tip_high = d.base_height - d.peg_length - abs(d.proximal_length - d.distal_length)
    hole_low, hole_high = r.heave_min - dome, r.heave_max + dome
    return max(planar, hole_high - tip_low, tip_high - hole_low)


@njit(cache=True)
def observe(s: Record, p: EnvParams, o: np.ndarray, row: np.ndarray) -> None:
    """Write the observation of one row of state to ``row (size,)``, float32; o is a Transform."""
    c, target = s.configuration, s.target
    for k in range(6):
        row[k] = c[k]
    for k in range(3):
        row[6 + k] = s.mouths[target, k] - s.tip[k]
        row[9 + k] = s.normals[target, k]
    if p.task.imperfect:  # the controller sees what its model makes of the configuration
        tip = peg_tip(c[0], c[1], c[2], p.delta)
        mouth, normal = hole(rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs), target, p)
        for k in range(3):
            row[6 + k] = mouth[k] - tip[k]
            row[9 + k] = normal[k]
    if row.shape[0] > 12:
        n_holes = len(s.filled)
        for i in range(n_holes):
            row[12 + i] = s.filled[i]
        row[12 + n_holes] = s.moves * p.layout.dt
    noise = s.machine.noise if p.task.imperfect else 0.0
    for k in range(row.shape[0]):
        value = (row[k] - o[0, k]) * o[1, k]
        if noise > 0.0 and k < len(PAPER_FIELDS):
            value += noise * o[4, k] * machine.gaussian(s.machine)
        row[k] = min(max(value, o[2, k]), o[3, k])


@njit(cache=True)
def observe_batch(states: np.ndarray, packed: np.ndarray, o: np.ndarray, rows: np.ndarray) -> None:
    """Observations ``rows (n, size)`` of ``states (n,)``; the rest as for ``step_batch``."""
    p = unpack(packed)
    for i in range(states.shape[0]):
        observe(states[i], p, o, rows[i])
