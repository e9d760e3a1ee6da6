"""The command that writes the README's picture and the animation."""

import shutil
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.cli import main
from benchmarks.methods.team.env import make_env
from benchmarks.studies import media
from benchmarks.studies.base import episode
from coop_env.env import CoopInsertionEnv
from coop_env.rendering.viewer import Act, Viewer
from coop_env.shield import ShieldedInsertionEnv
from tests.benchmarks.conftest import Command
from tests.process import ROOT

RESULTS = ROOT / "results"
SIZE = (160, 128)


def test_two_files_of_one_solved_episode_are_the_same_for_the_same_seed(
    tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"SCENE_SIZE": SIZE, "GIF_SIZE": SIZE, "GIF_EVERY": 40}.items():
        monkeypatch.setattr(media, name, value)
    out, again = (tmp_path / name / "media" for name in ("a", "b"))
    out.mkdir(parents=True)
    (out / "scene.png").write_bytes(b"old")
    for folder in (out, again):
        assert str(folder) in done("study", "media", "--results", str(folder.parent), "--seed", "3")
    assert sorted(path.name for path in out.iterdir()) == ["episode.gif", "scene.png"]
    with Image.open(out / "scene.png") as picture:
        assert picture.size == SIZE
    with Image.open(out / "episode.gif") as animation:
        assert animation.n_frames > 3
    for name in ("scene.png", "episode.gif"):
        assert (out / name).read_bytes() == (again / name).read_bytes()


def test_a_policy_is_shown_on_its_own_robot_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    make: Any = SimpleNamespace
    stored = ({"geometry": "initial"}, lambda observation, masks: 0)
    monkeypatch.setattr(media, "stored_player", lambda model, trust: stored)
    for given, shown in ((None, "initial"), ("optimized", "optimized")):
        env: Any = media.player(Path("policy.zip"), False, make, geometry=given)[0]
        assert env.geometry == shown


def test_a_policy_plays_under_its_own_shield(tmp_path: Path) -> None:
    for name in ("policy.zip", "config.yaml"):
        shutil.copy(RESULTS / "cut" / "runs" / "rainbow-optimized-safe-s0" / name, tmp_path)
    config = tmp_path / "config.yaml"
    text = config.read_text("utf-8")
    config.write_text(text.replace("track:\n", "track:\n  shield: {}\n"), "utf-8")
    env, _ = media.player(tmp_path / "policy.zip", False, make_env)
    assert isinstance(env, ShieldedInsertionEnv)


def test_optimum_plans_anew_where_it_is_put() -> None:
    env = CoopInsertionEnv()
    observation, _ = env.reset(seed=8)
    play = media.optimal_moves(env)
    for _ in range(5):
        observation, *_ = env.step(play(observation, env.action_masks()))
    _, *infos = episode(env, lambda seen: play(seen, env.action_masks()), seed=10)
    assert not any(info["collision"] for info in infos)
    assert infos[-1]["n_filled"] == np.sum(env.scene().active)


def test_the_twin_is_shown_where_it_really_is(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="needs the extra physics")
    opened: list[Viewer] = []

    def view(env: CoopInsertionEnv, act: Act, host: str, port: int) -> None:
        assert port == 7
        with socket.socket() as probe:  # only now, so that no other process takes it meanwhile
            probe.bind((host, 0))
            free = int(probe.getsockname()[1])
        opened.append(Viewer(env, act, host=host, port=free))

    monkeypatch.setattr(media, "view", view)
    assert main(["watch", "--twin", "--port", "7"]) == 0
    viewer = opened[0]
    try:
        env: Any = viewer.env
        env.reset(seed=0)  # from a rare start the robots collide at 5 degrees
        assert viewer.place(3, 5.0), viewer.message.content
        assert viewer.move(0) or viewer.move(1)
        assert env.configuration[3] == pytest.approx(np.radians(5.0))
        assert np.ptp(env.scene().rrs_base_joints[:, 2]) > 1e-5  # it stands askew
        np.testing.assert_allclose(env.scene().tip, env.physics.scene(0, []).tip)
    finally:
        viewer.close()
