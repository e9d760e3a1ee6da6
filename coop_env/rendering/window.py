"""A window on the screen for ``render_mode="human"`` (pygame; SDL's dummy driver will do)."""

from __future__ import annotations

from typing import Any

import pygame

from coop_env.rendering.camera import CAMERAS, CameraSpec, resolve
from coop_env.rendering.frame import render_frame
from coop_env.rendering.scene import Scene

_CAPTION = "Cooperative insertion: keys 1 to {} choose the camera"


# pygame has one display: all windows of a process are one on the screen, which the last one closes
_OPEN: list[Window] = []


class Window:
    """Shows scenes one after another, not faster than ``fps``.

    The keys 1, 2, ... choose the camera by its place in :data:`CAMERAS`. Once a person has closed
    the window it stays closed, and :meth:`show` does nothing.
    """

    def __init__(
        self,
        fps: float,
        *,
        size: tuple[int, int] = (960, 720),
        camera: CameraSpec = "iso",
        panel: bool = True,
        samples: int = 2,
    ) -> None:
        resolve(camera)
        if not fps > 0.0:
            raise ValueError(f"fps = {fps!r}: must be above zero")
        self._fps = fps
        self._size, self._panel, self._samples = size, panel, samples
        self._camera: CameraSpec = camera
        pygame.display.init()
        self._screen: pygame.Surface | None = pygame.display.set_mode(size)
        pygame.display.set_caption(_CAPTION.format(len(CAMERAS)))
        _OPEN.append(self)
        self._clock = pygame.time.Clock()

    @property
    def is_open(self) -> bool:
        """Whether there still is a window."""
        return self._screen is not None

    def show(self, scene: Scene) -> None:
        """Draw a scene, after the last one has been seen for 1 / fps."""
        self._answer_events()
        if self._screen is None:
            return
        frame = render_frame(
            scene,
            size=self._size,
            camera=self._camera,
            panel=self._panel,
            samples=self._samples,
        )
        self._screen.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def _answer_events(self) -> None:
        if self._screen is None:
            return
        names = list(CAMERAS)
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                for window in _OPEN.copy():
                    window.close()
                return
            if event.type == pygame.KEYDOWN and 0 <= event.key - pygame.K_1 < len(names):
                self._camera = names[event.key - pygame.K_1]

    def close(self) -> None:
        """Take the window away; harmless when there is none."""
        if self._screen is not None:
            self._screen = None
            _OPEN.remove(self)
            if not _OPEN:
                pygame.display.quit()


def open_window(fps: float, **options: Any) -> Window:
    """A window for scenes; ``options`` as for :func:`~coop_env.rendering.render_frame`.

    Raises:
        ValueError: unknown camera or an fps that is not above zero.
        pygame.error: there is no display (set SDL_VIDEODRIVER=dummy to do without).
    """
    return Window(fps, **options)
