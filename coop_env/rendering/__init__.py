"""Pictures of the task: frames, and a view in the browser (extra ``render``).

:mod:`coop_env.rendering.viewer` is the browser view; it needs viser and is imported on its own.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from coop_env.rendering.camera import CAMERAS, Camera

if TYPE_CHECKING:
    from coop_env.rendering.frame import frame_view, render_frame

__all__ = ["CAMERAS", "Camera", "frame_view", "render_frame"]


def __getattr__(name: str) -> Any:
    """Load renderers at first use: the environment needs only the scene."""
    if name not in ("frame_view", "render_frame"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("coop_env.rendering.frame"), name)
