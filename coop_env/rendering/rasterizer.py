"""A small software rasterizer: triangles to pixels with depth, smooth shading and one shadow.

No OpenGL is needed, and unlike a painter's algorithm a depth buffer shows links that pass behind
the dome correctly. Two passes of one triangle loop (from the light, from the eye) fill depth
buffers; a third pass shades each pixel and the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from coop_env.compilation import njit
from coop_env.kinematics.singularity import Matrix3, Row
from coop_env.rendering.camera import View
from coop_env.rendering.shading import SHADOW_CENTRE, SHADOW_REACH, SHADOW_SIZE, Shot, shade
from coop_env.rendering.shapes import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """What to draw: vertices, normals (n, 3); faces (m, 3); linear colours (m, 3); gloss (m,).

    A negative gloss marks a face that shines by itself: no shading, no shadow.
    """

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    colours: npt.NDArray[np.float32]
    gloss: npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Right, down and forward of the key light, and how near to it each texel's surface is."""

    axes: Matrix3
    nearness: npt.NDArray[np.float32]


def to_linear(srgb: npt.ArrayLike) -> FloatArray:
    """Linear light of display values in [0, 1] (IEC 61966-2-1)."""
    v = np.asarray(srgb, dtype=np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def _display_table(entries: int = 4096) -> npt.NDArray[np.uint8]:
    v = np.linspace(0.0, 1.0, entries)
    srgb = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * srgb).astype(np.uint8)


_DISPLAY: Final = _display_table()


@njit(cache=True)
def _fill_depth(
    screen: np.ndarray, faces: np.ndarray, skip: np.ndarray, nearness: np.ndarray, ids: np.ndarray
) -> None:
    """Draw triangles into a buffer of nearness (larger is closer) and of face numbers.

    ``screen`` (n, 3) holds column, row and nearness; nearness must be linear over the screen, as
    1 / depth is in perspective and -depth in parallel projection. Faces that look away are left
    out, as are those in ``skip``.
    """
    height, width = nearness.shape
    for f in range(faces.shape[0]):
        if skip[f]:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = screen[a, 0], screen[a, 1], screen[a, 2]
        bx, by, bz = screen[b, 0], screen[b, 1], screen[b, 2]
        cx, cy, cz = screen[c, 0], screen[c, 1], screen[c, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not area < 0.0:  # rows run downwards: what faces the eye winds clockwise
            continue
        x0 = max(math.ceil(min(ax, bx, cx) - 0.5), 0)
        x1 = min(math.floor(max(ax, bx, cx) - 0.5), width - 1)
        y0 = max(math.ceil(min(ay, by, cy) - 0.5), 0)
        y1 = min(math.floor(max(ay, by, cy) - 0.5), height - 1)
        inverse = 1.0 / area
        ub, uc = (cy - ay) * inverse, (by - ay) * inverse
        for row in range(y0, y1 + 1):
            dy = row + 0.5 - ay
            for column in range(x0, x1 + 1):
                dx = column + 0.5 - ax
                wb = dx * ub - dy * (cx - ax) * inverse
                wc = dy * (bx - ax) * inverse - dx * uc
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                near = wa * az + wb * bz + wc * cz
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    ids[row, column] = f


def _row(v: FloatArray) -> Row:
    return float(v[0]), float(v[1]), float(v[2])


def _rows(m: FloatArray) -> Matrix3:
    return _row(m[0]), _row(m[1]), _row(m[2])


def _shadow(triangles: Triangles, light: FloatArray) -> npt.NDArray[np.float32]:
    """Nearness to the light (-depth, m) of the first surface in each texel."""
    seen = (triangles.vertices - SHADOW_CENTRE) @ light.T
    scale = 0.5 * SHADOW_SIZE / SHADOW_REACH
    seen[:, :2] = seen[:, :2] * scale + 0.5 * SHADOW_SIZE
    seen[:, 2] *= -1.0
    nearness = np.full((SHADOW_SIZE, SHADOW_SIZE), -1e9, dtype=np.float32)
    ids = np.empty((SHADOW_SIZE, SHADOW_SIZE), dtype=np.int32)
    _fill_depth(seen, triangles.faces, triangles.gloss < 0.0, nearness, ids)
    return nearness


def cast_light(triangles: Triangles, azimuth: float) -> Light:
    """The key light: above and to the left of a camera at ``azimuth`` (degrees).

    Views from one azimuth share it, and so its shadow.
    """
    azimuth = math.radians(azimuth - 48.0)
    elevation = math.radians(56.0)
    c = math.cos(elevation)
    towards = np.array([c * math.cos(azimuth), c * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    axes = np.stack([right, np.cross(right, towards), -towards])
    return Light(_rows(axes), _shadow(triangles, axes))


def draw(
    triangles: Triangles, light: Light, view: View, size: tuple[int, int], samples: int = 2
) -> npt.NDArray[np.uint8]:
    """Picture (height, width, 3) of ``size`` (width, height), samples x samples rays at edges."""
    width, height = size
    seen = (triangles.vertices - view.eye) @ view.axes.T
    near = 1.0 / np.maximum(seen[:, 2], 1e-3)
    screen = np.empty_like(seen)
    screen[:, :2] = view.focal * samples * seen[:, :2] * near[:, None]
    screen[:, :2] += np.asarray(view.centre) * samples
    screen[:, 2] = near
    behind = seen[triangles.faces, 2].min(axis=1) < 0.05
    nearness = np.zeros((height * samples, width * samples), dtype=np.float32)
    ids = np.full(nearness.shape, -1, dtype=np.int32)
    _fill_depth(screen, triangles.faces, behind, nearness, ids)
    image = np.empty((height, width, 3), dtype=np.uint8)
    t, eye = triangles, _row(view.eye)
    lens = (view.focal * samples, view.centre[0] * samples, view.centre[1] * samples)
    model = (screen, t.normals, t.faces, t.colours, t.gloss)
    shot = Shot(*model, eye, _rows(view.axes), lens, light.axes, light.nearness)
    shade(shot, nearness, ids, samples, _DISPLAY, image)
    return image
