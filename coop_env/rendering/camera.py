"""Perspective cameras that look at the two robots, and their names."""

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """Where the picture is taken from; angles in degrees, lengths in m, world frame.

    ``distance`` holds at the vertical ``field_of_view``; a camera that ``follows`` aims at the
    dome's centre plus ``target`` instead of at the fixed point ``target``.
    """

    elevation: float
    azimuth: float
    distance: float = 2.65
    target: tuple[float, float, float] = (0.0, 0.0, 0.425)
    field_of_view: float = 23.0
    follows: bool = False


CAMERAS: Final = MappingProxyType(
    {
        "iso": Camera(20.0, -52.0),
        "front": Camera(6.0, -90.0),
        "side": Camera(6.0, 0.0),
        "top": Camera(62.0, -90.0, target=(0.0, 0.0, 0.40)),
        "close": Camera(30.0, -50.0, 1.25, (0.0, 0.0, 0.06), follows=True),
        "dome": Camera(30.0, -50.0, 0.70, (0.0, 0.0, 0.080), follows=True),
    }
)


def resolve(camera: str | Camera) -> Camera:
    """A camera by name, or as it is."""
    if isinstance(camera, Camera):
        return camera
    if not isinstance(camera, str) or camera not in CAMERAS:
        raise ValueError(f"unknown camera {camera!r}: one of {', '.join(CAMERAS)}, or a Camera")
    return CAMERAS[camera]


@dataclass(frozen=True, slots=True)
class View:
    """A camera set up for a picture: ``eye`` (3,), rows of ``axes`` = right, down, forward.

    A point p shows at column ``focal * a / c + centre[0]`` and row ``focal * b / c + centre[1]``
    where (a, b, c) = axes (p - eye); pixel (0, 0) covers columns and rows from 0 to 1.
    """

    eye: FloatArray
    axes: FloatArray
    focal: float
    centre: tuple[float, float]

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Columns and rows (..., 2) of world points (..., 3), in pixels."""
        seen = (np.asarray(points, dtype=np.float64) - self.eye) @ self.axes.T
        return self.focal * seen[..., :2] / seen[..., 2:] + np.asarray(self.centre)


def make_view(
    camera: Camera, size: tuple[int, int], focus: FloatArray, free: tuple[float, float]
) -> View:
    """Set a camera up for a picture of ``size`` (width, height).

    A following camera aims at ``focus``; the scene is centred between the columns ``free``.
    """
    e, a = math.radians(camera.elevation), math.radians(camera.azimuth)
    back = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    target = np.asarray(camera.target) + (focus if camera.follows else 0.0)
    axes = np.stack([right, np.cross(right, back), -back])
    width, height = free[1] - free[0], float(size[1])
    focal = 0.5 * min(height, 1.25 * width) / math.tan(math.radians(camera.field_of_view) / 2.0)
    centre = ((free[0] + free[1]) / 2.0, height / 2.0)
    return View(target + camera.distance * back, axes, focal, centre)
