"""One scene to one picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from coop_env.rendering import overlay
from coop_env.rendering.bodies import Body, bodies
from coop_env.rendering.camera import CAMERAS, CameraSpec, View, make_view, resolve
from coop_env.rendering.rasterizer import Triangles, cast_light, draw, to_linear
from coop_env.rendering.scene import Scene

Image8 = npt.NDArray[np.uint8]

_SIZE_LIMITS = (16, 8192)  # px


def triangles(parts: Sequence[Body]) -> Triangles:
    """All bodies in the world frame as one set of triangles."""
    starts = np.cumsum([0] + [len(part.mesh.vertices) for part in parts])
    counts = [len(part.mesh.faces) for part in parts]
    gloss = np.array([-1.0 if part.shines else part.gloss for part in parts], dtype=np.float32)
    colours = to_linear([part.colour for part in parts]).astype(np.float32)
    return Triangles(
        np.concatenate([p.mesh.vertices @ p.rotation.T + p.position for p in parts]),
        np.concatenate([p.mesh.normals @ p.rotation.T for p in parts]),
        np.concatenate([p.mesh.faces + n for p, n in zip(parts, starts, strict=False)]),
        np.repeat(colours, counts, axis=0),
        np.repeat(gloss, counts),
    )


def _check_size(size: tuple[int, int]) -> tuple[int, int]:
    low, high = _SIZE_LIMITS
    try:
        width, height = (int(n) for n in size)
    except (TypeError, ValueError):
        raise ValueError(f"size = {size!r}: must be (width, height) in pixels") from None
    if not (low <= width <= high and low <= height <= high):
        raise ValueError(f"size = {size!r}: width and height must be {low} to {high} pixels")
    return width, height


def frame_view(
    scene: Scene,
    *,
    size: tuple[int, int] = (640, 480),
    camera: CameraSpec = "iso",
    panel: bool = True,
) -> View:
    """The projection that :func:`render_frame` uses: where a world point lands in the picture."""
    card = overlay.card_box(size) if panel else None
    left = 0 if card is None else card[2]
    return make_view(resolve(camera), size, scene.platform_centre, (left, size[0]))


def render_frame(
    scene: Scene,
    *,
    size: tuple[int, int] = (640, 480),
    camera: CameraSpec = "iso",
    trace: npt.ArrayLike | None = None,
    panel: bool = True,
    samples: int = 2,
) -> Image8:
    """A picture of the scene, uint8 (height, width, 3); needs no display and no OpenGL.

    Args:
        scene: what to show, from ``env.unwrapped.scene()``.
        size: (width, height) in pixels.
        camera: a name of ``CAMERAS``, (elevation, azimuth) in degrees, or a ``Camera``.
        trace: points (n, 3) that the tip passed, m; None takes the scene's own.
        panel: draw the card with the numbers and the close view of the dome (pictures narrower
            than 400 or lower than 240 pixels have no room for it).
        samples: rays per pixel and axis at edges; 2 is smooth, 1 fast, 4 for print.

    Raises:
        ValueError: unknown camera, impossible size or samples, or a trace of another shape.
    """
    size = _check_size(size)
    if not 1 <= samples <= 8:
        raise ValueError(f"samples = {samples!r}: must be 1 to 8")
    path = np.asarray(scene.trace if trace is None else trace, dtype=np.float64)
    if path.size and (path.ndim != 2 or path.shape[1] != 3):
        raise ValueError(f"trace of shape {path.shape}: must be (n, 3), world points in m")
    seen_from = resolve(camera)
    model = triangles(bodies(scene, path))
    light = cast_light(model, seen_from.azimuth)
    view = frame_view(scene, size=size, camera=seen_from, panel=panel)
    image = draw(model, light, view, size, samples)
    card = overlay.card_box(size) if panel else None
    if card is None:
        return image

    def close_up(inset: tuple[int, int]) -> Image8:
        camera = replace(CAMERAS["dome"], azimuth=seen_from.azimuth)
        closer = make_view(camera, inset, scene.platform_centre, (0.0, float(inset[0])))
        return draw(model, light, closer, inset, samples)

    return overlay.draw_card(image, scene, card, close_up)
