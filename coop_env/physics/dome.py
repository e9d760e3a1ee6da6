"""The dome as convex solids: eight staves around each bore, triangular prisms everywhere else.

A physics engine takes a mesh for its convex hull, so a solid with holes has to be given in convex
parts. Staves surround the bore's octagon, the chamfer on them; prisms are the triangles between
spot faces (a Delaunay triangulation on the sphere), drawn inwards by the shell's thickness.
Neighbours share whole faces or overlap.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from coop_env.errors import ArgumentError
from coop_env.kinematics.rotations import angle_between, tilt_matrix
from coop_env.simulation.insertion_task import InsertionTask

Vertices = NDArray[np.float64]

STAVES: Final = 8
SPOT_WIDTH: Final = 0.005
"""Width of the flat spot face around a chamfer, m: a flat peg that misses slides on a plane."""
_FILL_POINTS: Final = 40  # on the hemisphere
_EQUATOR_POINTS: Final = 16


@dataclass(frozen=True, slots=True)
class Bore:
    """A hole's cross-section: an octagon with flats ``radius`` from its axis. Lengths in m."""

    radius: float
    chamfer: float  # width and depth of the lead-in at 45 degrees
    depth: float  # the thickness of the dome's shell

    @property
    def spot_radius(self) -> float:
        """Flats of the spot face from the hole's axis, m."""
        return self.radius + self.chamfer + SPOT_WIDTH


def staves(bore: Bore) -> list[Vertices]:
    """Eight convex solids (10, 3) around a bore, z along its axis, the mouth at z = 0; m."""
    tan = math.tan(math.pi / STAVES)
    mouth = bore.radius + bore.chamfer
    profile = [
        (bore.radius, -bore.depth),
        (bore.radius, -bore.chamfer),
        (mouth, 0.0),
        (bore.spot_radius, 0.0),
        (bore.spot_radius, -bore.depth),
    ]
    stave = np.array([(x, side * x * tan, z) for x, z in profile for side in (-1.0, 1.0)])
    angles = 2.0 * math.pi * np.arange(STAVES) / STAVES
    turns = [(math.cos(angle), math.sin(angle)) for angle in angles]
    return [stave @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) for c, s in turns]


def dome_solids(task: InsertionTask, bore: Bore) -> Iterator[tuple[str, Vertices]]:
    """Names and vertices (n, 3) of all convex solids, in the platform's frame, m.

    Raises:
        ArgumentError: the holes, their spot faces or the shell do not fit the dome.
    """
    radius, normals = task.dome_radius, np.array(task.hole_normals)
    if bore.depth >= radius:
        raise ArgumentError(f"hole depth {bore.depth:g} m: must be below dome_radius {radius:g} m")
    # The spot face's octagon, a little smaller than the staves, so that staves and prisms overlap.
    ring = 0.97 * bore.spot_radius / math.cos(math.pi / STAVES)
    if ring >= radius:
        raise ArgumentError(f"a spot face of {ring:.3g} m does not fit dome_radius {radius:g} m")
    half = math.asin(ring / radius)
    _check_holes(normals, bore, radius, half)
    turns = tilt_matrix(normals)
    for i, turn in enumerate(turns):
        for k, stave in enumerate(staves(bore)):
            yield f"hole{i}_stave{k}", stave @ turn.T + radius * normals[i]
    corner = 2.0 * math.pi * (np.arange(STAVES) + 0.5) / STAVES
    circle = np.column_stack([np.cos(corner), np.sin(corner)]) * math.sin(half)
    local = np.column_stack([circle, np.full(STAVES, math.cos(half))])
    rings = np.concatenate([local @ turn.T for turn in turns])
    fill = _fill_points(normals, 1.4 * half)
    for k, triangle in enumerate(_triangles(rings, fill)):
        yield f"dome{k}", np.concatenate([radius * triangle, (radius - bore.depth) * triangle])


def _check_holes(normals: NDArray[np.float64], bore: Bore, radius: float, half: float) -> None:
    """Check that spot faces, ``half`` rad in radius, and bores clear each other and the rim."""
    nearest = math.inf
    for i, a in enumerate(normals):
        if a[2] < math.sin(1.2 * half):
            raise ArgumentError(f"holes[{i}] is too near to the dome's rim for its spot face")
        for j in range(i):
            apart = float(angle_between(a, normals[j]))
            nearest = min(nearest, apart)
            if apart < 2.4 * half:
                raise ArgumentError(
                    f"holes[{j}] and holes[{i}] are too near to each other for their spot faces"
                )
    # towards the dome's centre bores come nearer to each other, and prisms to the bores
    ring, inner, flat = radius * math.sin(half), radius - bore.depth, math.cos(math.pi / STAVES)
    corner = bore.radius / flat
    clear = ring * flat * inner / radius >= corner
    least = math.asin(min(1.0, ring / inner)) + math.asin(min(1.0, corner / inner))
    if not clear or nearest < least:
        raise ArgumentError(
            f"hole depth {bore.depth:g} m: bores of {bore.radius:g} m do not stay clear of each "
            f"other's walls so far down in dome_radius {radius:g} m"
        )


def _fill_points(normals: NDArray[np.float64], clear: float) -> NDArray[np.float64]:
    """Unit vectors over the upper half sphere (Fibonacci's spiral), ``clear`` rad off all holes."""
    k = np.arange(_FILL_POINTS)
    z = 1.0 - (k + 0.5) / _FILL_POINTS
    azimuth = k * math.pi * (3.0 - math.sqrt(5.0))
    planar = np.sqrt(1.0 - z * z)
    points = np.column_stack([planar * np.cos(azimuth), planar * np.sin(azimuth), z])
    far = (angle_between(points[:, None], normals[None]) > clear).all(axis=1)
    around = 2.0 * math.pi * np.arange(_EQUATOR_POINTS) / _EQUATOR_POINTS
    equator = np.column_stack([np.cos(around), np.sin(around), np.zeros(_EQUATOR_POINTS)])
    return np.concatenate([points[far & (z > math.sin(0.5 * math.pi / _EQUATOR_POINTS))], equator])


def _triangles(rings: NDArray[np.float64], fill: NDArray[np.float64]) -> Iterator[Vertices]:
    """Triangles (3, 3) of unit vectors over the hemisphere, but for the octagons of the rings.

    The hull of points on a sphere is their Delaunay triangulation; the pole below closes it.
    """
    points = np.concatenate([rings, fill, [[0.0, 0.0, -1.0]]])
    hole = np.full(len(points), -1)
    hole[: len(rings)] = np.arange(len(rings)) // STAVES
    for corners in ConvexHull(points).simplices:
        a, b, c = hole[corners]
        if len(points) - 1 not in corners and not (a == b == c >= 0):
            yield points[corners]
