"""Rotations as the two robots use them, batched; angles in rad, vectors in the base frame.

A tilting platform has two orientation freedoms. Here they are roll and pitch of its normal,
``n = Rx(roll) Ry(pitch) z``, or equally tilt and azimuth; what is left, torsion (a turn about the
normal against the least rotation that tilts), is zero in every 3-RRS.
"""

import numpy as np
from numpy.typing import ArrayLike

from coop_env.kinematics._batch import Floats, as_points
from coop_env.kinematics._batch import ShapeError as ShapeError


def normal(angles: ArrayLike) -> Floats:
    """Platform normal ``(..., 3)`` of (roll, pitch) ``(..., 2)``.

    >>> normal([0.0, np.pi / 2]).round(6).tolist()
    [1.0, -0.0, 0.0]
    """
    roll, pitch = np.moveaxis(as_points("angles", angles, "roll", "pitch"), -1, 0)
    return np.stack(
        [np.sin(pitch), -np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=-1
    )


def roll_pitch(n: ArrayLike) -> Floats:
    """(roll, pitch) ``(..., 2)`` of a normal ``(..., 3)``, which need not have unit length.

    >>> roll_pitch(normal([0.3, -0.2])).round(9).tolist()
    [0.3, -0.2]
    """
    x, y, z = np.moveaxis(as_points("n", n, "nx", "ny", "nz"), -1, 0)
    return np.stack([np.arctan2(-y, z), np.arctan2(x, np.hypot(y, z))], axis=-1)


def tilt_azimuth(angles: ArrayLike) -> Floats:
    """(tilt, azimuth) ``(..., 2)``: angle of the normal from z, and the direction it leans to.

    >>> np.degrees(tilt_azimuth(np.radians([30.0, 0.0]))).round(6).tolist()
    [30.0, -90.0]
    """
    x, y, z = np.moveaxis(normal(angles), -1, 0)
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=-1)


def tilt_matrix(n: ArrayLike) -> Floats:
    """Least rotation ``(..., 3, 3)`` that takes z to the unit normal n: tilt without torsion.

    >>> r = tilt_matrix(normal([0.3, -0.2]))
    >>> (r @ [0.0, 0.0, 1.0] - normal([0.3, -0.2])).round(12).tolist()
    [0.0, 0.0, 0.0]
    """
    x, y, z = np.moveaxis(as_points("n", n, "nx", "ny", "nz"), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        k = 1.0 / (1.0 + z)
        rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def roll_pitch_yaw_matrix(angles: ArrayLike) -> Floats:
    """``Rx(roll) Ry(pitch) Rz(yaw)`` ``(..., 3, 3)`` of (roll, pitch, yaw) ``(..., 3)``.

    >>> roll_pitch_yaw_matrix([0.0, 0.0, np.pi / 2]).round(6).tolist()[0]
    [0.0, -1.0, 0.0]
    """
    a, b, c = np.moveaxis(as_points("angles", angles, "roll", "pitch", "yaw"), -1, 0)
    (ca, sa), (cb, sb), (cc, sc) = ((np.cos(v), np.sin(v)) for v in (a, b, c))
    rows = [
        [cb * cc, -cb * sc, sb],
        [ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb],
        [sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angle_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Angle ``(...)`` between vectors ``(..., 3)``, exact also near 0 and pi.

    >>> bool(np.isclose(angle_between([1.0, 0.0, 0.0], [1.0, 1e-9, 0.0]), 1e-9))
    True
    """
    u, v = as_points("a", a, "x", "y", "z"), as_points("b", b, "x", "y", "z")
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1))
