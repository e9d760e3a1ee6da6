"""The browser view: what it refuses, and what it shows."""

import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from viser.transforms import SO3

from coop_env.env import CoopInsertionEnv
from coop_env.rendering.bodies import bodies
from coop_env.rendering.viewer import Viewer, ViewerError
from coop_env.team.joint_env import CoopInsertionJointEnv

START = (0.0, 0.0, -0.38, 0.0, 0.0, 0.23)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_for(message: str, viewer: Viewer) -> None:
    end = time.monotonic() + 120.0
    while message not in viewer.message.content:
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture(scope="module")
def opened() -> Iterator[Viewer]:
    viewer = Viewer(CoopInsertionEnv(render_mode="rgb_array"), port=_free_port())
    yield viewer
    viewer.close()


@pytest.fixture
def view(opened: Viewer) -> Viewer:
    """At a start of known pose and target."""
    opened.env.reset(seed=1, options={"configuration": START, "target": 1, "filled": [4]})
    opened.place(0, START[0])
    return opened


def test_no_client_gets_a_public_address(view: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *given: opened.append(given))
    assert view._server.request_share_url() is None
    assert opened == []


def test_slider_moves_the_robots_and_keeps_the_task(view: Viewer) -> None:
    assert view.place(3, 10.0)
    assert view.env.configuration[3] == pytest.approx(np.radians(10.0))
    scene = view.env.scene()
    assert (scene.target, np.flatnonzero(scene.filled).tolist()) == (1, [4])
    assert view.sliders[3].value == pytest.approx(10.0)
    assert view.place(3, 0.0)
    assert view.place(0, 0.16)  # at the very end
    assert view.message.content == ""


@pytest.mark.parametrize(
    ("axis", "value", "reason"), [(3, 44.9, "joint limits"), (2, -0.46, "collision")]
)
def test_slider_is_refused_where_the_robots_cannot_go(
    view: Viewer, axis: int, value: float, reason: str
) -> None:
    before = view.env.configuration
    wanted = before.copy()
    wanted[axis] = np.radians(value) if axis == 3 else value
    assert view.env.configuration_status(wanted) != 0
    assert not view.place(axis, value)
    assert "Refused" in view.message.content
    assert reason in view.message.content
    assert view.env.configuration.tolist() == before.tolist()
    assert view.sliders[axis].value == pytest.approx(START[axis], abs=1e-6)


def test_move_is_made_and_buttons_follow_the_mask(view: Viewer) -> None:
    assert view.move(0)
    assert view.env.configuration[0] == pytest.approx(START[0] + 0.02)
    assert view.place(5, 0.25)
    masks = view.env.action_masks()
    assert not masks[10]  # heave is at its upper limit
    assert [not button.disabled for button in view.buttons] == masks.tolist()
    before = view.env.configuration
    assert not view.move(10)
    assert "Refused" in view.message.content
    assert view.env.configuration == pytest.approx(before, abs=0.0)


def test_a_move_is_named_with_its_sign(view: Viewer) -> None:
    assert view.move(1)
    assert view.message.content.startswith("**- x**: reward ")  # a bare "- " would be a bullet


def test_of_a_dragged_slider_the_last_position_counts(
    view: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    placed: list[float] = []
    monkeypatch.setattr(view, "place", lambda axis, value: placed.append(value))
    slider, follow = view.sliders[0], view.sliders[0]._impl.update_cb[0]
    drags = []
    with view._lock:  # as while another position is shown
        for value in (0.01, 0.02, 0.03):
            slider._impl.value = value
            drags.append(threading.Thread(target=follow, args=(SimpleNamespace(client=1),)))
            drags[-1].start()
            time.sleep(0.05)
    for drag in drags:
        drag.join()
    assert placed == [0.03]


def test_colliding_move_is_refused_aloud(view: Viewer) -> None:
    for _ in range(20):
        if not view.move(5):  # down onto the dome
            break
    assert "collide" in view.message.content
    assert view.env.configuration_status(view.env.configuration) == 0


def test_play_lets_the_callable_act_and_stops_on_its_error() -> None:
    asked: list[int] = []

    def act(observation: Any, masks: npt.NDArray[np.bool_]) -> int:
        asked.append(len(observation))
        if len(asked) == 3:
            raise RuntimeError("no idea")
        return int(np.flatnonzero(masks)[0])

    viewer = Viewer(CoopInsertionEnv(), act, port=_free_port())
    try:
        viewer.toggle_play()
        _wait_for("no idea", viewer)
        assert asked == [12, 12, 12]
        assert viewer.env.scene().time == pytest.approx(0.4)
    finally:
        played = viewer.env.scene().time
        viewer.close()
        viewer.close()
        assert viewer.env.scene().time == played


def test_play_survives_an_environment_that_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    env = CoopInsertionEnv()
    env.reset(seed=0)
    scene = env.scene()

    def breaks(*_: Any) -> None:
        env._started = False  # as of a finish that raises on the twin
        raise RuntimeError("broken")

    viewer = Viewer(env, lambda observation, masks: 0, port=_free_port())
    try:
        with monkeypatch.context() as broken:
            broken.setattr(env, "step", breaks)
            broken.setattr(env, "scene", lambda: scene)
            viewer.toggle_play()
            _wait_for("broken", viewer)
            with viewer._lock:  # until all of it is shown
                assert all(button.disabled for button in viewer.buttons)
        assert viewer._player.is_alive()
        viewer.reset()
        assert viewer.move(0) or viewer.move(1)
    finally:
        viewer.close()


def test_robots_that_move_at_once_or_by_reals_are_refused() -> None:
    pytest.importorskip("mujoco")
    from coop_env.physics.env import CoopInsertionPhysicsEnv

    for kind in (CoopInsertionJointEnv, CoopInsertionPhysicsEnv):
        env: Any = kind()
        with pytest.raises(ViewerError, match=f"{kind.__name__}: the view plays the twelve"):
            Viewer(env, port=_free_port())


def test_a_port_that_cannot_be_used_and_a_missing_viser_are_one_clear_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = CoopInsertionEnv()
    with pytest.raises(ViewerError, match="port 70000: must be 1 to 65535"):
        Viewer(env, port=70000)
    assert not env.running  # told before anything is compiled
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ViewerError, match="try another port"):
            Viewer(CoopInsertionEnv(), port=taken.getsockname()[1])
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ViewerError, match=r"\[render\]"):
        Viewer(CoopInsertionEnv(), port=_free_port())


def test_every_body_stands_in_the_browser_where_the_scene_has_it(view: Viewer) -> None:
    for _ in range(2):
        shown = view._shown
        wanted = {body.name: body for body in bodies(view.env.scene())}
        assert set(shown) == set(wanted)
        for name, body in wanted.items():
            handle = shown[name][1]
            np.testing.assert_allclose(handle.position, body.position)
            np.testing.assert_allclose(SO3(handle.wxyz).as_matrix(), body.rotation, atol=1e-9)
        assert view.move(0)


def test_meshes_of_a_long_trace_come_out_of_the_cache(view: Viewer) -> None:
    way = np.cumsum(np.linspace(0.001, 0.02, 451))[:, None] * np.array([1.0, 0.0, 0.0])
    scene = replace(view.env.scene(), trace=way)
    first, again = bodies(scene), bodies(scene)
    assert all(a.mesh is b.mesh for a, b in zip(first, again, strict=True))
