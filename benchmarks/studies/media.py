"""The README's picture and a short animation of one solved episode.

The exact lattice optimum plays, or with --model a policy. Written to results/media: scene.png and
episode.gif.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled
from PIL import Image

from benchmarks.errors import TRUSTED, BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.team.env import make_env
from benchmarks.runs.store import write_atomic
from benchmarks.studies.base import Act, Part, Study, Tick, count, episode, stored_player
from coop_env.env import CoopInsertionEnv
from coop_env.geometry import GEOMETRIES
from coop_env.rendering import render_frame
from coop_env.rendering.bodies import COLOURS
from coop_env.rendering.scene import Scene
from coop_env.rendering.viewer import ViewerError, view

Image8 = npt.NDArray[np.uint8]

SCENE_SIZE: Final = (1120, 630)
GIF_SIZE: Final = (480, 360)
GIF_EVERY: Final = 2  # moves between two pictures of the animation
GIF_COLOURS: Final = 144
FPS: Final = 5  # of the animation: twice the robots' own pace of one move in 0.2 s
HOLD_SECONDS: Final = 2.0  # the last picture stays so long
DEFAULT_SEED: Final = 8


def optimal_moves(env: CoopInsertionEnv) -> Act:
    """The lattice optimum's next move to the next hole; BenchmarkError where there is no plan."""
    oracle = LatticeOracle()

    def act(observation: Any, masks: Any) -> int:
        plan = oracle.plan(env)
        if plan.moves is None:
            raise BenchmarkError(f"no plan from here to hole {env.scene().target}")
        return int(plan.moves[0])

    return act


def player(
    model: Path | None, trust: bool, make: Callable[..., CoopInsertionEnv], **shown: Any
) -> tuple[CoopInsertionEnv, Act]:
    """The environment to be shown, and who plays: a model under its own masks, or the optimum."""
    arguments, act = ({}, None) if model is None else stored_player(model, trust)
    given = {name: value for name, value in shown.items() if value is not None}
    env = make(**arguments | {"render_mode": "rgb_array", **given})
    return env, act or optimal_moves(env)


def watch(arguments: argparse.Namespace) -> None:
    """Let the optimum or a model play in the browser until the view is closed."""
    make = partial(_twin, arguments.results) if arguments.twin else make_env
    env, act = player(arguments.model, arguments.trust, make, geometry=arguments.geometry)
    try:
        view(env, act, host=arguments.host, port=arguments.port)
    except ViewerError as error:
        raise BenchmarkError(str(error)) from error


def _twin(results: Path, **shown: Any) -> CoopInsertionEnv:
    from benchmarks.studies.robots.trials import inserter

    if "shield" in shown:
        raise BenchmarkError("--twin: the model was trained under a shield, which the twin lacks")
    try:
        from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    return CoopInsertionPhysicsDiscreteEnv(inserter(results, "spiral search", 0), **shown)


def play(env: CoopInsertionEnv, seed: int, act: Act) -> list[Scene]:
    """The scenes of one episode, from reset to its end."""
    steps = episode(env, lambda seen: act(seen, env.action_masks()), seed=seed)
    return [env.scene() for _ in steps]


def telling_moment(scenes: Sequence[Scene]) -> Scene:
    """The scene nearest to its hole among those with half of the final holes filled."""
    half = scenes[-1].filled.sum() // 2
    return min(scenes, key=lambda scene: (abs(scene.filled.sum() - half), scene.distance))


def write_animation(path: Path, frames: Sequence[Image8], fps: float) -> None:
    """Write a GIF with one palette for all pictures, so that what stands still costs nothing."""
    seen = np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]])
    # small but telling: without a share of their own the palette would lose these colours
    shades = np.multiply.outer((1.0, 0.8, 0.6), np.array(list(COLOURS.values())))
    accents = np.round(255 * shades.reshape(-1, 3)).astype(np.uint8)
    rows = np.repeat(np.resize(accents, (seen.shape[1], 3))[None], len(seen) // 4, axis=0)
    palette = Image.fromarray(np.concatenate([seen, rows])).quantize(GIF_COLOURS)
    look: dict[str, Any] = {"palette": palette, "dither": Image.Dither.NONE}
    first, *others = (Image.fromarray(frame).quantize(**look) for frame in frames)
    durations = [round(1000 / fps)] * len(others) + [round(1000 * HOLD_SECONDS)]
    options = {"append_images": others, "duration": durations, "loop": 0, "optimize": False}
    write_atomic(path, lambda file: first.save(file, "GIF", save_all=True, **options))


class Media(Study):
    """Pictures of one episode."""

    name = "media"
    options = {  # noqa: RUF012
        "--geometry": {"choices": sorted(GEOMETRIES), "help": "3-RRS (default: the model's)"},
        "--model": {"type": Path, "help": "a trained model instead of the optimum"},
        "--trust": {"action": "store_true", "help": TRUSTED},
        "--seed": count(DEFAULT_SEED, "of the episode's start", 0),
    }

    def parts(self) -> dict[str, Part]:
        return {"drawing": self._draw}

    def _draw(self, tick: Tick) -> None:
        given = self.given
        env, act = player(given.model, given.trust, make_env, geometry=given.geometry)
        scenes = play(env, given.seed, act)
        still = render_frame(telling_moment(scenes), size=SCENE_SIZE, samples=4)
        picture = Image.fromarray(still)
        write_atomic(self.folder / "scene.png", lambda file: picture.save(file, "PNG"))
        shown = scenes[::GIF_EVERY] + ([] if len(scenes) % GIF_EVERY else scenes[-1:])
        frames: list[Image8] = []
        for scene in shown:
            frames.append(render_frame(scene, size=GIF_SIZE))
            tick(len(frames) / len(shown))
        write_animation(self.folder / "episode.gif", frames, FPS)
