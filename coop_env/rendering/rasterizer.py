"""A small software rasterizer: triangles to pixels with depth, smooth shading and one shadow.

No OpenGL is needed. Two passes of one triangle loop (from the light, from the eye) fill depth
buffers; a third pass shades each pixel and the floor with its grid. Colours are linear light until
the last step, which looks display values up in a table.
"""

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from coop_env.compilation import njit
from coop_env.kinematics.singularity import Matrix3, Row, dot
from coop_env.rendering.camera import View
from coop_env.rendering.shapes import FloatArray, IntArray

SHADOW_SIZE: Final = 640
SHADOW_REACH: Final = 0.66  # half the side of the square that the light covers, m
SHADOW_CENTRE: Final = (0.0, 0.0, 0.36)
SHADOW_BIAS: Final = 0.006
FLOOR_HEIGHT: Final = -0.024
GRID: Final = 0.10  # m between lines
FLOOR_FADE: Final = (0.40, 0.95)  # the floor runs out between these radii, m

# Linear light. The sky also lights what faces up, the ground what faces down.
SKY: Final = (0.92, 0.94, 0.97)
HORIZON: Final = (0.80, 0.84, 0.89)
FLOOR: Final = (0.78, 0.80, 0.83)
LINE: Final = (0.52, 0.56, 0.62)
KEY: Final = 0.58
FILL: Final = 0.16
AMBIENT_UP: Final = 0.46
AMBIENT_DOWN: Final = 0.22
SHADE: Final = 0.42  # of the floor's light that a shadow takes


class Triangles(NamedTuple):
    """What to draw: vertices, normals (n, 3); faces (m, 3); linear colours (m, 3); gloss (m,).

    A negative gloss marks a face that shines by itself: no shading, no shadow.
    """

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    colours: npt.NDArray[np.float32]
    gloss: npt.NDArray[np.float32]


class Light(NamedTuple):
    """The key light: its right, down and forward, and how near the surface is in each texel."""

    axes: Matrix3
    nearness: npt.NDArray[np.float32]  # minus the depth, m


def to_linear(srgb: npt.ArrayLike) -> FloatArray:
    """Linear light of display values in [0, 1] (IEC 61966-2-1)."""
    v = np.asarray(srgb, dtype=np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def _display_table(entries: int = 4096) -> npt.NDArray[np.uint8]:
    v = np.linspace(0.0, 1.0, entries)
    srgb = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * srgb).astype(np.uint8)


_DISPLAY: Final = _display_table()


class Shot(NamedTuple):
    """All that a pixel's colour depends on.

    ``model`` has its vertices on the screen; ``lens`` is (focal length, centre column, centre row),
    all in samples.
    """

    model: Triangles
    eye: Row
    axes: Matrix3
    lens: Row
    light: Light


@njit(cache=True)
def _mix(a: Row, b: Row, share: float) -> Row:
    """From colour ``a`` a share of the way to ``b``."""
    return (
        a[0] + share * (b[0] - a[0]),
        a[1] + share * (b[1] - a[1]),
        a[2] + share * (b[2] - a[2]),
    )


@njit(cache=True, inline="always")
def _lit(x: float, y: float, z: float, key: Light) -> float:
    """Share of the key light that reaches a point: 3 x 3 texels, blended."""
    scale = 0.5 * SHADOW_SIZE / SHADOW_REACH
    d = (x - SHADOW_CENTRE[0], y - SHADOW_CENTRE[1], z - SHADOW_CENTRE[2])
    u = dot(d, key.axes[0]) * scale + 0.5 * SHADOW_SIZE - 0.5
    v = dot(d, key.axes[1]) * scale + 0.5 * SHADOW_SIZE - 0.5
    near = -dot(d, key.axes[2]) + SHADOW_BIAS
    i, j = math.floor(u), math.floor(v)
    if i < 1 or j < 1 or i >= SHADOW_SIZE - 2 or j >= SHADOW_SIZE - 2:
        return 1.0
    fu, fv = u - i, v - j
    total = 0.0
    for dj in range(-1, 3):
        wv = 1.0 - fv if dj == -1 else (fv if dj == 2 else 1.0)
        for di in range(-1, 3):
            wu = 1.0 - fu if di == -1 else (fu if di == 2 else 1.0)
            if key.nearness[j + dj, i + di] <= near:
                total += wu * wv
    return total / 9.0


@njit(cache=True)
def _grid_line(position: float, blur: float) -> float:
    """How much of a grid line a pixel of half-width ``blur`` (m) sees at a coordinate."""
    offset, half = abs(position - GRID * math.floor(position / GRID + 0.5)), 0.0009
    covered = min(offset + blur, half) - max(offset - blur, -half)
    return max(covered, 0.0) / (2.0 * blur)


@njit(cache=True)
def _floor(ray: Row, pixel: float, shot: Shot) -> Row:
    """Colour where a ray meets no body: floor with grid and shadow, fading into the backdrop."""
    up = ray[2] / math.sqrt(dot(ray, ray))
    backdrop = _mix(HORIZON, SKY, min(max(0.5 + 1.3 * up, 0.0), 1.0))
    if ray[2] >= -1e-6:
        return backdrop
    s = (FLOOR_HEIGHT - shot.eye[2]) / ray[2]
    x, y = shot.eye[0] + s * ray[0], shot.eye[1] + s * ray[1]
    rho = math.sqrt(x * x + y * y)
    if rho >= FLOOR_FADE[1] or s < 0.0:
        return backdrop
    share = min((FLOOR_FADE[1] - rho) / (FLOOR_FADE[1] - FLOOR_FADE[0]), 1.0)
    share = share * share * (3.0 - 2.0 * share)
    blur = 0.5 * pixel * s
    line = max(_grid_line(x, blur), _grid_line(y, min(blur / abs(up), 0.5 * GRID)))
    dim = 1.0 - SHADE * (1.0 - _lit(x, y, FLOOR_HEIGHT, shot.light))
    r, g, b = _mix(FLOOR, LINE, line)
    return _mix(backdrop, (r * dim, g * dim, b * dim), share)


@njit(cache=True)
def _surface(
    normal: Row, ray: Row, colour: np.ndarray, gloss: float, lit: float, light: Matrix3
) -> Row:
    """Lambert's law under one shadowed key light, a fill light at the eye and a sky, with gloss."""
    length = math.sqrt(dot(ray, ray))
    eye = (-ray[0] / length, -ray[1] / length, -ray[2] / length)
    lamp = (-light[2][0], -light[2][1], -light[2][2])
    key = lit * max(dot(normal, lamp), 0.0)
    sky = AMBIENT_DOWN + (AMBIENT_UP - AMBIENT_DOWN) * 0.5 * (1.0 + normal[2])
    diffuse = KEY * key + sky + FILL * max(dot(normal, eye), 0.0)
    half = (lamp[0] + eye[0], lamp[1] + eye[1], lamp[2] + eye[2])
    shine = max(dot(normal, half) / math.sqrt(dot(half, half)), 0.0) ** 8
    shine = lit * gloss * shine * shine * shine * shine
    return colour[0] * diffuse + shine, colour[1] * diffuse + shine, colour[2] * diffuse + shine


@njit(cache=True, inline="always")
def _sample(i: float, j: float, f: int, near: float, shot: Shot) -> Row:
    """Colour seen at column ``i`` and row ``j``, where face ``f`` (floor if negative) is nearest.

    ``near`` is 1 / depth, or for the floor the width of a pixel at unit depth.
    """
    lens, axes, eye, model = shot.lens, shot.axes, shot.eye, shot.model
    u, v = (i - lens[1]) / lens[0], (j - lens[2]) / lens[0]
    ray = (
        u * axes[0][0] + v * axes[1][0] + axes[2][0],
        u * axes[0][1] + v * axes[1][1] + axes[2][1],
        u * axes[0][2] + v * axes[1][2] + axes[2][2],
    )
    if f < 0:
        return _floor(ray, near, shot)
    colour = model.colours[f]
    if model.gloss[f] < 0.0:
        return float(colour[0]), float(colour[1]), float(colour[2])
    n = _normal(i, j, model, f)
    s = 1.0 / near
    x = eye[0] + s * ray[0] + 0.003 * n[0]
    y = eye[1] + s * ray[1] + 0.003 * n[1]
    z = eye[2] + s * ray[2] + 0.003 * n[2]
    return _surface(n, ray, colour, model.gloss[f], _lit(x, y, z, shot.light), shot.light.axes)


@njit(cache=True)
def shade(
    shot: Shot, nearness: np.ndarray, ids: np.ndarray, samples: int, image: np.ndarray
) -> None:
    """Colour of each pixel of ``image`` (uint8), the mean of samples x samples rays.

    A pixel that one face (or the floor) fills takes one ray: only edges need more.
    """
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            j0, i0 = row * samples, column * samples
            uniform = True
            for j in range(j0, j0 + samples):
                for i in range(i0, i0 + samples):
                    uniform = uniform and ids[j, i] == ids[j0, i0]
            rays = 1 if uniform else samples
            half = 0.5 * (samples // rays)
            r, g, b = 0.0, 0.0, 0.0
            for j in range(j0, j0 + rays):
                for i in range(i0, i0 + rays):
                    f = ids[j, i]
                    near = samples / shot.lens[0] if f < 0 else float(nearness[j, i])
                    c = _sample(i + half, j + half, f, near, shot)
                    r += min(c[0], 1.0)
                    g += min(c[1], 1.0)
                    b += min(c[2], 1.0)
            share = (len(_DISPLAY) - 1) / (rays * rays)
            image[row, column, 0] = _DISPLAY[int(r * share)]
            image[row, column, 1] = _DISPLAY[int(g * share)]
            image[row, column, 2] = _DISPLAY[int(b * share)]


@njit(cache=True)
def _normal(x: float, y: float, model: Triangles, f: int) -> Row:
    """Unit normal at a screen point of a face, blended from its corners."""
    screen, normals = model.vertices, model.normals
    a, b, c = model.faces[f, 0], model.faces[f, 1], model.faces[f, 2]
    abx, aby = screen[b, 0] - screen[a, 0], screen[b, 1] - screen[a, 1]
    acx, acy = screen[c, 0] - screen[a, 0], screen[c, 1] - screen[a, 1]
    dx, dy = x - screen[a, 0], y - screen[a, 1]
    inverse = 1.0 / (abx * acy - aby * acx)
    wb, wc = (dx * acy - dy * acx) * inverse, (dy * abx - dx * aby) * inverse
    wa = 1.0 - wb - wc
    nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
    ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
    nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
    length = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
    return nx / length, ny / length, nz / length


@njit(cache=True)
def _fill_depth(
    screen: np.ndarray, faces: np.ndarray, skip: np.ndarray, nearness: np.ndarray, ids: np.ndarray
) -> None:
    """Draw triangles into a buffer of nearness (larger is closer) and of face numbers.

    ``screen`` (n, 3) holds column, row and nearness, which is linear over the screen: 1 / depth in
    perspective, -depth in parallel projection. Faces that look away are left out, as is ``skip``.
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


def cast_light(triangles: Triangles, azimuth: float) -> Light:
    """The key light, above and to the left of a camera at ``azimuth`` (degrees), and its shadow."""
    azimuth, elevation = math.radians(azimuth - 48.0), math.radians(56.0)
    c = math.cos(elevation)
    towards = np.array([c * math.cos(azimuth), c * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    axes = np.stack([right, np.cross(right, towards), -towards])
    seen = (triangles.vertices - SHADOW_CENTRE) @ axes.T
    scale = 0.5 * SHADOW_SIZE / SHADOW_REACH
    seen[:, :2] = seen[:, :2] * scale + 0.5 * SHADOW_SIZE
    seen[:, 2] *= -1.0
    nearness = np.full((SHADOW_SIZE, SHADOW_SIZE), -1e9, dtype=np.float32)
    ids = np.empty((SHADOW_SIZE, SHADOW_SIZE), dtype=np.int32)
    _fill_depth(seen, triangles.faces, triangles.gloss < 0.0, nearness, ids)
    return Light(_rows(axes), nearness)


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
    lens = (view.focal * samples, view.centre[0] * samples, view.centre[1] * samples)
    model = triangles._replace(vertices=screen)
    shade(Shot(model, _row(view.eye), _rows(view.axes), lens, light), nearness, ids, samples, image)
    return image
