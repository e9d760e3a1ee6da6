"""One insertion in contact as a film: the twin above, the force on the peg below."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from benchmarks.methods.contact_scripts import Gains, MomentSearch
from benchmarks.reporting.figures.style import canvas, finish, style
from benchmarks.studies.base import episode
from benchmarks.studies.media import write_animation
from benchmarks.studies.robots.trials import LEVEL, TRAINED, options
from coop_env.physics.env import CoopInsertionContactEnv
from coop_env.rendering import CAMERAS, render_frame

CAMERA: Final = replace(CAMERAS["dome"], distance=0.42)
SCENE: Final = (480, 368)  # px
CHART: Final = (4.8, 1.76)  # inches of 100 px


def _chart(forces: NDArray[np.float64], now: int, fps: int) -> NDArray[np.uint8]:
    """The force along the hole and across it, up to a moment."""
    figure, (axes,) = canvas(size=CHART)
    figure.set_dpi(100)
    time, across = np.arange(len(forces)) / fps, np.hypot(forces[:, 0], forces[:, 1])
    for values, name in ((forces[:, 2], "along the hole"), (across, "across")):
        axes.plot(time[: now + 1], values[: now + 1], label=name)
    axes.set_xlim(0.0, time[-1])
    axes.set_ylim(-0.5, 1.5 * max(forces[:, 2].max(), across.max()))  # room for the legend
    finish(axes, "force (N)", "time (s)")
    axes.legend(loc="upper left", ncols=2)
    drawn: Any = FigureCanvasAgg(figure)
    drawn.draw()
    return np.asarray(drawn.buffer_rgba())[..., :3].copy()


def write_film(path: Path, gains: Mapping[str, float]) -> None:
    """A GIF of a validation episode of the moment-guided search at the largest error."""
    env = CoopInsertionContactEnv(LEVEL)
    start = options("validate", 0, TRAINED, 0.2)
    steps = episode(env, MomentSearch(env, Gains(**gains)), seed=0, options=start)
    shown = [(env.scene(), info.get("force", np.zeros(3))) for info in steps]
    forces, fps = np.array([force for _, force in shown]), env.metadata["render_fps"]
    with style():
        frames = [
            np.concatenate(
                [
                    render_frame(scene, size=SCENE, camera=CAMERA, panel=False),
                    _chart(forces, number, fps),
                ]
            )
            for number, (scene, _) in enumerate(shown)
        ]
    write_animation(path, [*frames[::2], frames[-1]], fps / 2)
