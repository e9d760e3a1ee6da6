"""One scene as a picture, with a card of its numbers and a close view of the dome."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from coop_env.rendering.bodies import COLOURS, Body, bodies, hole_state, pixels
from coop_env.rendering.camera import CAMERAS, Camera, View, make_view, resolve
from coop_env.rendering.rasterizer import Triangles, cast_light, draw, to_linear
from coop_env.rendering.scene import Scene

Image8 = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]  # left, top, right, bottom in px
Ink = tuple[int, int, int]

INK: Final = (38, 45, 54)
MUTED: Final = (110, 120, 132)
CARD: Final = (252, 253, 254)
RIM: Final = (203, 210, 218)
TROUGH: Final = (226, 230, 235)
GOOD: Final = (42, 163, 90)
WARN: Final = (232, 150, 20)
BAD: Final = (200, 52, 44)

CARD_WIDTH: Final = (0.30, 0.40)  # at most so much of the picture's width, and of its height
MIN_WIDTH: Final = 400  # px; a smaller picture has no room to read a card
SIGMA_FULL: Final = 1.0  # signed sigma_min at which the bar is full
SIGMA_LOW: Final = 0.15  # the bar warns below the design's threshold (paper, A_w)
STATUS_COLOURS: Final = {"running": MUTED, "success": GOOD, "timeout": WARN, "time": WARN}
"""Colours by status; every other status is a failure."""

_SIZE_LIMITS = (16, 8192)  # px


@lru_cache(maxsize=16)
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def _card_box(size: tuple[int, int]) -> Box | None:
    """Where the card goes in a picture (width, height); None if that is too small for one."""
    width, height = size
    if width < MIN_WIDTH or height < 0.6 * MIN_WIDTH:
        return None
    margin = round(0.016 * width)
    across = round(min(CARD_WIDTH[0] * width, CARD_WIDTH[1] * height))
    return margin, margin, margin + across, height - margin


@lru_cache(maxsize=32)
def _disc(diameter: int, colour: Ink) -> Image.Image:
    """A disc on the card, drawn large and shrunk for a smooth edge."""
    over = 4 * diameter
    large = Image.new("RGB", (over, over), CARD)
    ImageDraw.Draw(large).ellipse((0, 0, over - 1, over - 1), colour)
    return large.resize((diameter, diameter), Image.Resampling.BOX)


class _Card:
    """Draws lines of text downwards within a box, all sizes in units of its width."""

    def __init__(self, picture: Image.Image, box: Box) -> None:
        self.picture = picture
        self.brush = ImageDraw.Draw(picture)
        self.brush.rounded_rectangle(box, round(0.04 * (box[2] - box[0])), CARD, RIM)
        self.unit = (box[2] - box[0]) / 100.0
        self.left = box[0] + self.px(6.5)
        self.right = box[2] - self.px(6.5)
        self.y = box[1] + self.px(5.0)

    def px(self, units: float) -> int:
        return max(round(units * self.unit), 1)

    def title(self, text: str, colour: Ink, note: str) -> None:
        self.brush.text((self.left, self.y), text, INK, _font(self.px(9.6), True))
        at, font = (self.right, self.y + self.px(2.2)), _font(self.px(7.0), True)
        self.brush.text(at, note, colour, font, "ra")
        self.y += self.px(16.0)

    def row(self, label: str, value: str, colour: Ink = INK, swatch: Ink | None = None) -> None:
        """Label to the left, after a disc of colour ``swatch`` if there is one; value right."""
        font, x = _font(self.px(7.0)), self.left
        if swatch is not None:
            disc = _disc(self.px(6.4), swatch)
            self.picture.paste(disc, (x, self.y + self.px(1.2)))
            x += disc.width + self.px(3.0)
        self.brush.text((x, self.y), label, MUTED, font)
        self.brush.text((self.right, self.y), value, colour, font, "ra")
        self.y += self.px(11.0)

    def dots(self, colours: list[Ink]) -> None:
        """The holes in their order, one disc each."""
        diameter, pitch = self.px(7.4), self.px(7.4) + self.px(3.2)
        if len(colours) > 6:  # smaller, as the label needs its room
            pitch = self.px(60.4) // len(colours)
            diameter = max(1, round(0.7 * pitch))
        self.brush.text((self.left, self.y), "holes", MUTED, _font(self.px(7.0)))
        x = self.right - pitch * len(colours) + (pitch - diameter)
        for k, colour in enumerate(colours):
            self.picture.paste(_disc(diameter, colour), (x + k * pitch, self.y + self.px(0.6)))
        self.y += self.px(11.8)

    def bar(self, value: float, full: float, limit: float, colour: Ink) -> None:
        """A trough filled up to ``value`` of ``full``, with a mark at ``limit``."""
        self.y += self.px(0.8)
        height, span = self.px(4.6), self.right - self.left
        bottom = self.y + height
        self.brush.rounded_rectangle((self.left, self.y, self.right, bottom), height // 2, TROUGH)
        share = min(max(value / full, 0.0), 1.0)
        if share > 0.0:
            end = max(self.left + round(share * span), self.left + height)
            self.brush.rounded_rectangle((self.left, self.y, end, bottom), height // 2, colour)
        mark = self.left + round(limit / full * span)
        overhang = self.px(1.4)
        self.brush.line((mark, self.y - overhang, mark, bottom + overhang), BAD, self.px(0.9))
        self.y += self.px(10.0)


def _write(card: _Card, scene: Scene) -> None:
    states = [hole_state(scene, i) for i in range(len(scene.filled))]
    ink = {state: pixels(COLOURS[state]) for state in ("filled", "target", "open", "inactive")}
    card.title(f"{scene.time:.1f} s", STATUS_COLOURS.get(scene.status, BAD), scene.status)
    card.dots([ink[state] for state in states])
    total = int(scene.active.sum())
    card.row("filled", f"{states.count('filled')} of {total}", swatch=ink["filled"])
    card.row("open", f"{states.count('open')}", swatch=ink["open"])
    target = f"hole {scene.target}" if "target" in states else "none"
    card.row("target", target, swatch=ink["target"])
    card.row("distance", f"{1e3 * scene.distance:.0f} mm")
    card.row("misaligned", f"{math.degrees(scene.alignment_error):.1f}°")
    roll, pitch = np.degrees(scene.configuration[3:5])
    card.row("tilt", f"{roll:+.0f}°, {pitch:+.0f}°")
    colour = WARN if scene.sigma_min < SIGMA_LOW else GOOD
    colour = BAD if scene.sigma_min < scene.singular_margin else colour
    card.row("\u03c3 min", f"{scene.sigma_min:+.3f}", colour)
    card.bar(scene.sigma_min, SIGMA_FULL, scene.singular_margin, colour)


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
    scene: Scene, *, size: tuple[int, int] = (640, 480), camera: str | Camera = "iso",
    panel: bool = True,
) -> View:  # fmt: skip
    """The projection that :func:`render_frame` uses: where a world point lands in the picture."""
    card = _card_box(size) if panel else None
    left = 0 if card is None else card[2]
    return make_view(resolve(camera), size, scene.platform_centre, (left, size[0]))


def render_frame(
    scene: Scene, *, size: tuple[int, int] = (640, 480), camera: str | Camera = "iso",
    panel: bool = True, samples: int = 2,
) -> Image8:  # fmt: skip
    """A picture of the scene, uint8 (height, width, 3); needs no display and no OpenGL.

    Args:
        scene: what to show, from ``env.unwrapped.scene()``.
        size: (width, height) in pixels.
        camera: a name of ``CAMERAS`` or a ``Camera``.
        panel: draw the card, unless the picture is narrower than 400 or lower than 240 pixels.
        samples: rays per pixel and axis at edges; 2 is smooth, 1 fast, 4 for print.

    Raises:
        ValueError: unknown camera, impossible size or samples.
    """
    size = _check_size(size)
    if not 1 <= samples <= 8:
        raise ValueError(f"samples = {samples!r}: must be 1 to 8")
    seen_from = resolve(camera)
    model = triangles(bodies(scene))
    light = cast_light(model, seen_from.azimuth)
    view = frame_view(scene, size=size, camera=seen_from, panel=panel)
    image = draw(model, light, view, size, samples)
    box = _card_box(size) if panel else None
    if box is None:
        return image
    picture = Image.fromarray(image)
    card = _Card(picture, box)
    _write(card, scene)
    left, top, right, bottom = box
    pad = round(0.05 * (right - left))
    side = min(right - left - 2 * pad, round(0.42 * (bottom - top)))
    x, y = (left + right) // 2 - side // 2, bottom - pad - side
    if side >= 80 and y >= card.y:  # a close view at the card's foot, if there is room
        close = replace(CAMERAS["dome"], azimuth=seen_from.azimuth)
        closer = make_view(close, (side, side), scene.platform_centre, (0.0, float(side)))
        picture.paste(Image.fromarray(draw(model, light, closer, (side, side), samples)), (x, y))
        card.brush.rectangle((x, y, x + side - 1, y + side - 1), outline=RIM)
    return np.asarray(picture)
