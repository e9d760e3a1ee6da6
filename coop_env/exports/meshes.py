"""Meshes of all links, from the shapes that the renderer draws, each in its link's own frame.

A link's frame lies in the joint nearest to its base, x along the link, y along the axis of the
actuated joint: the frames of the twin's MJCF.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError
from coop_env.physics.model import Machine
from coop_env.physics.twin import make_model
from coop_env.rendering.bodies import ROD_SPACING, SIDES, Body, bodies, pixels

try:
    import mujoco
    import trimesh
except ImportError as error:
    raise DependencyNotInstalled(
        f"exports need pip install 'sb3-rainbow-coop[trajectory]': {error}"
    ) from error

Floats = NDArray[np.float64]
UNITS: Final = {"m": 1.0, "mm": 1000.0}


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A rigid body: world point at home = rotation @ vertex + position; m.

    ``name`` is the MJCF's, whose one rod of a forearm is two here; ``mesh`` has all of its parts,
    in its own frame.
    """

    name: str
    rotation: Floats  # (3, 3)
    position: Floats  # (3,)
    mesh: Any


def links(machine: Machine | None = None) -> list[Link]:
    """All links of both robots at home, the bases first, the rest as they are drawn.

    Raises:
        GeometryError: a robot cannot be assembled.
        ArgumentError: the holes do not fit the dome.
    """
    m = Machine() if machine is None else machine
    env = CoopInsertionEnv(m.rrs, delta=m.delta, task=m.task)
    env.reset(seed=0, options={"configuration": m.home()})
    parts: dict[str, list[Body]] = {}
    for part in bodies(env.scene()):
        if not part.shines:  # the arrow at the target
            parts.setdefault(part.name.split("/")[0], []).append(part)
    model = make_model(m)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    result = []
    for name in sorted(parts, key=lambda name: not name.endswith("base")):
        body, _, side = name.rpartition("_") if "_rod" in name else (name, "", "")
        rotation = np.round(data.body(body).xmat.reshape(3, 3), 12)
        aside = ROD_SPACING * SIDES.get(side, 0.0) * rotation[:, 1]
        position = np.round(data.body(body).xpos + aside, 12)
        meshes = []
        for part in parts[name]:
            world = part.mesh.vertices @ part.rotation.T + part.position
            mesh = trimesh.Trimesh((world - position) @ rotation, part.mesh.faces)
            colour = [*pixels(part.colour), 255]
            mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=colour)
            meshes.append(mesh)
        result.append(Link(name, rotation, position, trimesh.util.concatenate(meshes)))
    return result


def save_stl(folder: str | Path, machine: Machine | None = None, unit: str = "m") -> list[Path]:
    """Write a binary STL of each link, in its own frame, in ``"m"`` or ``"mm"``; returns the paths.

    Raises:
        ArgumentError: the unit is neither.
    """
    if unit not in UNITS:
        raise ArgumentError(f"unit = {unit!r}: must be one of {list(UNITS)}")
    result, paths = links(machine), []
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for link in result:
        paths.append(folder / f"{link.name}.stl")
        link.mesh.copy().apply_scale(UNITS[unit]).export(paths[-1])
    return paths


def save_glb(path: str | Path, machine: Machine | None = None) -> None:
    """Write the machine at home as binary glTF, a node with its colours for each link.

    As in all glTF, lengths are in m and the y axis points up, so that the machine's (x, y, z) are
    the file's (x, z, -y).
    """
    y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    scene = trimesh.Scene()
    for link in links(machine):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = link.rotation, link.position
        scene.add_geometry(link.mesh, link.name, link.name, transform=y_up @ pose)
    scene.export(path, file_type="glb")
