"""The browser view: what it refuses, what it shows, and a real browser that moves a slider."""

from __future__ import annotations

import base64
import io
import itertools
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from coop_env.env import CoopInsertionEnv
from coop_env.rendering import viewer as viewer_module
from coop_env.rendering.bodies import COLOURS
from coop_env.rendering.browser import ViewerError
from coop_env.rendering.viewer import Viewer

START = (0.0, 0.0, -0.38, 0.0, 0.0, 0.23)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _until(condition: Callable[[], bool], seconds: float, what: str) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what}: not within {seconds} s"
        time.sleep(0.05)


def _make_env(geometry: str) -> CoopInsertionEnv:
    return CoopInsertionEnv(geometry=geometry, render_mode="rgb_array")


@pytest.fixture(scope="module")
def opened() -> Iterator[Viewer]:
    viewer = Viewer(_make_env("optimized"), make_env=_make_env, port=_free_port())
    yield viewer
    viewer.close()


@pytest.fixture
def view(opened: Viewer) -> Viewer:
    """At a start of known pose and target, optimized geometry."""
    if opened.env.params.rrs.base_radius != CoopInsertionEnv().params.rrs.base_radius:
        opened.switch_geometry("optimized")
    opened.env.reset(seed=1, options={"configuration": START, "target": 1, "filled": [4]})
    opened.place(0, START[0])
    return opened


def test_slider_moves_the_robots_and_keeps_the_task(view: Viewer) -> None:
    assert view.place(3, 10.0)
    assert view.env.configuration[3] == pytest.approx(np.radians(10.0))
    scene = view.env.scene()
    assert scene.target == 1
    assert scene.filled.tolist() == [False, False, False, False, True, False]
    assert view.sliders[3].value == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("axis", "value", "reason"),
    [(3, 44.9, "joint limit"), (2, -0.46, "collide"), (0, 0.16, "")],
)
def test_slider_is_refused_where_the_robots_cannot_go(
    view: Viewer, axis: int, value: float, reason: str
) -> None:
    wanted = view.env.configuration
    wanted[axis] = np.radians(value) if axis in (3, 4) else value
    possible = view.env.configuration_status(wanted) == 0
    assert possible == (reason == "")
    before = view.env.configuration
    assert view.place(axis, value) == possible
    if possible:
        assert view.message.content == ""
        return
    assert "Refused" in view.message.content
    assert reason in view.message.content
    assert view.env.configuration == pytest.approx(before, abs=0.0)
    shown = np.degrees(before[axis]) if axis in (3, 4) else before[axis]
    assert view.sliders[axis].value == pytest.approx(shown, abs=1e-6)


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


def test_colliding_move_is_refused_aloud(view: Viewer) -> None:
    for _ in range(20):
        if not view.move(5):  # down onto the dome
            break
    assert "collide" in view.message.content
    assert view.env.configuration_status(view.env.configuration) == 0


def test_geometry_switch_changes_the_machine(view: Viewer) -> None:
    before = np.linalg.norm(view.env.scene().rrs_base_joints[0])
    view.switch_geometry("initial")
    assert np.linalg.norm(view.env.scene().rrs_base_joints[0]) > before + 0.02


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
        _until(lambda: "no idea" in viewer.message.content, 10.0, "the policy's error")
        assert asked == [12, 12, 12]
        assert viewer.env.scene().time == pytest.approx(0.4)
    finally:
        viewer.close()
        viewer.close()


@pytest.mark.parametrize("port", [0, 70000])
def test_impossible_port_is_one_clear_error(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert viewer_module.main(["--port", str(port)]) == 2
    assert f"port {port}: must be 1 to 65535" in capsys.readouterr().err


def test_taken_port_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ViewerError, match="try another port"):
            Viewer(CoopInsertionEnv(), port=taken.getsockname()[1])


def test_missing_viser_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(ViewerError, match=r"\[render\]"):
        Viewer(CoopInsertionEnv(), port=_free_port())


class Browser:
    """A headless Chromium, spoken to over its DevTools protocol."""

    def __init__(self, profile: Path, address: str) -> None:
        assert CHROMIUM is not None
        flags = (
            "--headless --no-sandbox --disable-gpu --use-angle=swiftshader "
            "--enable-unsafe-swiftshader --disable-background-networking --no-first-run "
            "--disable-component-update --disable-sync --disable-dev-shm-usage "
            "--window-size=1000,700 --remote-debugging-port=0"
        )
        self.process = subprocess.Popen(
            [CHROMIUM, *flags.split(), f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._ids = itertools.count(1)
        announced = profile / "DevToolsActivePort"
        _until(lambda: announced.is_file() and "\n" in announced.read_text(), 30.0, "Chromium")
        self._base = f"http://127.0.0.1:{announced.read_text().splitlines()[0]}"
        _until(lambda: self._page() is not None, 20.0, "the page")
        page = self._page()
        assert page is not None
        from websockets.sync.client import connect

        self._socket = connect(page["webSocketDebuggerUrl"], max_size=2**26)

    def _page(self) -> dict[str, Any] | None:
        with urllib.request.urlopen(f"{self._base}/json/list", timeout=10) as answer:
            targets = json.load(answer)
        return next((t for t in targets if t["type"] == "page"), None)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=30))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result

    def evaluate(self, script: str) -> Any:
        result = self.ask("Runtime.evaluate", expression=script, returnByValue=True)
        return result["result"].get("value")

    def picture(self) -> npt.NDArray[np.int16]:
        """The 3-D view alone, (height, width, 3), without the panel at its right."""
        data = base64.b64decode(self.ask("Page.captureScreenshot")["data"])
        image = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=np.int16)
        return image[:, 320:640]

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def close(self) -> None:
        self._socket.close()
        self.process.terminate()
        self.process.wait(timeout=20)


def _share(picture: npt.NDArray[np.int16], colour: str) -> int:
    """Pixels that have the hue of a named colour, whatever the browser's light makes of it."""
    wanted = np.array(COLOURS[colour]) - np.mean(COLOURS[colour])
    hue = picture - picture.mean(axis=2, keepdims=True)
    strength = np.linalg.norm(hue, axis=2)
    along = hue @ (wanted / np.linalg.norm(wanted))
    return int(((strength > 40.0) & (along > 0.93 * strength)).sum())


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_browser_shows_both_robots_and_moves_with_a_slider(view: Viewer, tmp_path: Path) -> None:
    browser = Browser(tmp_path / "profile", f"http://127.0.0.1:{view.port}")
    try:
        pictures: list[npt.NDArray[np.int16]] = []

        def both_robots() -> bool:
            pictures.append(browser.picture())
            return _share(pictures[-1], "delta") > 300 and _share(pictures[-1], "rrs") > 150

        _until(both_robots, 40.0, "both robots in the browser")
        before = view.env.configuration
        track = browser.evaluate(
            "(() => { const r = document.querySelectorAll('[role=slider]')[0]"
            ".parentElement.getBoundingClientRect(); return [r.left, r.width, r.top + r.height / 2]"
            "})()"
        )
        browser.click(track[0] + 0.8 * track[1], track[2])
        _until(lambda: view.env.configuration[0] > before[0] + 0.05, 10.0, "the slider's move")
        _until(
            lambda: np.abs(browser.picture() - pictures[-1]).max(axis=2).__gt__(60).sum() > 400,
            20.0,
            "a changed picture",
        )
        assert view.env.configuration[1:] == pytest.approx(before[1:], abs=0.0)
    finally:
        browser.close()
