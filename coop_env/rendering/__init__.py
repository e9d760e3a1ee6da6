"""Pictures of the task: frames, a window, and a view in the browser (extra ``render``).

:mod:`coop_env.rendering.viewer` is the browser view; it needs viser and is imported on its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coop_env.rendering.camera import CAMERAS, Camera, CameraSpec
from coop_env.rendering.frame import frame_view, render_frame

if TYPE_CHECKING:
    from coop_env.rendering.window import Window

__all__ = ["CAMERAS", "Camera", "CameraSpec", "frame_view", "open_window", "render_frame"]


def open_window(fps: float, **options: Any) -> Window:
    """A window for scenes; see :func:`coop_env.rendering.window.open_window` (needs pygame)."""
    from coop_env.rendering import window

    return window.open_window(fps, **options)
