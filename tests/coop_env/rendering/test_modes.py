"""Every render mode of the environment, alone and under Gymnasium's wrappers."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import HumanRendering, RecordVideo

import coop_env  # noqa: F401  (registers the ids)
from coop_env.env import CoopInsertionEnv
from coop_env.rendering import CAMERAS, open_window, render_frame
from coop_env.rendering.window import Window

ID = "CoopInsertion-v0"


@pytest.fixture(autouse=True)
def without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


def _step(env: gym.Env[Any, Any], times: int = 1) -> None:
    for _ in range(times):
        env.step(np.flatnonzero(env.unwrapped.action_masks())[0])  # type: ignore[attr-defined]


def _decode(path: Path, shape: tuple[int, int, int]) -> npt.NDArray[np.uint8]:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, *shape)


def test_rgb_array_is_the_scene_and_follows_the_robots() -> None:
    env = gym.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert isinstance(first, np.ndarray)
    assert np.array_equal(first, render_frame(env.unwrapped.scene()))  # type: ignore[attr-defined]
    _step(env)
    second = env.render()
    assert isinstance(second, np.ndarray)
    assert (first != second).any(axis=2).mean() > 0.002
    env.close()


def test_camera_and_size_can_be_chosen_for_the_environment() -> None:
    env = CoopInsertionEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env.render_kwargs = {"camera": "close", "size": (320, 240)}
    wanted = render_frame(env.scene(), camera="close", size=(320, 240))
    assert np.array_equal(env.render(), wanted)
    env.render_kwargs = {"colour": "red"}
    with pytest.raises(TypeError, match="colour"):
        env.render()
    assert CoopInsertionEnv().render_kwargs == {}


def test_ansi_tells_time_target_and_holes() -> None:
    env = gym.make(ID, render_mode="ansi")
    env.reset(seed=0, options={"target": 1, "filled": [0]})
    _step(env, 3)
    text = env.render()
    assert isinstance(text, str)
    assert "0.6 s" in text
    assert "target 1" in text
    assert "0#" in text
    assert "sigma_min" in text
    assert max(len(line) for line in text.splitlines()) <= 100


def test_no_mode_draws_nothing_and_says_so() -> None:
    env = CoopInsertionEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_metadata_has_the_modes_and_the_robots_own_pace() -> None:
    assert set(CoopInsertionEnv.metadata["render_modes"]) == {"rgb_array", "human", "ansi"}
    assert CoopInsertionEnv.metadata["render_fps"] == 5


def test_checker_passes_with_every_mode() -> None:
    check_env(gym.make(ID).unwrapped)


@pytest.fixture
def window() -> Iterator[Window]:
    opened = open_window(100.0, size=(480, 360))
    yield opened
    opened.close()


def test_window_shows_the_frame(window: Window) -> None:
    import pygame

    env = CoopInsertionEnv()
    env.reset(seed=0)
    window.show(env.scene())
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, render_frame(env.scene(), size=(480, 360)))


def test_keys_choose_the_camera(window: Window) -> None:
    import pygame

    env = CoopInsertionEnv()
    env.reset(seed=0)
    names = list(CAMERAS)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_1 + names.index("close")))
    window.show(env.scene())
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, render_frame(env.scene(), size=(480, 360), camera="close"))


def test_window_that_a_person_closes_stays_closed(window: Window) -> None:
    import pygame

    env = CoopInsertionEnv()
    env.reset(seed=0)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(env.scene())
    assert not window.is_open
    window.show(env.scene())
    window.close()
    assert not pygame.display.get_init()


def test_the_last_of_several_windows_takes_the_display_along() -> None:
    """As a training environment and one for evaluation have them."""
    import pygame

    first, second = (CoopInsertionEnv(render_mode="human") for _ in range(2))
    for env in (first, second):
        env.reset(seed=0)
    first.close()
    second.step(2)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    second.step(2)
    assert not pygame.display.get_init()
    second.step(3)
    second.close()


@pytest.mark.parametrize(("fps", "camera"), [(0.0, "iso"), (5.0, "isometric")])
def test_window_refuses_bad_arguments_before_it_opens(fps: float, camera: str) -> None:
    import pygame

    with pytest.raises(ValueError, match=r"fps|unknown camera"):
        open_window(fps, camera=camera)
    assert not pygame.display.get_init()


def test_human_mode_opens_shows_and_closes_cleanly() -> None:
    import pygame

    env = gym.make(ID, render_mode="human")
    env.reset(seed=0)
    first = pygame.surfarray.array3d(pygame.display.get_surface())
    _step(env)
    second = pygame.surfarray.array3d(pygame.display.get_surface())
    assert (first != second).any()
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_human_rendering_wrapper_shows_the_frames() -> None:
    env = HumanRendering(gym.make(ID, render_mode="rgb_array"))
    env.reset(seed=0)
    _step(env)
    assert env.render_mode == "human"
    env.close()


def test_record_video_writes_a_file_that_plays(tmp_path: Path) -> None:
    env = gym.make(ID, render_mode="rgb_array", max_moves=6)
    env = RecordVideo(env, str(tmp_path / "video"), disable_logger=True)
    env.reset(seed=0)
    _step(env, 6)
    env.close()
    files = list((tmp_path / "video").glob("*.mp4"))
    assert len(files) == 1
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(files[0]))
    assert count == 7
    assert seconds == pytest.approx(1.4, abs=0.05)  # moves of 0.2 s
    frames = _decode(files[0], (480, 640, 3))
    assert len(frames) == 7
    first = gym.make(ID, render_mode="rgb_array")
    first.reset(seed=0)
    drawn = first.render()
    assert isinstance(drawn, np.ndarray)
    # up to what the codec loses, the first picture is the one of the reset
    assert np.abs(frames[0].astype(int) - drawn).mean() < 4.0
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 100
