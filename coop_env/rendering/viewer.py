"""Both robots in the browser (viser): sliders, the twelve moves, a policy or planner at play."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ResetOptionError, imports
from coop_env.rendering.bodies import COLOURS, Body, bodies, hole_state, pixels
from coop_env.rendering.scene import Scene
from coop_env.simulation.state import INVALID
from coop_env.simulation.task import AXES, N_ACTIONS, axis_bounds
from coop_env.trajectory import REASONS

if TYPE_CHECKING:
    import viser

Act = Callable[[Any, npt.NDArray[np.bool_]], int]
_ANGLES: Final = (3, 4)  # axes that the view shows in degrees


class ViewerError(RuntimeError):
    """The view cannot be opened; the message names the fix."""


def _check_address(host: str, port: int) -> None:
    """ViewerError unless a server can listen there."""
    with imports("the browser view needs", "render", ViewerError):
        import viser  # noqa: F401
    if not 1 <= port <= 65535:
        raise ViewerError(f"port {port}: must be 1 to 65535")
    with socket.socket() as probe:  # viser would quietly take another port
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ViewerError(f"{host}:{port} cannot be used ({error}): try another port") from None


def _open_server(host: str, port: int) -> viser.ViserServer:
    """A server that listens on exactly this address."""
    import viser

    server: Any = viser.ViserServer(host, port, label="Cooperative insertion", verbose=False)
    # any client may ask viser for a public address, even a foreign page in the same browser
    server.request_share_url = lambda *_, **__: None
    return server


def _weld(body: Body) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices and faces, corners of one smooth surface shared: only these the browser smooths."""
    mesh = body.mesh
    both = np.round(np.hstack([mesh.vertices, mesh.normals]), 7)
    unique, inverse = np.unique(both, axis=0, return_inverse=True)
    return unique[:, :3].astype(np.float32), inverse.reshape(-1)[mesh.faces].astype(np.uint32)


def _summary(scene: Scene) -> str:
    """Time, holes in their colours, target and margin, as Markdown."""
    marks = [
        f'<span style="color:rgb{pixels(COLOURS[hole_state(scene, index)])}">⬤</span>'
        for index in range(len(scene.filled))
    ]
    return (
        f"**{scene.time:.1f} s**, {scene.status}, {int(scene.filled.sum())} of "
        f"{int(scene.active.sum())} filled\n\n{' '.join(marks)}\n\n"
        f"target {scene.target}: {1e3 * scene.distance:.0f} mm, "
        f"{math.degrees(scene.alignment_error):.1f}°; sigma_min {scene.sigma_min:+.3f}"
    )


def _name(action: int) -> str:
    return f"{'+-'[action % 2]} {AXES[action // 2]}"


class Viewer:
    """A browser view of one environment, which it plays.

    Args:
        env: what to show; it makes a move first, so that all is compiled, and is reset.
        act: chooses a move from (observation, action masks) for the play button; None has none.
        host: address to listen on, by default for this machine alone.
        port: 1 to 65535, free.

    Raises:
        ViewerError: viser is missing, the port cannot be used, or the moves are not the twelve.
    """

    def __init__(
        self, env: CoopInsertionEnv, act: Act | None = None, *, host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:  # fmt: skip
        if getattr(env.action_space, "n", None) != N_ACTIONS:
            raise ViewerError(f"{type(env).__name__}: the view plays the twelve moves, in turn")
        _check_address(host, port)
        self.env = env
        env.reset()  # kernels compile before anyone can look
        env.step(int(np.argmax(env.action_masks())))
        env.configuration_status(env.configuration)
        self._observation, _ = env.reset()
        bodies(env.scene())
        self._server = _open_server(host, port)
        self._act = act
        self._lock = threading.RLock()  # the browser's events come on threads of their own
        self._wanted = (0, 0.0)  # axis and value of the slider moved last
        self._playing = threading.Event()
        self._closed = threading.Event()
        self._shown: dict[str, tuple[Body, Any]] = {}  # bodies by name, and their handles
        self._set_scene()
        self._build_panel()
        self._show("")
        self._player = threading.Thread(target=self._play_loop, daemon=True)
        self._player.start()

    def _set_scene(self) -> None:
        server = self._server
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction("+z")
        server.initial_camera.fov = 0.7
        server.initial_camera.position = (1.05, -1.40, 0.95)
        server.initial_camera.look_at = (0.0, 0.0, 0.40)
        server.scene.add_grid(
            "/floor", 2.0, 2.0, cell_size=0.1, section_size=0.5, position=(0.0, 0.0, -0.024)
        )

    def _build_panel(self) -> None:
        gui = self._server.gui
        self.status = gui.add_markdown("")
        self._margin: Any = gui.add_progress_bar(0.0)
        self.message = gui.add_markdown("")
        gui.add_button("Reset").on_click(lambda _: self.reset())
        if self._act is not None:
            self._play = gui.add_button("Play")
            self._play.on_click(lambda _: self.toggle_play())
        tabs = gui.add_tab_group()
        with tabs.add_tab("Degrees of freedom"):
            bounds = np.array(axis_bounds(self.env.params)).T
            self.sliders = [self._add_slider(k, *bounds[k].tolist()) for k in range(len(AXES))]
        with tabs.add_tab("Moves"):
            self.buttons = [self._add_button(action) for action in range(N_ACTIONS)]

    def _add_slider(self, axis: int, low: float, high: float) -> Any:
        unit, step = "m", 0.001
        if axis in _ANGLES:
            low, high, unit, step = math.degrees(low), math.degrees(high), "deg", 0.5
        slider = self._server.gui.add_slider(f"{AXES[axis]} [{unit}]", low, high, step, low)

        def on_update(event: Any) -> None:
            if event.client is not None:  # None: the slider follows the robot, nobody moved it
                wanted = self._wanted = (axis, float(slider.value))
                with self._lock:
                    if self._wanted is wanted:  # else it is dragged on already
                        self.place(*wanted)

        slider.on_update(on_update)
        return slider

    def _add_button(self, action: int) -> Any:
        button: Any = self._server.gui.add_button(_name(action))
        button.on_click(lambda _: self.move(action))
        return button

    def place(self, axis: int, value: float) -> bool:
        """Put one degree of freedom at ``value`` (m or degrees) and begin an episode from there.

        Target and filled holes stay, unless all are filled.
        """
        with self._lock:
            self.stop()
            configuration = self.env.configuration
            configuration[axis] = math.radians(value) if axis in _ANGLES else value
            status = self.env.configuration_status(configuration)
            if status != 0:
                return self._refuse(f"{AXES[axis]} = {value:g}: {REASONS[status]}")
            scene = self.env.scene()
            options: dict[str, Any] = {"configuration": configuration}
            if not scene.filled[scene.target]:
                options |= {"target": scene.target, "filled": np.flatnonzero(scene.filled)}
            try:
                self._observation, _ = self.env.reset(options=options)
            except ResetOptionError as error:
                return self._refuse(str(error))
            self._show("")
            return True

    def move(self, action: int) -> bool:
        """Make one of the twelve moves; a masked or colliding one is refused with a message."""
        with self._lock:
            name = _name(action)
            if not self.env.running:
                return self._refuse("the episode is over: reset, or move a slider")
            if not self.env.action_masks()[action]:
                return self._refuse(f"{name}: masked ({REASONS[INVALID]}, or the masks' arguments)")
            self._observation, reward, _, _, info = self.env.step(action)
            if info["collision"]:
                return self._refuse(f"{name}: the robots would collide")
            self._show(f"**{name}**: reward {reward:+.2f}" + (", inserted" * info["inserted"]))
            return True

    def reset(self) -> None:
        """Begin an episode at a drawn start."""
        with self._lock:
            self.stop()
            self._observation, _ = self.env.reset()
            self._show("")

    def toggle_play(self) -> None:
        """Let ``act`` play at the robots' own pace, or stop it."""
        if self._playing.is_set():
            self.stop()
        elif self._act is not None:
            self._playing.set()
            self._play.label = "Stop"

    def stop(self) -> None:
        """Stop playing, if anything plays."""
        if self._playing.is_set():
            self._playing.clear()
            self._play.label = "Play"

    def _play_loop(self) -> None:
        while not self._closed.is_set():
            if not self._playing.wait(timeout=0.2) or self._closed.is_set():
                continue
            began = time.perf_counter()
            with self._lock:
                self._play_move()
            time.sleep(max(self.env.task.dt - (time.perf_counter() - began), 0.0))

    def _play_move(self) -> None:
        if not self._playing.is_set() or self._act is None:
            return
        if not self.env.running:
            self.stop()
            return
        try:
            action = int(self._act(self._observation, self.env.action_masks()))
            self._observation, *_ = self.env.step(action)
        except Exception as error:  # show whatever a caller's policy raises
            self.stop()
            self._refuse(f"playing stopped: {error}")
            return
        self._show("")

    def _refuse(self, reason: str) -> bool:
        self._show(f"**Refused.** {reason}")
        return False

    def _show(self, message: str) -> None:
        """Bring the browser up to date with the environment."""
        scene = self.env.scene()
        self._place_bodies(scene)
        self.message.content = message
        self.status.content = _summary(scene)
        self._margin.value = 100.0 * min(max(scene.sigma_min, 0.0), 1.0)
        self._margin.color = "green" if scene.sigma_min >= 3 * scene.singular_margin else "red"
        for axis, slider in enumerate(self.sliders):
            value = scene.configuration[axis]
            slider.value = round(math.degrees(value) if axis in _ANGLES else value, 6)
        masks = self.env.action_masks() if self.env.running else np.zeros(N_ACTIONS, np.bool_)
        for button, possible in zip(self.buttons, masks, strict=True):
            button.disabled = not possible

    def _place_bodies(self, scene: Scene) -> None:
        """Move what moved, add what is new or looks different, remove what is gone."""
        from viser.transforms import SO3

        present = {body.name: body for body in bodies(scene)}
        with self._server.atomic():
            for name, (old, handle) in list(self._shown.items()):
                new = present.get(name)
                if new is None or new.mesh is not old.mesh or new.colour != old.colour:
                    self._shown.pop(name)
                    handle.remove()
            for name, body in present.items():
                if name in self._shown:
                    handle = self._shown[name][1]
                else:
                    colour, mesh = pixels(body.colour), _weld(body)
                    handle = self._server.scene.add_mesh_simple(f"/{name}", *mesh, color=colour)
                handle.position = body.position
                handle.wxyz = SO3.from_matrix(body.rotation).wxyz
                self._shown[name] = (body, handle)

    def close(self) -> None:
        """Stop the server and the player; harmless when done twice."""
        if not self._closed.is_set():
            self._closed.set()
            self._playing.set()
            self._player.join()
            self._server.stop()


def view(
    env: CoopInsertionEnv, act: Act | None = None, *, host: str = "127.0.0.1", port: int = 8080
) -> None:
    """Show an environment in the browser until interrupted; see :class:`Viewer`."""
    print("building the scene", flush=True)
    viewer = Viewer(env, act, host=host, port=port)
    print(f"open http://{host}:{port} in a browser; Ctrl-C ends", flush=True)
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        viewer.close()
