"""The solids of a scene: every visible part of both robots as a mesh with a pose and a colour.

Pictures, the browser view and exports draw the same list. Meshes come out of a cache, so from one
move to the next only poses and the holes' colours change. Sizes that the kinematics do not give
(thicknesses, plates, housings) are for the eye; ``coop_env.simulation.collision`` has its own.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Final

import numpy as np
from matplotlib.colors import to_rgb

from coop_env.physics.joints import RADIAL, TANGENTIAL, UP
from coop_env.rendering import shapes
from coop_env.rendering.scene import Scene
from coop_env.rendering.shapes import FloatArray, Mesh

Colour = tuple[float, float, float]
_UPRIGHT: Final = np.eye(3)

COLOURS: Final = MappingProxyType(
    {
        "delta": to_rgb("#2f6fb0"),
        "delta_base": to_rgb("#c9d1da"),
        "forearm": to_rgb("#4a5563"),
        "housing": to_rgb("#39424e"),
        "steel": to_rgb("#a9b2bd"),
        "peg": to_rgb("#c0392b"),
        "rrs": to_rgb("#d98a29"),
        "rrs_base": to_rgb("#9aa5b1"),
        "distal": to_rgb("#4a5563"),
        "platform": to_rgb("#5f6b7a"),
        "dome": to_rgb("#e2dccf"),
        "bore": to_rgb("#20252c"),
        "open": to_rgb("#3f86d6"),
        "target": to_rgb("#f39200"),
        "filled": to_rgb("#2aa35a"),
        "inactive": to_rgb("#b4b4b0"),
        "trace": to_rgb("#d1457b"),
    }
)
"""Display colours (sRGB, 0 to 1) by meaning."""

SIDES: Final = MappingProxyType({"left": -1.0, "right": 1.0})  # of the limb's plane, of the rods
ROD_SPACING: Final = 0.017  # half the distance between a forearm's two rods, m
_BORE: Final = 1.375  # radius of a drawn hole over the peg's
_RING: Final = 0.003  # least width of the ring about it, m
_LIFT: Final = 0.0006  # marks stand this proud of the dome, m


def pixels(colour: Colour) -> tuple[int, int, int]:
    """A display colour as bytes."""
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue


@dataclass(frozen=True, slots=True)
class Body:
    """A mesh placed in the world: point = rotation @ vertex + position.

    ``name`` is the rigid link's, a slash, and the part's own: the same from scene to scene. A part
    that ``shines`` is drawn without shading.
    """

    name: str
    mesh: Mesh
    rotation: FloatArray
    position: FloatArray
    colour: Colour
    gloss: float = 0.15
    shines: bool = False


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
    slab = shapes.plate(0.78 * radius, 0.052, 0.014)
    above = np.array([0.0, 0.0, scene.delta_base_joints[0, 2] + 0.030])
    yield Body("delta_base/plate", slab, _UPRIGHT, above, COLOURS["delta_base"], 0.1)
    for limb in range(3):
        u, t = RADIAL[limb], TANGENTIAL[limb]
        joint, knee = scene.delta_base_joints[limb], scene.knees[limb]
        end = scene.effector_joints[limb]
        post, mount = shapes.box(0.020, 0.017, 0.04), f"delta_base/mount{limb}"
        yield Body(mount, post, frame(UP, u), joint + 0.012 * UP, COLOURS["housing"])
        yield _pin(f"delta_base/motor{limb}", joint, t, 0.021, 0.032, "housing")
        arm = f"delta_proximal{limb}"
        yield _bar(f"{arm}/bar", joint, knee, t, (0.017, 0.010), "delta")
        for at, name in ((knee, f"{arm}/knee"), (end, f"effector/wrist{limb}")):
            yield _pin(name, at, t, 0.0055, ROD_SPACING + 0.004, "steel")
        for side, sign in SIDES.items():
            shift, rod = sign * ROD_SPACING * t, f"delta_rod{limb}_{side}"
            yield _rod(f"{rod}/rod", knee + shift, end + shift, 0.0042, "forearm")
            ball = shapes.sphere(0.0072)
            for at, part in ((knee, "ball"), (end, "socket")):
                yield Body(f"{rod}/{part}", ball, _UPRIGHT, at + shift, COLOURS["steel"], 0.4)
    joint_radius = float(np.linalg.norm((scene.effector_joints[0] - scene.effector)[:2]))
    disc = shapes.plate(joint_radius - 0.008, 0.016, 0.012)
    yield Body("effector/plate", disc, _UPRIGHT, scene.effector, COLOURS["delta"], 0.25)
    profile = ((0.0, -0.022), (0.007, -0.022), (0.013, -0.006), (0.013, 0.014), (0.0, 0.014))
    chuck = shapes.revolve(profile)
    yield Body("effector/chuck", chuck, _UPRIGHT, scene.effector, COLOURS["housing"], 0.3)
    r, length = scene.peg_radius, float(np.linalg.norm(scene.effector - scene.tip))
    profile = ((0.0, 0.0), (0.55 * r, 0.0), (r, 0.8 * r), (r, length), (0.0, length))
    yield Body(
        "effector/peg", shapes.revolve(profile, 20), _UPRIGHT, scene.tip, COLOURS["peg"], 0.4
    )


def rrs_bodies(scene: Scene) -> Iterator[Body]:
    """The 3-RRS: base plate, proximal and distal links with their joints, platform, dome."""
    radius = float(np.linalg.norm(scene.rrs_base_joints[0, :2]))
    ground = shapes.cylinder(radius + 0.032, -0.024, -0.012, 72, chamfer=0.002)
    yield Body("rrs_base/plate", ground, _UPRIGHT, np.zeros(3), COLOURS["rrs_base"], 0.1)
    for limb in range(3):
        u, t = RADIAL[limb], TANGENTIAL[limb]
        base, elbow = scene.rrs_base_joints[limb], scene.elbows[limb]
        joint = scene.platform_joints[limb]
        block, foot = shapes.box(0.018, 0.024, 0.012), f"rrs_base/foot{limb}"
        yield Body(foot, block, frame(UP, u), base - 0.008 * UP, COLOURS["housing"])
        yield _pin(f"rrs_base/motor{limb}", base, t, 0.0125, 0.024, "housing")
        near, far = f"rrs_proximal{limb}", f"rrs_distal{limb}"
        yield _bar(f"{near}/bar", base, elbow, t, (0.013, 0.0095), "rrs")
        yield _pin(f"{near}/elbow", elbow, t, 0.0065, 0.015, "steel")
        yield _rod(f"{far}/rod", elbow, joint, 0.0062, "distal")
        yield Body(f"{far}/ball", shapes.sphere(0.0105, 20), _UPRIGHT, joint, COLOURS["steel"], 0.5)
    reach = float(np.linalg.norm(scene.platform_joints[0] - scene.platform_centre))
    turn, centre = scene.platform_rotation, scene.platform_centre
    disc = shapes.cylinder(reach - 0.004, -0.005, 0.004, 72, chamfer=0.001)
    yield Body("platform/plate", disc, turn, centre, COLOURS["platform"], 0.15)
    dome = shapes.cap(scene.dome_radius, 0.0, math.pi / 2.0, 20, 72)
    yield Body("platform/dome", dome, turn, centre, COLOURS["dome"], 0.12)


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
    radius, hole = scene.dome_radius, _BORE * scene.peg_radius
    inner, outer = hole / radius, max(scene.chamfer, hole + _RING) / radius
    for index, normal in enumerate(scene.hole_normals):
        state = hole_state(scene, index)
        turn, centre = frame(normal), scene.platform_centre
        ring = shapes.cap(radius + _LIFT, inner, outer, 3, 28)
        yield Body(f"platform/ring{index}", ring, turn, centre, COLOURS[state], 0.1)
        bore = shapes.cap(radius + _LIFT, 0.0, inner, 2, 28)
        yield Body(f"platform/bore{index}", bore, turn, centre, COLOURS["bore"], 0.0)
        if state == "filled":
            plug = shapes.cylinder(0.85 * hole, 0.0, 0.011, 20, chamfer=0.001)
            at, name = scene.hole_mouths[index], f"platform/plug{index}"
            yield Body(name, plug, turn, at, COLOURS["filled"])
        elif state == "target":
            # 12 mm above the mouth, so that the arrow never hides a tip that enters
            start = scene.hole_mouths[index] + 0.012 * normal
            mesh = shapes.arrow(0.055, 0.0017)
            yield Body("target/normal", mesh, turn, start, COLOURS["target"], 0.0, shines=True)


def trace_bodies(scene: Scene) -> Iterator[Body]:
    """The way of the tip as a thin tube."""
    for i, (a, b) in enumerate(pairwise(scene.trace)):
        if (length := float(np.linalg.norm(b - a))) > 1e-6:
            mesh = shapes.rod(0.0013, length, 6)
            yield Body(f"trace/{i}", mesh, frame(b - a), a, COLOURS["trace"], 0.0, shines=True)


def bodies(scene: Scene) -> list[Body]:
    """Everything there is to draw."""
    parts = (delta_bodies, rrs_bodies, hole_bodies, trace_bodies)
    return [body for part in parts for body in part(scene)]
