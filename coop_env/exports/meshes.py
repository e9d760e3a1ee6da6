"""Meshes of all links, from the shapes that the renderer draws, each in its link's own frame.

A link's frame lies in the joint nearest to its base, x along the link, y along the axis of the
actuated joint: the frames of the twin's MJCF.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError
from coop_env.physics.model import Machine
from coop_env.rendering.bodies import Body, bodies, radial_axes
from coop_env.rendering.scene import Scene

try:
    import trimesh
except ImportError as error:
    raise DependencyNotInstalled(
        f"exports need pip install 'sb3-rainbow-coop[trajectory]': {error}"
    ) from error

Floats = NDArray[np.float64]

UNITS: Final = {"m": 1.0, "mm": 1000.0}
SIDES: Final = {"left": -1.0, "right": 1.0}
"""The two rods of a forearm, by the side of the limb's plane that they lie on."""
_ON_BASE: Final = ("mount", "motor", "foot", "base")
_ON_LINK: Final = {
    "proximal": "proximal", "knee": "proximal", "elbow": "proximal", "distal": "distal",
    "ball": "distal", "left": "rod", "right": "rod",
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A rigid body: world point at home = rotation @ vertex + position; m.

    Attributes:
        name: as in the MJCF, whose one rod of a forearm is two here.
        rotation: (3, 3).
        position: (3,).
        mesh: all of its parts, in its own frame.
    """

    name: str
    rotation: Floats
    position: Floats
    mesh: Any


def links(machine: Machine | None = None) -> list[Link]:
    """All links of both robots at home, the bases first.

    Raises:
        GeometryError: a robot cannot be assembled.
    """
    m = Machine() if machine is None else machine
    env = CoopInsertionEnv(m.rrs, delta=m.delta, task=m.task)
    env.reset(seed=0, options={"configuration": m.home()})
    scene = env.scene()
    parts: dict[str, list[Body]] = {}
    for part in bodies(scene):
        if not part.shines:  # the arrow at the target
            parts.setdefault(_owner(part.name), []).append(part)
    return [
        Link(name, rotation, position, _joined(parts[name], rotation, position))
        for name, rotation, position in _frames(scene, parts)
    ]


def _owner(part: str) -> str:
    """The link that a part of the picture belongs to."""
    robot, *middle, name = part.split("/")
    if robot == "holes" or name in ("platform", "dome"):
        return "platform"
    if name in _ON_BASE:
        return f"{robot}_base"
    kind = _ON_LINK.get(name.split("_")[0])
    if kind is None or not middle:
        return "effector"  # with the wrists' pins, chuck and peg
    limb = f"{robot}_{kind}{middle[0].removeprefix('limb')}"
    return f"{limb}_{name.split('_')[0]}" if kind == "rod" else limb


def _frames(scene: Scene, parts: dict[str, list[Body]]) -> Iterator[tuple[str, Floats, Floats]]:
    height = scene.delta_base_joints[0, 2]
    yield "delta_base", np.eye(3), np.array([0.0, 0.0, height])
    yield "rrs_base", np.eye(3), np.zeros(3)
    for i in range(3):
        tangent = radial_axes(i)[1]
        joint, knee, end = (
            points[i] for points in (scene.delta_base_joints, scene.knees, scene.effector_joints)
        )
        yield f"delta_proximal{i}", _along(knee - joint, tangent), joint
        for side in SIDES:
            (rod,) = (part for part in parts[f"delta_rod{i}_{side}"] if part.name.endswith(side))
            yield f"delta_rod{i}_{side}", _along(end - knee, tangent), rod.position
        base, elbow, ball = (
            points[i] for points in (scene.rrs_base_joints, scene.elbows, scene.platform_joints)
        )
        yield f"rrs_proximal{i}", _along(elbow - base, tangent), base
        yield f"rrs_distal{i}", _along(ball - elbow, tangent), elbow
    yield "effector", np.eye(3), scene.effector
    yield "platform", scene.platform_rotation, scene.platform_centre


def _along(x: Floats, y: Floats) -> Floats:
    """Rotation whose first column is along x, and whose second is as near to y as can be."""
    first = x / np.linalg.norm(x)
    second = y - (y @ first) * first
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])


def _joined(parts: list[Body], rotation: Floats, position: Floats) -> Any:
    meshes = []
    for part in parts:
        world = part.mesh.vertices @ part.rotation.T + part.position
        mesh = trimesh.Trimesh((world - position) @ rotation, part.mesh.faces)
        colour = [*(round(255 * c) for c in part.colour), 255]
        mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=colour)
        meshes.append(mesh)
    return trimesh.util.concatenate(meshes)


def save_stl(folder: Path, machine: Machine | None = None, unit: str = "m") -> list[Path]:
    """Write a binary STL of each link, in its own frame; returns the paths.

    Args:
        folder: made if it is missing.
        machine: None, the standard one.
        unit: of the numbers in the files, ``"m"`` or ``"mm"``.

    Raises:
        ArgumentError: the unit is neither.
    """
    scale, result = _scale(unit), links(machine)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for link in result:
        paths.append(folder / f"{link.name}.stl")
        link.mesh.copy().apply_scale(scale).export(paths[-1])
    return paths


def save_glb(path: Path, machine: Machine | None = None, unit: str = "m") -> None:
    """Write the machine at home as binary glTF, a node with its colours for each link.

    glTF's own unit is the metre: of millimetres the reader has to be told.

    Raises:
        ArgumentError: the unit is neither ``"m"`` nor ``"mm"``.
    """
    scale, scene = _scale(unit), trimesh.Scene()
    for link in links(machine):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = link.rotation, scale * link.position
        mesh = link.mesh.copy().apply_scale(scale)
        scene.add_geometry(mesh, node_name=link.name, geom_name=link.name, transform=pose)
    scene.export(path, file_type="glb")


def _scale(unit: str) -> float:
    if unit not in UNITS:
        raise ArgumentError(f"unit = {unit!r}: must be one of {list(UNITS)}")
    return UNITS[unit]
