"""The command that writes the README's picture and the animation."""

from __future__ import annotations

import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError
from benchmarks.studies import media, watch
from coop_env.env import CoopInsertionEnv
from coop_env.rendering.scene import Scene
from coop_env.rendering.viewer import Act, Viewer

SIZE = (160, 128)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pictures of the episode's last moves only: the same path in a tenth of the time."""
    whole = media.play

    def play(*arguments: object) -> list[Scene]:
        scenes = whole(*arguments)  # type: ignore[arg-type]
        assert scenes[-1].status == "success"
        return scenes[:1] + scenes[-8:]

    monkeypatch.setattr(media, "play", play)
    for name in ("SCENE_SIZE", "GIF_SIZE"):
        monkeypatch.setattr(media, name, SIZE)


@pytest.mark.usefixtures("short")
def test_two_files_of_one_solved_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "media"
    out.mkdir()
    (out / "scene.png").write_bytes(b"old")
    assert main(["study", "media", "--results", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["episode.gif", "scene.png"]
    assert str(out) in said
    with Image.open(out / "scene.png") as picture:
        assert picture.size == SIZE
    with Image.open(out / "episode.gif") as animation:
        assert animation.n_frames == 5


@pytest.mark.usefixtures("short")
def test_same_seed_same_picture(tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert main(["study", "media", "--results", str(tmp_path / name), "--seed", "3"]) == 0
    for name in ("scene.png", "episode.gif"):
        first, second = (tmp_path / folder / "media" / name for folder in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "nowhere.zip"], "nowhere.zip is missing"),
        (["--model", __file__], "is no model of Stable-Baselines3"),
    ],
)
def test_bad_arguments_are_one_error_and_nothing_is_written(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "media"
    assert main(["study", "media", *arguments, "--results", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_unsolvable_episode_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = SimpleNamespace(moves=None)
    monkeypatch.setattr("benchmarks.methods.oracle.LatticeOracle.plan", lambda self, env: nothing)
    with pytest.raises(BenchmarkError, match="no plan from here"):
        media.play(CoopInsertionEnv(), 0, media.optimal_moves)


def test_optimum_plans_anew_where_it_is_put() -> None:
    env = CoopInsertionEnv()
    observation, _ = env.reset(seed=8)
    play = media.optimal_moves(env)
    for _ in range(5):
        observation, *_ = env.step(play(observation, env.action_masks()))
    observation, _ = env.reset(seed=10)
    filled, over = 0, False
    while not over:
        observation, _, terminated, truncated, info = env.step(
            play(observation, env.action_masks())
        )
        filled, over = info["n_filled"], terminated or truncated
        assert not info["collision"]
    assert filled == np.sum(env.scene().active)


def test_watch_names_a_bad_port(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "--port", "0"]) == 2
    assert "port 0" in capsys.readouterr().err


def test_the_twin_is_shown_where_it_really_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="needs the extra physics")
    opened: list[Viewer] = []

    def view(env: CoopInsertionEnv, act: Act, **where: Any) -> None:
        opened.append(Viewer(env, act, **where))

    monkeypatch.setattr(watch, "view", view)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    assert main(["watch", "--twin", "--port", str(port)]) == 0
    viewer = opened[0]
    try:
        env: Any = viewer.env
        assert viewer.place(3, 5.0)
        assert viewer.move(0) or viewer.move(1)
        assert env.configuration[3] == pytest.approx(np.radians(5.0))
        base = env.scene().rrs_base_joints
        assert np.ptp(base[:, 2]) > 1e-5  # it stands askew
        np.testing.assert_allclose(env.scene().tip, env.physics.scene(0, []).tip)
    finally:
        viewer.close()
