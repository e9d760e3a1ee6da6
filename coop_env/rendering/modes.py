"""Gymnasium's render modes for an environment that can say what there is to see."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import gymnasium as gym
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from coop_env.errors import ArgumentError
from coop_env.rendering.scene import Scene


class Rendered(gym.Env[Any, Any]):
    """An environment with the modes ``"rgb_array"``, ``"human"`` and ``"ansi"``."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human", "ansi"]}  # noqa: RUF012 - Gymnasium's own form
    render_kwargs: Mapping[str, Any] = MappingProxyType({})
    """``size``, ``camera``, ``panel``, ``samples`` of :func:`coop_env.rendering.render_frame` for
    the modes ``"rgb_array"`` and ``"human"``; set it on the instance, for a window before reset."""
    _trace: list[NDArray[Any]]
    _window: Any = None

    def _set_render_mode(self, mode: str | None) -> None:
        modes = self.metadata["render_modes"]
        if mode is not None and mode not in modes:
            raise ArgumentError(f"render_mode = {mode!r}: must be None or one of {modes}")
        self.render_mode = mode
        self._trace = []

    def scene(self) -> Scene:
        """Every body of the scene at this instant, world frame."""
        raise NotImplementedError

    def render(self) -> Any:
        """A frame (height, width, 3) of uint8, text, or None, as ``render_mode`` says.

        Raises:
            DependencyNotInstalled: what the mode needs is not installed.
        """
        if self.render_mode is None:
            gym.logger.warn("render() without a render_mode does nothing: give one to make()")
            return None
        if self.render_mode == "ansi":
            return self.scene().describe()
        if self.render_mode == "human":
            return self._show()
        return _rendering("render_frame")(self.scene(), **self.render_kwargs)

    def _follow(self, tip: NDArray[Any], first: bool = False) -> None:
        """Take note of where the tip is, after a reset or a step, and show it."""
        if first:
            self._trace = []
        self._trace.append(tip.copy())
        self._show()

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._window is None:
            fps = self.metadata["render_fps"]
            self._window = _rendering("open_window")(fps, **self.render_kwargs)
        self._window.show(self.scene())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled and copied: everything but the window, which opens anew."""
        return {**self.__dict__, "_window": None}


def _rendering(name: str) -> Any:
    """A function of :mod:`coop_env.rendering`, imported only when something is to be seen."""
    try:
        return getattr(importlib.import_module("coop_env.rendering"), name)
    except (ImportError, AttributeError) as error:
        raise DependencyNotInstalled(
            f"rendering needs pip install 'sb3-rainbow-coop[render]': {error}"
        ) from error
