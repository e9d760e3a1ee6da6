"""Every render mode of the environment, alone and under Gymnasium's wrappers."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RecordVideo

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError
from coop_env.rendering import render_frame

ID = "CoopInsertion-v0"


@pytest.fixture(autouse=True)
def without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


def _step(env: Any, times: int = 1) -> None:
    for _ in range(times):
        env.step(np.flatnonzero(env.unwrapped.action_masks())[0])


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
    text: Any = env.render()
    assert all(word in text for word in ("0.6 s", "target 1", "0#", "sigma_min"))
    assert max(len(line) for line in text.splitlines()) <= 100


def test_no_mode_draws_nothing_and_says_so() -> None:
    env = CoopInsertionEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_checker_passes_with_every_mode() -> None:
    check_env(gym.make(ID).unwrapped)


def test_human_mode_is_gymnasiums_window_of_the_frames() -> None:
    import pygame

    with pytest.warns(UserWarning, match="HumanRendering"):
        env: Any = gym.make(ID, render_mode="human")
    env.unwrapped.render_kwargs = {"camera": "close", "size": (320, 240)}
    env.reset(seed=0)
    _step(env)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    scene = env.unwrapped.scene()
    assert np.array_equal(shown, render_frame(scene, size=(320, 240), camera="close"))
    env.close()
    assert not pygame.display.get_init()
    with pytest.raises(ArgumentError, match=r"gymnasium\.make"):
        CoopInsertionEnv(render_mode="human")


def test_record_video_writes_a_file_that_plays(tmp_path: Path) -> None:
    made: Any = gym.make(ID, render_mode="rgb_array", max_moves=6)
    made.unwrapped.render_kwargs = {"size": (320, 240)}
    env = RecordVideo(made, str(tmp_path / "video"), disable_logger=True)
    env.reset(seed=0)
    _step(env, 6)
    env.close()
    (file,) = (tmp_path / "video").glob("*.mp4")
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(file))
    assert count == 7
    assert seconds == pytest.approx(1.4, abs=0.05)  # moves of 0.2 s
