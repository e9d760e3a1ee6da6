"""The README's picture, a video and a short animation of one solved episode.

    python -m benchmarks media

The exact lattice optimum plays, or with --model a policy. Written to results/media: scene.png,
episode.mp4 and episode.gif.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
from PIL import Image
from rich.console import Console
from rich.progress import Progress

from benchmarks.errors import BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.runs.store import write_atomic
from coop_env.env import CoopInsertionEnv, Observation
from coop_env.geometry import GEOMETRIES
from coop_env.rendering import CAMERAS, frame_view, render_frame
from coop_env.rendering.bodies import COLOURS
from coop_env.rendering.scene import Scene

Image8 = npt.NDArray[np.uint8]
Act = Callable[[Observation, npt.NDArray[np.bool_]], int]

SCENE_SIZE: Final = (1120, 630)
VIDEO_SIZE: Final = (960, 720)
GIF_SIZE: Final = (480, 360)
GIF_EVERY: Final = 2  # moves between two pictures of the animation
GIF_COLOURS: Final = 144
VIDEO_FPS: Final = 10  # twice the robots' own pace of one move in 0.2 s
HOLD_SECONDS: Final = 2.0  # the last picture stays so long
DEFAULT_SEED: Final = 8


def planned_moves(env: CoopInsertionEnv) -> Act:
    """The moves of the lattice optimum, hole by hole, from the environment's current state.

    Raises:
        BenchmarkError: the optimum does not fill every hole from this start.
    """
    moves: list[int] = []
    for number, plan in enumerate(LatticeOracle().plan_episode(env), start=1):
        if plan.moves is None:
            raise BenchmarkError(
                f"no plan for hole number {number} of this episode ({plan.status}): "
                "try another --seed"
            )
        moves += plan.moves.tolist()
    return lambda observation, masks: moves.pop(0)


def policy_moves(path: Path, env: CoopInsertionEnv, trust: bool = False) -> Act:
    """Greedy actions of a trained model.

    Args:
        path: of its file.
        env: that it is to act in.
        trust: as :func:`benchmarks.evaluation.model_files.load_model`.

    Raises:
        BenchmarkError: it cannot be loaded, or was trained on other observations.
    """
    from benchmarks.evaluation.evaluate import model_policy
    from benchmarks.evaluation.model_files import load_model

    model = load_model(path, trust=trust)
    expected, given = model.observation_space.shape, env.observation_space.shape
    if expected != given:
        raise BenchmarkError(
            f"--model {path}: trained on observations of shape {expected}, "
            f"this environment gives {given}"
        )
    act = model_policy(model)
    return lambda observation, masks: int(act(observation[None], masks[None])[0])


def play(
    env: CoopInsertionEnv, seed: int, choose: Callable[[CoopInsertionEnv], Act]
) -> list[Scene]:
    """The scenes of one episode, from reset to its end."""
    observation, _ = env.reset(seed=seed)
    act = choose(env)
    scenes = [env.scene()]
    over = False
    while not over:
        action = act(observation, env.action_masks())
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        scenes.append(env.scene())
    return scenes


def telling_moment(scenes: Sequence[Scene], camera: str) -> int:
    """Which scene shows most: some holes filled, the next one and its neighbours in sight.

    Sight is the sum over holes of the cosine between normal and the way to the camera, the target
    counting like all others together.
    """
    last = int(scenes[-1].filled.sum())

    def worth(scene: Scene) -> float:
        view = frame_view(scene, size=SCENE_SIZE, camera=camera)
        sight = np.maximum(scene.hole_normals @ -view.axes[2], 0.0)
        near = 0.025 <= scene.distance <= 0.08
        part = 0.2 * last <= scene.filled.sum() <= 0.7 * last
        return float(sight.mean() + sight[scene.target]) + near + part

    return int(np.argmax([worth(scene) for scene in scenes]))


def write_picture(path: Path, scene: Scene, camera: str) -> None:
    """A still of the scene, smooth enough for print."""
    image = Image.fromarray(render_frame(scene, size=SCENE_SIZE, camera=camera, samples=4))
    write_atomic(path, lambda temporary: image.save(temporary, "PNG", optimize=True))


def write_video(path: Path, frames: Sequence[Image8], fps: int) -> None:
    """H.264 in MP4, which every browser plays."""

    def write(temporary: Path) -> None:
        height, width = frames[0].shape[:2]
        writer = imageio_ffmpeg.write_frames(
            str(temporary), (width, height), fps=fps, quality=6, output_params=["-f", "mp4"]
        )
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()

    write_atomic(path, write)


def write_animation(path: Path, frames: Sequence[Image8], fps: float) -> None:
    """A GIF with one palette for all pictures, so that what stands still costs nothing."""
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


def parser(word: str, text: str | None) -> argparse.ArgumentParser:
    """The command line of ``media`` and ``watch``: who plays on which geometry."""
    found = argparse.ArgumentParser(
        prog=f"python -m benchmarks {word}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    found.add_argument("--geometry", choices=sorted(GEOMETRIES), default="optimized")
    found.add_argument("--model", type=Path, help="a trained model instead of the lattice optimum")
    text = "load a --model that SB3 saved, which runs its author's code"
    found.add_argument("--trust", action="store_true", help=text)
    return found


def _write_all(arguments: argparse.Namespace, console: Console) -> None:
    env = CoopInsertionEnv(geometry=arguments.geometry, render_mode="rgb_array")
    model: Path | None = arguments.model
    choose = planned_moves if model is None else partial(policy_moves, model, trust=arguments.trust)
    scenes = play(env, arguments.seed, choose)
    out, camera = arguments.out, arguments.camera
    write_picture(out / "scene.png", scenes[telling_moment(scenes, camera)], camera)
    stills = scenes[::GIF_EVERY] + ([] if len(scenes) % GIF_EVERY else scenes[-1:])
    with Progress(console=console) as progress:
        task = progress.add_task("drawing", total=len(scenes) + len(stills))

        def draw(scene: Scene, size: tuple[int, int]) -> Image8:
            frame = render_frame(scene, size=size, camera=camera)
            progress.advance(task)
            return frame

        frames = [draw(scene, VIDEO_SIZE) for scene in scenes]
        small = [draw(scene, GIF_SIZE) for scene in stills]
    frames += [frames[-1]] * round(HOLD_SECONDS * VIDEO_FPS)
    write_video(out / "episode.mp4", frames, VIDEO_FPS)
    write_animation(out / "episode.gif", small, VIDEO_FPS / GIF_EVERY)
    last = scenes[-1]
    console.print(
        f"{int(last.filled.sum())} of {int(last.active.sum())} holes filled in {last.time:.1f} s; "
        f"the video runs at {VIDEO_FPS / env.metadata['render_fps']:g} times that pace"
    )
    names = ["scene.png", "episode.mp4", "episode.gif"]
    for name in names:
        console.print(f"{out / name}  {(out / name).stat().st_size / 1000:.0f} kB")


def main(words: Sequence[str]) -> int:
    """Play, draw, write."""
    line = parser("media", __doc__)
    line.add_argument("--out", type=Path, default=Path("results/media"), help="folder")
    line.add_argument("--seed", type=int, default=DEFAULT_SEED, help="of the episode's start")
    line.add_argument("--camera", choices=list(CAMERAS), default="iso")
    arguments = line.parse_args(words)
    if arguments.seed < 0:
        raise BenchmarkError(f"--seed {arguments.seed}: must not be negative")
    try:
        _write_all(arguments, Console(soft_wrap=True))
    except OSError as error:
        raise BenchmarkError(str(error)) from error
    return 0
