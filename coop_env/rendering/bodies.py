"""The solids of a scene: every visible part of both robots as a mesh with a pose and a colour.

The picture and the browser view draw the same list. Meshes come out of a cache, so from one move
to the next only poses and the holes' colours change. Sizes that the kinematics do not give
(thicknesses, plates, housings) are for the eye; contact is decided by
``coop_env.simulation.collision``, whose forearm, for one, is a single capsule along the middle of
the two rods drawn here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np

from coop_env.rendering import shapes
from coop_env.rendering.scene import Scene
from coop_env.rendering.shapes import FloatArray, Mesh

Colour = tuple[float, float, float]


def _rgb(code: str) -> Colour:
    red, green, blue = (int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4))
    return red, green, blue


COLOURS: Final = MappingProxyType(
    {
        "delta": _rgb("2f6fb0"),
        "delta_base": _rgb("c9d1da"),
        "forearm": _rgb("4a5563"),
        "housing": _rgb("39424e"),
        "steel": _rgb("a9b2bd"),
        "peg": _rgb("c0392b"),
        "rrs": _rgb("d98a29"),
        "rrs_base": _rgb("9aa5b1"),
        "distal": _rgb("4a5563"),
        "platform": _rgb("5f6b7a"),
        "dome": _rgb("e2dccf"),
        "bore": _rgb("20252c"),
        "open": _rgb("3f86d6"),
        "target": _rgb("f39200"),
        "filled": _rgb("2aa35a"),
        "inactive": _rgb("b4b4b0"),
        "trace": _rgb("d1457b"),
    }
)
"""Display colours (sRGB, 0 to 1) by what they mark."""

_UP: Final = np.array([0.0, 0.0, 1.0])
_ROD_SPACING: Final = 0.017  # half the distance between a forearm's two rods, m
_BORE: Final = 0.0055  # radius of a hole as drawn; the peg's is 0.004 m
_RING: Final = 0.003  # least width of the ring about it, m
_LIFT: Final = 0.0006  # marks stand this proud of the dome, m


@dataclass(frozen=True, slots=True)
class Body:
    """A mesh placed in the world: point = rotation @ vertex + position.

    ``name`` is unique within a scene and stays with the part from one scene to the next; a part
    that ``shines`` is drawn without shading.
    """

    name: str
    mesh: Mesh
    rotation: FloatArray
    position: FloatArray
    colour: Colour
    gloss: float = 0.15
    shines: bool = False


def radial_axes(limb: int) -> tuple[FloatArray, FloatArray]:
    """Radial u_i and tangential t_i unit vectors of a limb of either robot."""
    a = limb * 2.0 * math.pi / 3.0
    return np.array([math.cos(a), math.sin(a), 0.0]), np.array([-math.sin(a), math.cos(a), 0.0])


def frame(z: FloatArray, x: FloatArray | None = None) -> FloatArray:
    """Rotation whose third column is along ``z`` and whose first is as near to ``x`` as can be."""
    k = z / np.linalg.norm(z)
    if x is None:
        x = np.eye(3)[int(np.argmin(np.abs(k)))]
    j = np.cross(k, x)
    j /= np.linalg.norm(j)
    return np.column_stack([np.cross(j, k), j, k])


def _rod(name: str, a: FloatArray, b: FloatArray, radius: float, colour: str) -> Body:
    mesh = shapes.rod(radius, float(np.linalg.norm(b - a)))
    return Body(name, mesh, frame(b - a), a, COLOURS[colour], 0.35)


def _pin(name: str, at: FloatArray, axis: FloatArray, radius: float, half: float, c: str) -> Body:
    mesh = shapes.cylinder(radius, -half, half, 20, chamfer=0.15 * radius)
    return Body(name, mesh, frame(axis), at, COLOURS[c], 0.3)


def _bar(
    name: str, a: FloatArray, b: FloatArray, side: FloatArray, ends: tuple[float, float], c: str
) -> Body:
    mesh = shapes.bar(float(np.linalg.norm(b - a)), *ends, thickness=0.020)
    return Body(name, mesh, frame(side, b - a), a, COLOURS[c], 0.2)


def delta_bodies(scene: Scene) -> Iterator[Body]:
    """The Delta: base plate with motors, proximal arms, parallelogram forearms, effector, peg."""
    radius = float(np.linalg.norm(scene.delta_base_joints[0, :2]))
    base = scene.delta_base_joints[0, 2]
    eye = np.eye(3)
    slab = shapes.plate(0.78 * radius, 0.052, 0.014)
    yield Body(
        "delta/base", slab, eye, np.array([0.0, 0.0, base + 0.030]), COLOURS["delta_base"], 0.1
    )
    for limb in range(3):
        u, t = radial_axes(limb)
        joint, knee = scene.delta_base_joints[limb], scene.knees[limb]
        end = scene.effector_joints[limb]
        name = f"delta/limb{limb}"
        post = shapes.box(0.020, 0.017, 0.04)
        yield Body(f"{name}/mount", post, frame(_UP, u), joint + 0.012 * _UP, COLOURS["housing"])
        yield _pin(f"{name}/motor", joint, t, 0.021, 0.032, "housing")
        yield _bar(f"{name}/proximal", joint, knee, t, (0.017, 0.010), "delta")
        for at, part in ((knee, "knee"), (end, "wrist")):
            yield _pin(f"{name}/{part}", at, t, 0.0055, _ROD_SPACING + 0.004, "steel")
        for sign in (-1.0, 1.0):
            shift = sign * _ROD_SPACING * t
            side = "left" if sign < 0.0 else "right"
            yield _rod(f"{name}/{side}", knee + shift, end + shift, 0.0042, "forearm")
            for at, part in ((knee, "ball"), (end, "socket")):
                yield Body(
                    f"{name}/{side}_{part}", shapes.sphere(0.0072), eye, at + shift,
                    COLOURS["steel"], 0.4,
                )  # fmt: skip
    joint_radius = float(np.linalg.norm((scene.effector_joints[0] - scene.effector)[:2]))
    disc = shapes.plate(joint_radius - 0.008, 0.016, 0.012)
    yield Body("delta/effector", disc, eye, scene.effector, COLOURS["delta"], 0.25)
    yield from _peg_bodies(scene)


def _peg_bodies(scene: Scene) -> Iterator[Body]:
    length = float(np.linalg.norm(scene.effector - scene.tip))
    r = scene.peg_radius
    eye = np.eye(3)
    chuck = shapes.revolve(
        ((0.0, -0.022), (0.007, -0.022), (0.013, -0.006), (0.013, 0.014), (0.0, 0.014))
    )
    yield Body("delta/chuck", chuck, eye, scene.effector, COLOURS["housing"], 0.3)
    peg = shapes.revolve(
        ((0.0, 0.0), (0.55 * r, 0.0), (r, 0.8 * r), (r, length), (0.0, length)), 20
    )
    yield Body("delta/peg", peg, eye, scene.tip, COLOURS["peg"], 0.4)


def rrs_bodies(scene: Scene) -> Iterator[Body]:
    """The 3-RRS: base plate, proximal and distal links with their joints, platform, dome."""
    radius = float(np.linalg.norm(scene.rrs_base_joints[0, :2]))
    eye = np.eye(3)
    ground = shapes.cylinder(radius + 0.032, -0.024, -0.012, 72, chamfer=0.002)
    yield Body("rrs/base", ground, eye, np.zeros(3), COLOURS["rrs_base"], 0.1)
    for limb in range(3):
        u, t = radial_axes(limb)
        base, elbow = scene.rrs_base_joints[limb], scene.elbows[limb]
        joint = scene.platform_joints[limb]
        name = f"rrs/limb{limb}"
        foot = shapes.box(0.018, 0.024, 0.012)
        yield Body(f"{name}/foot", foot, frame(_UP, u), base - 0.008 * _UP, COLOURS["housing"])
        yield _pin(f"{name}/motor", base, t, 0.0125, 0.024, "housing")
        yield _bar(f"{name}/proximal", base, elbow, t, (0.013, 0.0095), "rrs")
        yield _pin(f"{name}/elbow", elbow, t, 0.0065, 0.015, "steel")
        yield _rod(f"{name}/distal", elbow, joint, 0.0062, "distal")
        yield Body(f"{name}/ball", shapes.sphere(0.0105, 20), eye, joint, COLOURS["steel"], 0.5)
    reach = float(np.linalg.norm(scene.platform_joints[0] - scene.platform_centre))
    turn, centre = scene.platform_rotation, scene.platform_centre
    disc = shapes.cylinder(reach - 0.004, -0.005, 0.004, 72, chamfer=0.001)
    yield Body("rrs/platform", disc, turn, centre, COLOURS["platform"], 0.15)
    dome = shapes.cap(scene.dome_radius, 0.0, math.pi / 2.0, 20, 72)
    yield Body("rrs/dome", dome, turn, centre, COLOURS["dome"], 0.12)


def hole_state(scene: Scene, index: int) -> str:
    """``"filled"``, ``"target"``, ``"open"`` or ``"inactive"`` (not part of this stage)."""
    if scene.filled[index]:
        return "filled"
    if not scene.active[index]:
        return "inactive"
    return "target" if index == scene.target and scene.status == "running" else "open"


def hole_bodies(scene: Scene) -> Iterator[Body]:
    """Per hole a dark bore within a ring coloured by its state, and a plug where it is filled.

    An arrow along the target's normal shows where the peg must come from.
    """
    radius = scene.dome_radius
    inner, outer = _BORE / radius, max(scene.chamfer, _BORE + _RING) / radius
    for index, normal in enumerate(scene.hole_normals):
        state = hole_state(scene, index)
        turn, centre = frame(normal), scene.platform_centre
        ring = shapes.cap(radius + _LIFT, inner, outer, 3, 28)
        yield Body(f"holes/{index}/ring", ring, turn, centre, COLOURS[state], 0.1)
        bore = shapes.cap(radius + _LIFT, 0.0, inner, 2, 28)
        yield Body(f"holes/{index}/bore", bore, turn, centre, COLOURS["bore"], 0.0)
        if state == "filled":
            plug = shapes.cylinder(0.85 * _BORE, 0.0, 0.011, 20, chamfer=0.001)
            yield Body(
                f"holes/{index}/plug", plug, turn, scene.hole_mouths[index], COLOURS["filled"]
            )
        elif state == "target":
            # beyond the peg's way in, so that it never hides the tip
            start = scene.hole_mouths[index] + 0.012 * normal
            mesh = shapes.arrow(0.055, 0.0017)
            yield Body("holes/normal", mesh, turn, start, COLOURS["target"], 0.0, shines=True)


def trace_bodies(trace: FloatArray) -> Iterator[Body]:
    """The way of the tip, (n, 3) m, as a thin tube; nothing for fewer than two points."""
    for i in range(len(trace) - 1):
        a, b = trace[i], trace[i + 1]
        if float(np.linalg.norm(b - a)) > 1e-6:
            mesh = shapes.rod(0.0013, float(np.linalg.norm(b - a)), 6)
            yield Body(f"trace/{i}", mesh, frame(b - a), a, COLOURS["trace"], 0.0, shines=True)


def bodies(scene: Scene, trace: FloatArray | None = None) -> list[Body]:
    """Everything there is to draw."""
    parts = [*delta_bodies(scene), *rrs_bodies(scene), *hole_bodies(scene)]
    if trace is not None:
        parts.extend(trace_bodies(trace))
    return parts
