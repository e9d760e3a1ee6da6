"""Triangle meshes of the few solids that the two robots are made of.

A profile turned about the z axis, and a convex polygon extruded along it. Lengths in m; faces wind
counter-clockwise seen from outside. Meshes are cached.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
Profile = tuple[tuple[float, float], ...]

_CREASE = math.cos(math.radians(40.0))


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Vertices (n, 3) and unit vertex normals (n, 3), float64; faces (m, 3) as indices."""

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray


@lru_cache(maxsize=1024)
def revolve(profile: Profile, sides: int = 24) -> Mesh:
    """Surface of revolution about z of a profile of (radius, z) points, the outside to its right.

    Neighbouring segments that bend by less than 40 degrees are shaded as one smooth surface.
    """
    points = np.asarray(profile, dtype=np.float64)
    steps = np.diff(points, axis=0)
    outward = np.column_stack([steps[:, 1], -steps[:, 0]])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    before, after = outward.copy(), outward.copy()  # normals at each segment's two ends
    for k in np.flatnonzero(np.sum(outward[1:] * outward[:-1], axis=1) > _CREASE):
        mean = outward[k] + outward[k + 1]
        after[k] = before[k + 1] = mean / np.linalg.norm(mean)
    rings = np.stack([points[:-1], points[1:]], axis=1).reshape(-1, 2)
    ring_normals = np.stack([before, after], axis=1).reshape(-1, 2)
    turn = 2.0 * math.pi * np.arange(sides) / sides
    cos, sin = np.cos(turn), np.sin(turn)

    def spin(rz: FloatArray) -> FloatArray:
        height = np.repeat(rz[:, 1:], sides, axis=1)
        return np.stack([rz[:, :1] * cos, rz[:, :1] * sin, height], axis=-1).reshape(-1, 3)

    i, faces = np.arange(sides), []
    j = (i + 1) % sides
    for n in range(len(steps)):
        low, high = 2 * n * sides, (2 * n + 1) * sides
        if points[n, 0] > 0.0:
            faces.append(np.column_stack([low + i, low + j, high + j]))
        if points[n + 1, 0] > 0.0:
            faces.append(np.column_stack([low + i, high + j, high + i]))
    return Mesh(spin(rings), spin(ring_normals), np.concatenate(faces).astype(np.int32))


@lru_cache(maxsize=64)
def prism(outline: Profile, thickness: float) -> Mesh:
    """Convex outline in the xy plane (counter-clockwise), extruded by +- thickness / 2 along z."""
    points = np.asarray(outline, dtype=np.float64)
    n, half = len(points), thickness / 2.0
    ends = np.roll(points, -1, axis=0)
    side = np.column_stack([(ends - points)[:, 1], (points - ends)[:, 0], np.zeros(n)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], (n, 3))

    def at(xy: FloatArray, z: float) -> FloatArray:
        return np.column_stack([xy, np.full(n, z)])

    # six blocks of n vertices: top, bottom, and the four corners of each side face
    blocks = (at(points, half), at(points, -half), at(points, -half), at(ends, -half))
    fan, i = np.arange(1, n - 1), np.arange(n)
    faces = (
        np.column_stack([0 * fan, fan, fan + 1]),
        np.column_stack([0 * fan, fan + 1, fan]) + n,
        np.column_stack([2 * n + i, 3 * n + i, 4 * n + i]),
        np.column_stack([2 * n + i, 4 * n + i, 5 * n + i]),
    )
    return Mesh(
        np.concatenate([*blocks, at(ends, half), at(points, half)]),
        np.concatenate([up, -up, side, side, side, side]),
        np.concatenate(faces).astype(np.int32),
    )


def box(x: float, y: float, thickness: float) -> Mesh:
    """Box from -x to x and -y to y, +- thickness / 2 along z."""
    return prism(((-x, -y), (x, -y), (x, y), (-x, y)), thickness)


def cylinder(radius: float, low: float, high: float, sides: int = 24, chamfer: float = 0.0) -> Mesh:
    """Cylinder about z from ``low`` to ``high``, its two edges broken by ``chamfer``."""
    c = chamfer
    wall: Profile = ((radius, low + c), (radius, high - c))
    if c > 0.0:
        wall = ((radius - c, low), *wall, (radius - c, high))
    return revolve(((0.0, low), *wall, (0.0, high)), sides)


def rod(radius: float, length: float, sides: int = 14) -> Mesh:
    """Capsule about z whose axis runs from 0 to ``length``; the length is kept to 1e-7 m."""
    length = round(length, 7)  # links keep their length up to rounding: one mesh in the cache
    arc = [(radius * math.sin(a), -radius * math.cos(a)) for a in np.linspace(0.0, math.pi / 2, 5)]
    low = ((0.0, -radius), *arc[1:])
    high = tuple((r, length - z) for r, z in reversed(low))
    return revolve(low + high, sides)


def sphere(radius: float, sides: int = 16) -> Mesh:
    """Sphere about the origin."""
    angles = np.linspace(0.0, math.pi, sides // 2 + 1)[1:-1]
    arc = tuple((radius * math.sin(a), -radius * math.cos(a)) for a in angles)
    return revolve(((0.0, -radius), *arc, (0.0, radius)), sides)


def cap(radius: float, start: float, end: float, rings: int = 12, sides: int = 48) -> Mesh:
    """Part of a sphere about the origin between two polar angles (rad), seen from outside."""
    angles = np.linspace(end, start, rings + 1)
    profile = [(radius * math.sin(a), radius * math.cos(a)) for a in angles]
    if start == 0.0:
        profile[-1] = (0.0, radius)
    return revolve(tuple(profile), sides)


def arrow(length: float, radius: float) -> Mesh:
    """Arrow from the origin along z."""
    neck = length - 5.0 * radius
    profile = ((0.0, 0.0), (radius, 0.0), (radius, neck), (2.4 * radius, neck), (0.0, length))
    return revolve(profile, 16)


def bar(length: float, start: float, end: float, thickness: float) -> Mesh:
    """Flat tapered link along x with rounded ends of radii ``start`` and ``end``, thick along z."""
    length = round(length, 7)
    if abs(start - end) >= length:  # the wider end is all there is
        x, radius = max((0.0, start), (length, end), key=lambda each: each[1])
        turn = np.linspace(-math.pi, math.pi, 20, endpoint=False)
        rim = tuple((x + radius * math.cos(a), radius * math.sin(a)) for a in turn)
        return prism(rim, thickness)
    lean = math.asin((start - end) / length)
    tail = np.linspace(math.pi / 2 - lean, 3 * math.pi / 2 + lean, 10)
    head = np.linspace(-math.pi / 2 + lean, math.pi / 2 - lean, 10)
    outline = [(start * math.cos(a), start * math.sin(a)) for a in tail]
    outline += [(length + end * math.cos(a), end * math.sin(a)) for a in head]
    return prism(tuple(outline), thickness)


def plate(corner_distance: float, corner_radius: float, thickness: float) -> Mesh:
    """Triangular plate with rounded corners at azimuths 0, 120 and 240 degrees."""
    outline: list[tuple[float, float]] = []
    for limb in range(3):
        azimuth = limb * 2.0 * math.pi / 3.0
        x, y = corner_distance * math.cos(azimuth), corner_distance * math.sin(azimuth)
        outline += [
            (x + corner_radius * math.cos(a), y + corner_radius * math.sin(a))
            for a in np.linspace(azimuth - math.pi / 3, azimuth + math.pi / 3, 9)
        ]
    return prism(tuple(outline), thickness)
