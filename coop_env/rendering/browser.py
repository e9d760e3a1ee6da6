"""The browser's side of the view: a viser server, meshes that follow the scene, a line of text."""

from __future__ import annotations

import math
import socket
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from coop_env.env import CoopInsertionEnv
from coop_env.geometry import GEOMETRIES
from coop_env.kinematics.rrs_kernels import make_params
from coop_env.rendering.bodies import COLOURS, Body, bodies, hole_state
from coop_env.rendering.scene import Scene

if TYPE_CHECKING:
    import viser


ANGLES: Final = (3, 4)
"""Axes that the view shows in degrees."""


class ViewerError(RuntimeError):
    """The view cannot be opened; the message names the mend."""


def open_server(host: str, port: int) -> viser.ViserServer:
    """A server that listens on exactly this address.

    Raises:
        ViewerError: viser is not installed, or the port cannot be used.
    """
    try:
        import viser
    except ImportError as error:
        raise ViewerError(
            f"the browser view needs pip install 'sb3-rainbow-coop[render]': {error}"
        ) from error
    if not 1 <= port <= 65535:
        raise ViewerError(f"port {port}: must be 1 to 65535")
    with socket.socket() as probe:  # viser would quietly take another port
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ViewerError(f"{host}:{port} cannot be used ({error}): try another port") from None
    return viser.ViserServer(host, port, label="Cooperative insertion", verbose=False)


def _weld(body: Body) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices and faces in which corners of one smooth surface are shared.

    The browser computes normals by itself: where vertices are shared, it shades smoothly.
    """
    mesh = body.mesh
    both = np.round(np.hstack([mesh.vertices, mesh.normals]), 7)
    unique, inverse = np.unique(both, axis=0, return_inverse=True)
    return unique[:, :3].astype(np.float32), inverse.reshape(-1)[mesh.faces].astype(np.uint32)


class Stage:
    """Keeps the browser's meshes in step with the bodies of a scene."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: dict[str, tuple[Body, Any]] = {}

    def show(self, scene: Scene) -> None:
        """Move what moved, add what is new or looks different, remove what is gone."""
        present = {body.name: body for body in bodies(scene, scene.trace)}
        with self._server.atomic():
            for name in [n for n in self._shown if n not in present]:
                self._shown.pop(name)[1].remove()
            for name, body in present.items():
                old = self._shown.get(name)
                if old is None or old[0].mesh is not body.mesh or old[0].colour != body.colour:
                    handle = self._add(body, old)
                else:
                    handle = old[1]
                    handle.position, handle.wxyz = body.position, _quaternion(body)
                self._shown[name] = (body, handle)

    def _add(self, body: Body, old: tuple[Body, Any] | None) -> Any:
        if old is not None:
            old[1].remove()
        vertices, faces = _weld(body)
        red, green, blue = (round(255 * c) for c in body.colour)
        return self._server.scene.add_mesh_simple(
            f"/{body.name}",
            vertices,
            faces,
            color=(red, green, blue),
            position=body.position,
            wxyz=_quaternion(body),
        )


def _quaternion(body: Body) -> npt.NDArray[np.float64]:
    from viser.transforms import SO3

    return np.asarray(SO3.from_matrix(body.rotation).wxyz)


def summary(scene: Scene) -> str:
    """Time, holes in their colours, target and margin, as Markdown."""
    marks = []
    for index in range(len(scene.filled)):
        red, green, blue = (round(255 * c) for c in COLOURS[hole_state(scene, index)])
        marks.append(f'<span style="color:rgb({red},{green},{blue})">⬤</span>')
    return (
        f"**{scene.time:.1f} s**, {scene.status}, {int(scene.filled.sum())} of "
        f"{int(scene.active.sum())} filled\n\n{' '.join(marks)}\n\n"
        f"target {scene.target}: {1e3 * scene.distance:.0f} mm, "
        f"{math.degrees(scene.alignment_error):.1f}°; sigma_min {scene.sigma_min:+.3f}"
    )


def geometry_name(env: CoopInsertionEnv) -> str | None:
    """Which of the named geometries the environment has, if any."""
    own = env.params.rrs[:4]  # the lengths
    return next((name for name, g in GEOMETRIES.items() if make_params(g)[:4] == own), None)
