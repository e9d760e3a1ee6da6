"""One row of state: its layout, how it follows from a configuration, and the action mask.

A configuration is its start plus an integer number of moves along each axis, so a move and its
reverse cancel exactly.
"""

import math
from functools import lru_cache
from typing import Any, Final

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.kinematics.rrs_kernels import Pose
from coop_env.kinematics.singularity import Row
from coop_env.simulation import rewards
from coop_env.simulation.collision import below_ceiling, collides, hole
from coop_env.simulation.machine import MACHINE
from coop_env.simulation.task import KEY_SPAN, N_ACTIONS, N_AXES, TRAIL, EnvParams, unpack

VALID: Final = 0
INVALID: Final = 1
COLLISION: Final = 2
SINGULAR: Final = 3

_ALL: Final = (1 << N_ACTIONS) - 1
HOLD: Final = -1  # in place of a robot's move: none

Configuration = tuple[float, float, float, float, float, float]
Record = Any  # a row of state or OUTCOME, whose fields numba reads as attributes


@lru_cache
def state_dtype(n_holes: int) -> np.dtype[np.void]:
    """The layout of a row of state, in SI units; everything that the next step depends on."""
    fields: list[Any] = [
        ("start", "f8", (N_AXES,)),
        ("offset", "i8", (N_AXES,)),  # moves from the start along each axis
        ("configuration", "f8", (N_AXES,)),
        ("theta", "f8", (3,)),  # Delta joint angles, rad
        ("q", "f8", (3,)),  # 3-RRS joint angles, rad
        ("sigma", "f8"),  # signed sigma_min
        ("tip", "f8", (3,)),  # world, m
        ("mouths", "f8", (n_holes, 3)),  # world, m
        ("normals", "f8", (n_holes, 3)),
        ("target", "i8"),
        ("distance", "f8"),  # tip to target mouth, m
        ("angle", "f8"),  # peg axis to target normal, rad
        ("moves", "i8"),
        ("insertions", "i8"),  # in this episode; `filled` may have held some from the start
        ("energy", "f8"),  # J
        ("trail", "i8", (TRAIL,)),  # keys of configurations left, a ring
        ("trailed", "i8"),  # number of them since the start or the last insertion
        ("machine", MACHINE),  # what sim-to-real knobs make of the nominal machine
        ("over", "u2"),  # before the odd bytes, so that it leaves no gap
        ("inside", "u1", (n_holes,)),  # tip meets the hole's insertion criterion
        ("active", "u1", (n_holes,)),
        ("filled", "u1", (n_holes,)),
        ("mask", "u1", (N_ACTIONS,)),
        ("refused", "u1", (N_ACTIONS,)),  # moves that were refused at this configuration
    ]
    # Named padding to the next eight bytes: hidden padding would make equal rows differ in bytes.
    unaligned = -(3 * n_holes + 2 * N_ACTIONS + 2) % 8
    padding = [("unused", "u1", (unaligned,))] if unaligned else []
    return np.dtype([*fields, *padding], align=True)


OUTCOME: Final = np.dtype(
    [
        ("success", "?"),
        ("n_filled", "i8"),
        ("all_filled", "?"),  # every active hole
        ("inserted", "?"),
        ("inserted_hole", "i8"),  # -1 for none
        ("collision", "?"),
        ("violation", "?"),
        ("duplicate", "?"),
        ("singular", "?"),
        ("sigma_min", "f8"),
        ("alignment_error", "f8"),
        ("distance", "f8"),
        ("target", "i8"),
        ("time", "f8"),
        ("energy", "f8"),
        ("terms", "f8", (len(rewards.TERMS),)),
        ("reward", "f8"),
        ("terminated", "?"),
        ("truncated", "?"),
    ],
    align=True,
)
"""The outcome of a move."""

INFO_FIELDS: Final = (OUTCOME.names or ())[:15]
"""Fields of an outcome that go into ``info``, beside the reward's terms."""


@njit(cache=True)
def bits(flags: np.ndarray) -> int:
    """Flags of 0 or 1 as the bits of a number; numba takes longer to compile ``flags.sum()``."""
    number = 0
    for i in range(len(flags)):
        number |= flags[i] << i
    return number


@njit(cache=True)
def lattice_configuration(start: np.ndarray, offset: np.ndarray, p: EnvParams) -> Configuration:
    """``start + offset * step``: the one place where a lattice point becomes numbers."""
    step = p.layout.step
    return (
        start[0] + offset[0] * step[0],
        start[1] + offset[1] * step[1],
        start[2] + offset[2] * step[2],
        start[3] + offset[3] * step[3],
        start[4] + offset[4] * step[4],
        start[5] + offset[5] * step[5],
    )


@njit(cache=True)
def delta_valid(c: Configuration, p: EnvParams) -> bool:
    """Whether the Delta's half of a configuration is within its workspace."""
    return delta_kernels.is_valid(c[0], c[1], c[2], p.delta)


@njit(cache=True)
def rrs_valid(c: Configuration, p: EnvParams) -> bool:
    """Whether the 3-RRS's half of a configuration is within its limits."""
    return rrs_kernels.is_valid(c[3], c[4], c[5], p.rrs)


@njit(cache=True)
def delta_angles(c: Configuration, p: EnvParams) -> tuple[bool, Row]:
    """Validity of the Delta's half of a configuration, and theta."""
    return delta_valid(c, p), delta_kernels.inverse(c[0], c[1], c[2], p.delta)[1]


@njit(cache=True)
def rrs_angles(c: Configuration, p: EnvParams) -> tuple[bool, Pose, Row]:
    """Validity of the 3-RRS's half of a configuration, the platform's pose, and q."""
    pose = rrs_kernels.platform_pose(c[3], c[4], c[5], p.rrs)
    real, q = rrs_kernels.inverse(pose, p.rrs)
    within = rrs_kernels.within_limits(c[3], c[4], c[5], p.rrs)
    return real and within and rrs_kernels.joints_within_limits(q, p.rrs), pose, q


@njit(cache=True)
def joint_angles(c: Configuration, p: EnvParams) -> tuple[bool, Row, Pose, Row]:
    """Validity of a configuration, theta, the platform's pose, and q."""
    ok_delta, theta = delta_angles(c, p)
    ok_rrs, pose, q = rrs_angles(c, p)
    return ok_delta and ok_rrs, theta, pose, q


@njit(cache=True)
def joints_of(configurations: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles (n, 6) of configurations (n, 6), rad, and which of them are valid (n,)."""
    p = unpack(packed)
    joints = np.empty_like(configurations)
    reached = np.zeros(len(configurations), np.bool_)
    for i in range(len(configurations)):
        c = configurations[i]
        reached[i], theta, _, q = joint_angles((c[0], c[1], c[2], c[3], c[4], c[5]), p)
        for k in range(3):
            joints[i, k], joints[i, 3 + k] = theta[k], q[k]
    return joints, reached


@njit(cache=True)
def is_singular(sigma: float, p: EnvParams) -> bool:
    """Whether signed sigma_min is under the margin or on the far side of det A = 0 (or NaN)."""
    return not sigma >= p.layout.singular_margin


@njit(cache=True)
def configuration_status(c: Configuration, p: EnvParams) -> int:
    """VALID, INVALID, COLLISION or SINGULAR, the first that applies in the order of a move."""
    valid, theta, pose, q = joint_angles(c, p)
    if not valid:
        return INVALID
    if collides(c[0], c[1], c[2], theta, pose, q, p):
        return COLLISION
    if is_singular(rrs_kernels.signed_sigma_min(pose, q, p.rrs), p):
        return SINGULAR
    return VALID


@njit(cache=True)
def alignment_angle(normal_x: float, normal_y: float, normal_z: float) -> float:
    """Angle between the peg's axis (vertical) and a hole's normal, rad."""
    return math.atan2(math.hypot(normal_x, normal_y), normal_z)


@njit(cache=True)
def hole_distance(s: Record, index: int) -> float:
    """Distance from the tip to a hole's mouth, m."""
    dx = s.mouths[index, 0] - s.tip[0]
    dy = s.mouths[index, 1] - s.tip[1]
    dz = s.mouths[index, 2] - s.tip[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True)
def hole_angle(s: Record, index: int) -> float:
    """Angle between the peg's axis and a hole's normal, rad."""
    return alignment_angle(s.normals[index, 0], s.normals[index, 1], s.normals[index, 2])


@njit(cache=True)
def place_delta(s: Record, c: Configuration, theta: Row, tip: Row) -> None:
    """Write the Delta's half of a configuration and what depends on it alone."""
    for k in range(3):
        s.configuration[k] = c[k]
        s.theta[k] = theta[k]
        s.tip[k] = tip[k]


@njit(cache=True)
def place_rrs(s: Record, c: Configuration, pose: Pose, q: Row, p: EnvParams) -> None:
    """Write the 3-RRS's half of a configuration and what depends on it alone, but sigma."""
    for k in range(3):
        s.configuration[3 + k] = c[3 + k]
        s.q[k] = q[k]
    for i in range(len(s.mouths)):
        mouth, normal = hole(pose, i, p)
        for k in range(3):
            s.mouths[i, k] = mouth[k]
            s.normals[i, k] = normal[k]


@njit(cache=True)
def update_inside(s: Record, tolerance: float, p: EnvParams) -> None:
    """Write which holes' insertion criterion the peg meets."""
    for i in range(len(s.inside)):
        s.inside[i] = hole_distance(s, i) < tolerance and hole_angle(s, i) < p.task.angle_tolerance


@njit(cache=True)
def aim(s: Record, target: int) -> None:
    """Make a hole the target."""
    s.target = target
    s.distance, s.angle = hole_distance(s, target), hole_angle(s, target)


@njit(cache=True)
def open_holes(s: Record) -> int:
    """Number of active holes that are not filled."""
    n = 0
    for i in range(len(s.filled)):
        n += s.active[i] == 1 and s.filled[i] == 0
    return n


@njit(cache=True)
def filled_holes(s: Record) -> int:
    """Number of filled holes."""
    n = 0
    for i in range(len(s.filled)):
        n += s.filled[i]
    return n


@njit(cache=True)
def nearest_open_hole(s: Record) -> int:
    """The unfilled active hole nearest to the tip, or -1."""
    best, least = -1, math.inf
    for i in range(len(s.filled)):
        if s.active[i] and not s.filled[i]:
            distance = hole_distance(s, i)
            if distance < least:
                best, least = i, distance
    return best


@njit(cache=True)
def neighbour(s: Record, action: int, p: EnvParams) -> Configuration:
    """The configuration that an action leads to, valid or not; HOLD leads to the present one."""
    axis, sign = max(action, 0) // 2, 0 if action == HOLD else 1 - 2 * (action % 2)
    s.offset[axis] += sign
    c = lattice_configuration(s.start, s.offset, p)
    s.offset[axis] -= sign
    return c


@njit(cache=True)
def is_safe(s: Record, action: int, p: EnvParams) -> bool:
    """Whether a move leads to a configuration of status VALID."""
    c = neighbour(s, action, p)
    # settles most without a test
    if action < 6 and not p.task.imperfect and not below_ceiling(c, p):
        return delta_valid(c, p) and not is_singular(s.sigma, p)
    return configuration_status(c, p) == VALID


@njit(cache=True)
def _key(s: Record, action: int) -> int:
    """A number of its own for the lattice point that an action leads to; for HOLD, the present one.

    Ten bits for each axis: no workspace is KEY_SPAN steps wide.
    """
    key = 0
    for k in range(N_AXES):
        offset = s.offset[k]
        if action // 2 == k:
            offset += 1 - 2 * (action % 2)
        key |= (offset & (KEY_SPAN - 1)) << (10 * k)
    return key


@njit(cache=True)
def leave(s: Record) -> None:
    """Remember the present configuration, which a move is about to leave."""
    s.trail[s.trailed % TRAIL] = _key(s, HOLD)
    s.trailed += 1


@njit(cache=True)
def _forbid_visited(s: Record, visited: int) -> None:
    """Remove from the mask moves back to the last ``visited`` configurations, unless all go back.

    A shortest path never returns, so none is lost.
    """
    back = 0  # the actions that lead back, as the bits of a number
    for action in range(N_ACTIONS):
        key = _key(s, action)
        for i in range(min(s.trailed, visited)):
            if s.trail[(s.trailed - 1 - i) % TRAIL] == key:
                back |= s.mask[action] << action
    if bits(s.mask) != back:
        for action in range(N_ACTIONS):
            s.mask[action] &= 1 - (back >> action & 1)


@njit(cache=True)
def _forbid_refused(s: Record) -> None:
    """Remove from the mask moves refused here; if none would be left, forget the refusals."""
    if bits(s.mask) == 0:
        s.mask[:] = 1
    if bits(s.mask) & ~bits(s.refused) == 0:
        s.refused[:] = 0
    for action in range(N_ACTIONS):
        s.mask[action] &= 1 - s.refused[action]


@njit(cache=True)
def update_mask(s: Record, delta: bool, rrs: bool, p: EnvParams) -> None:
    """Recompute the action mask of the robots that moved, and of both where they are coupled.

    If nothing is valid, everything is allowed. Refused moves are removed first, then moves back,
    unless no other move is left: a dead end is left the way it was entered.
    """
    couple = p.task.mask_singularities
    # a full mask may stand for "nothing valid"
    afresh = p.task.visited > 0 or p.task.refused or bits(s.mask) == _ALL
    for action in range(N_ACTIONS):
        if couple:
            s.mask[action] = is_safe(s, action, p)
        elif action < 6:
            if delta or afresh:
                s.mask[action] = delta_valid(neighbour(s, action, p), p)
        elif rrs or afresh:
            s.mask[action] = rrs_valid(neighbour(s, action, p), p)
    if p.task.refused:
        _forbid_refused(s)
    if p.task.visited > 0:
        _forbid_visited(s, p.task.visited)
    if bits(s.mask) == 0:
        s.mask[:] = 1
