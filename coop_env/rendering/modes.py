"""Gymnasium's render modes for an environment with a ``scene()``."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Self

import gymnasium as gym
from numpy.typing import NDArray

from coop_env.errors import ArgumentError, imports
from coop_env.rendering.scene import Scene
from coop_env.simulation.insertion_task import PAPER_TASK


class Rendered(gym.Env[Any, Any], ABC):
    """An environment with the modes ``"rgb_array"`` and ``"ansi"``.

    ``gymnasium.make(..., render_mode="human")`` shows the former in a window (pygame).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own form
        "render_modes": ["rgb_array", "ansi"],
        "render_fps": round(1.0 / PAPER_TASK.dt),
    }
    render_kwargs: Mapping[str, Any] = MappingProxyType({})
    """``size``, ``camera``, ``panel``, ``samples`` of :func:`coop_env.rendering.render_frame`; set
    it on the instance, for a window before reset."""
    _trace: list[NDArray[Any]]

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # two environments cannot move in the same rows

    def _set_render_mode(self, mode: str | None, dt: float) -> None:
        """Check and keep the mode; a step takes ``dt``, s."""
        modes = self.metadata["render_modes"]
        if mode is not None and mode not in modes:
            raise ArgumentError(
                f"render_mode = {mode!r}: must be None or one of {modes}; for a window "
                "gymnasium.make(..., render_mode='human')"
            )
        self.render_mode = mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / dt))}
        self._trace = []

    @abstractmethod
    def scene(self) -> Scene:
        """Every body of the scene at this instant, world frame."""

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
        with imports("rendering needs", "render"):  # only when something is to be seen
            from coop_env.rendering import render_frame
        return render_frame(self.scene(), **self.render_kwargs)

    def _follow(self, tip: NDArray[Any], first: bool = False) -> None:
        """Record the tip's position after a reset or a step."""
        if first:
            self._trace = []
        self._trace.append(tip.copy())
