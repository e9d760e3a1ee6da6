"""One insertion in contact as a film: the twin above, the force on the peg below."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from benchmarks.methods.contact_scripts import Gains, MomentSearch
from benchmarks.reporting.figures.style import PALETTE, canvas, style
from benchmarks.studies.media import HOLD_SECONDS, write_animation, write_video
from benchmarks.studies.robots.trials import TRAINED, options
from coop_env.physics.env import CoopInsertionContactEnv
from coop_env.rendering import CAMERAS, render_frame
from coop_env.rendering.scene import Scene

WIDTH: Final = 480  # px
CAMERA: Final = replace(CAMERAS["dome"], distance=0.42)
SIZES: Final = (WIDTH, 368), (WIDTH, 176)  # of the scene and of the chart
DPI: Final = 100


def play(gains: Gains) -> tuple[list[Scene], NDArray[np.float64], int]:
    """Scenes of a validation episode of the moment-guided search at the largest error.

    Returns:
        Scenes, force on the peg (steps, 3), N, and frames per second.
    """
    env = CoopInsertionContactEnv("standard")
    script, over = MomentSearch(env, gains), False
    observation, _ = env.reset(seed=0, options=options("validate", 0, TRAINED, 0.2))
    scenes, forces = [env.scene()], [np.zeros(3)]
    while not over:
        observation, _, terminated, truncated, info = env.step(script(observation))
        over = terminated or truncated
        scenes.append(env.scene())
        forces.append(info["force"])
    return scenes, np.array(forces), env.metadata["render_fps"]


def _chart(forces: NDArray[np.float64], now: int, fps: int) -> NDArray[np.uint8]:
    """The force along the hole and across it, up to a moment."""
    figure, (axes,) = canvas(size=(SIZES[1][0] / DPI, SIZES[1][1] / DPI))
    figure.set_dpi(DPI)
    time = np.arange(len(forces)) / fps
    across = np.hypot(forces[:, 0], forces[:, 1])
    for values, name, colour in ((forces[:, 2], "along the hole", PALETTE[0]),
                                 (across, "across", PALETTE[1])):  # fmt: skip
        axes.plot(time[: now + 1], values[: now + 1], color=colour, label=name)
    axes.set_xlim(0.0, time[-1])
    axes.set_ylim(-0.5, 1.5 * max(forces[:, 2].max(), across.max()))  # room for the legend
    axes.set_xlabel("time (s)")
    axes.set_ylabel("force (N)")
    axes.legend(loc="upper left", ncols=2)
    drawn: Any = FigureCanvasAgg(figure)
    drawn.draw()
    return np.asarray(drawn.buffer_rgba())[..., :3].copy()


def write_film(folder: Path, gains: Gains) -> list[Path]:
    """Write ``insertion.mp4`` and ``insertion.gif``; returns their paths."""
    scenes, forces, fps = play(gains)
    with style():
        frames = [
            np.concatenate(
                [
                    render_frame(scene, size=SIZES[0], camera=CAMERA, panel=False),
                    _chart(forces, number, fps),
                ]
            )
            for number, scene in enumerate(scenes)
        ]
    paths = [folder / "insertion.mp4", folder / "insertion.gif"]
    write_video(paths[0], [*frames, *[frames[-1]] * round(HOLD_SECONDS * fps)], fps)
    write_animation(paths[1], [*frames[::2], frames[-1]], fps / 2)
    return paths
