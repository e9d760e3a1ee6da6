"""The machine as files for other programs: meshes of its links, and SDF (extra ``trajectory``).

Meshes are the shapes that the renderer draws, each in its link's own frame. That lies in the joint
nearest to the link's base, x along the link, y along the axis of the actuated joint: the frames of
the twin's MJCF.

SDF can express what URDF cannot: links that close loops. Two models in one world, each with all its
joints: six rods with a universal joint at the knee and a ball at the wrist hold the Delta's
effector level, three balls hold the platform. Every joint's zero is at home. Masses and inertias
are those of the twin's MJCF, a forearm's halved between its rods.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError, ResetOptionError, imports
from coop_env.geometry import GeometryError
from coop_env.physics.joints import Floats, tree_angles
from coop_env.physics.model import DELTA_RANGE, Machine, to_xml
from coop_env.physics.twin import make_model
from coop_env.rendering.bodies import ROD_SPACING, SIDES, Body, bodies, pixels
from coop_env.rendering.rasterizer import to_linear

with imports("exports need", "trajectory"):
    import mujoco
    import trimesh

UNITS: Final = {"m": 1.0, "mm": 1000.0}
MESHES: Final = "meshes"
"""The folder of the meshes, beside the file."""


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
        GeometryError: a robot cannot be assembled, or collides at home.
        ArgumentError: the holes do not fit the dome.
    """
    m = Machine() if machine is None else machine
    env = CoopInsertionEnv(m.rrs, delta=m.delta, task=m.task)
    try:
        env.reset(seed=0, options={"configuration": m.home()})
    except ResetOptionError as refused:
        raise GeometryError(f"the machine cannot stand at home: {refused}") from refused
    parts: dict[str, list[Body]] = {}
    for part in bodies(replace(env.scene(), target=-1)):  # no hole is aimed at
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
            # glTF has linear light, and other formats no colours
            red, green, blue = to_linear(part.colour)
            colour = [*pixels((red, green, blue)), 255]
            mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=colour)
            meshes.append(mesh)
        result.append(Link(name, rotation, position, trimesh.util.concatenate(meshes)))
    return result


def save_stl(folder: str | Path, machine: Machine | None = None, unit: str = "m") -> list[Path]:
    """Write a binary STL of each link, in its own frame, in ``"m"`` or ``"mm"``; returns the paths.

    The platform's dome, rings and bores are open shells, the other links are closed.

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


def save_sdf(folder: str | Path, machine: Machine | None = None) -> Path:
    """Write ``coop_insertion.sdf`` and the meshes it names into a folder; returns the file.

    Raises:
        GeometryError: a robot cannot be assembled.
    """
    m = Machine() if machine is None else machine
    save_stl(Path(folder) / MESHES, m)
    path = Path(folder) / "coop_insertion.sdf"
    path.write_text(to_xml(build_sdf(m)), encoding="utf-8")
    return path


def build_sdf(machine: Machine) -> ET.Element:
    """The world with both robots.

    Raises:
        GeometryError: a robot cannot be assembled.
    """
    root = ET.Element("sdf", version="1.9")
    world = ET.SubElement(root, "world", name="coop_insertion")
    model, result = make_model(machine), links(machine)
    for robot, tip in (("delta", "effector"), ("rrs", "platform")):
        body = ET.SubElement(world, "model", name=robot)
        _joint(body, f"{robot}_mount", "fixed", "world", f"{robot}_base")
        for link in result:
            if link.name.startswith(robot) or link.name == tip:
                _add_link(body, link, model)
        _add_joints(body, robot, machine)
    return root


def _text(parent: ET.Element, tag: str, values: float | Floats | Sequence[float]) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = " ".join(f"{v:.12g}" for v in np.ravel(np.asarray(values, np.float64)))
    return element


def _add_link(body: ET.Element, link: Link, model: Any) -> None:
    element = ET.SubElement(body, "link", name=link.name)
    turn = Rotation.from_matrix(link.rotation).as_euler("xyz")  # about fixed axes, as SDF has it
    _text(element, "pose", [*link.position, *turn])
    mass, centre, inertia = _inertia(link.name, model)
    inertial = ET.SubElement(element, "inertial")
    _text(inertial, "pose", [*centre, 0.0, 0.0, 0.0])
    _text(inertial, "mass", mass)
    tensor = ET.SubElement(inertial, "inertia")
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        _text(tensor, f"i{'xyz'[i]}{'xyz'[j]}", inertia[i, j])
    for kind in ("visual", "collision"):
        shape = ET.SubElement(ET.SubElement(element, kind, name=kind), "geometry")
        ET.SubElement(ET.SubElement(shape, "mesh"), "uri").text = f"{MESHES}/{link.name}.stl"


def _inertia(link: str, model: Any) -> tuple[float, Floats, Floats]:
    """Mass, centre (3,) and inertia (3, 3) about it, of the MJCF's bodies that make up a link."""
    names = ["effector", "peg"] if link == "effector" else [link.removesuffix("_left")]
    parts = [model.body(name.removesuffix("_right")) for name in names]
    masses = [float(part.mass[0]) for part in parts]
    mass, centre = sum(masses), np.average([part.ipos for part in parts], axis=0, weights=masses)
    inertia = np.zeros((3, 3))
    for part in parts:
        axes, d = Rotation.from_quat(part.iquat, scalar_first=True).as_matrix(), part.ipos - centre
        own = axes @ np.diag(part.inertia) @ axes.T
        inertia += own + part.mass[0] * (d @ d * np.eye(3) - np.outer(d, d))
    share = 0.5 if link.startswith("delta_rod") else 1.0  # a forearm's, of its two rods
    return share * mass, centre, share * inertia


def _joint(body: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    element = ET.SubElement(body, "joint", name=name, type=kind)
    ET.SubElement(element, "parent").text = parent
    ET.SubElement(element, "child").text = child
    return element


def _turning(joint: ET.Element, tag: str, xyz: Sequence[float], **limits: float) -> None:
    """An axis in the child's frame; without limits nothing drives it."""
    axis = ET.SubElement(joint, tag)
    _text(axis, "xyz", xyz)
    element = ET.SubElement(axis, "limit")
    for name, value in (limits or {"effort": 0.0}).items():
        _text(element, name, value)


def _ball(body: ET.Element, name: str, link: str, at: float, child: str) -> None:
    """A ball at the far end of a link, which closes a loop in all limbs but one."""
    joint = _joint(body, name, "ball", link, child)
    _text(joint, "pose", [at, 0.0, 0.0, 0.0, 0.0, 0.0]).set("relative_to", link)


def _add_joints(body: ET.Element, robot: str, m: Machine) -> None:
    angles, effort = tree_angles(m.home(), m.rrs, m.delta), m.servos.torque_limit
    if robot == "delta":
        axis, home, (low, high) = (0, 1, 0), angles.theta, DELTA_RANGE
        velocity = m.delta.max_joint_velocity
    else:
        axis, home, (low, high) = (0, -1, 0), angles.q, (m.rrs.joint_min, m.rrs.joint_max)
        velocity = m.rrs.max_joint_velocity
    for i in range(3):
        link = f"{robot}_proximal{i}"
        motor = _joint(body, f"{robot}_joint{i}", "revolute", f"{robot}_base", link)
        limits = {"lower": low - home[i], "upper": high - home[i]}
        _turning(motor, "axis", axis, **limits, effort=effort, velocity=velocity)
        if robot == "rrs":
            elbow = _joint(body, f"rrs_elbow{i}", "revolute", link, f"rrs_distal{i}")
            _turning(elbow, "axis", axis)
            _ball(body, f"rrs_ball{i}", f"rrs_distal{i}", m.rrs.distal_length, "platform")
            continue
        for side in SIDES:
            rod = f"delta_rod{i}_{side}"
            knee = _joint(body, f"delta_knee{i}_{side}", "universal", link, rod)
            _turning(knee, "axis", axis)
            _turning(knee, "axis2", (0, 0, 1))
            _ball(body, f"delta_wrist{i}_{side}", rod, m.delta.distal_length, "effector")
