"""A model folder as in MuJoCo's Menagerie: the MJCF, and a README that describes it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from coop_env.physics.dome import SPOT_WIDTH
from coop_env.physics.model import DELTA_RANGE, LOOP_TIME, Machine, build_mjcf, to_xml

MODEL: Final = "coop_insertion.xml"
README: Final = "README.md"
ASSUMED: Final = "assumed"
DRAWN: Final = "drawn so; touches nothing"

Row = tuple[str, str, str]


def save_model(machine: Machine, folder: str | Path) -> None:
    """Write the MJCF and its README into a folder, which is made if it is missing.

    Raises:
        GeometryError: a robot cannot be assembled at home.
        ArgumentError: the holes do not fit the dome.
    """
    xml, readme = to_xml(build_mjcf(machine)), describe(machine)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MODEL).write_text(xml, encoding="utf-8")
    (folder / README).write_text(readme, encoding="utf-8")


def describe(machine: Machine) -> str:
    """The README of a machine's model folder, Markdown."""
    lines = [
        "# Delta robot and 3-RRS with a dome of holes",
        "",
        f"`{MODEL}` is a MuJoCo model of both robots, written by `coop_env.physics.model` from the "
        "same dimensions as the kinematics. Units: m, kg, s, rad. World frame: the 3-RRS's base, z "
        "up. Each hinge's coordinate is the analytic joint angle. The model opens at home, as its "
        "keyframe `home` has it, and stands still there: a servo's command counts from home, the "
        "joint's `ref`.",
        "",
        "The platform hangs on the 3-RRS's limb 0 by a ball joint and on the other two by "
        "`connect` equalities between sites; the Delta's effector moves on three slides, tied to "
        "its three rods, each on a universal joint: "
        f"{23 if machine.effector_play > 0.0 else 21} degrees of freedom, six of them actuated "
        "by position servos. The dome is convex in parts: eight staves around each bore, prisms "
        "elsewhere.",
        "",
        "| number | value | origin |",
        "|---|---|---|",
        *(f"| {name} | {value} | {origin} |" for name, value, origin in rows(machine)),
        "",
    ]
    return "\n".join(lines)


def rows(m: Machine) -> Iterator[Row]:
    """Every number of the model: its name, its value and where it comes from."""
    for owner, geometry, names in (
        ("3-RRS", m.rrs, ("base_radius", "proximal_length", "platform_radius", "distal_length")),
        ("Delta", m.delta, ("base_radius", "effector_radius", "proximal_length", "distal_length",
                            "base_height", "peg_length", "peg_radius")),
    ):  # fmt: skip
        for name in names:
            value = f"{getattr(geometry, name):g} m"
            yield f"{owner}, {name}", value, f"`coop_env.geometry.{type(geometry).__name__}`"
    for name in ("dome_radius", "effector_radius", "forearm_radius", "spoke_radius", "limb_radius"):
        yield name, f"{getattr(m.task, name):g} m", "`coop_env.InsertionTask`: collision bodies"
    holes = ", ".join(f"({polar:.4g}, {azimuth:.4g})" for polar, azimuth in m.task.holes)
    yield "holes: polar angle, azimuth", f"{holes} rad", "`coop_env.InsertionTask`"
    yield "bore: flats from the axis", f"{m.bore.radius:g} m", "peg radius and clearance"
    yield "bore: chamfer, depth", f"{m.peg.chamfer:g}, {m.peg.depth:g} m", ASSUMED
    yield "bore: width of the spot face", f"{SPOT_WIDTH:g} m", "a flat peg that misses slides on it"
    yield "peg: tip, friction", f"{m.peg.tip}, {m.peg.friction:g}", ASSUMED
    s = m.servos
    yield "3-RRS: proximal, distal link, platform", _numbers(s.rrs_masses, "kg"), ASSUMED
    yield "Delta: proximal link, rod, effector, peg", _numbers(s.delta_masses, "kg"), ASSUMED
    yield "inertia of the links", "of solid capsules, a disc, a sphere", "the bodies drawn"
    yield "platform's mass", "spread over plate and dome by their volumes", "of one material"
    yield "3-RRS: servo stiffness kp", f"{s.rrs_stiffness:g} N m/rad", ASSUMED
    yield "Delta: servo stiffness kp", f"{s.delta_stiffness:g} N m/rad", ASSUMED
    yield "servo damping kv", f"2 sqrt({s.damping_time:g} kp) N m s/rad", ASSUMED
    yield "torque limit, armature", f"{s.torque_limit:g} N m, {s.armature:g} kg m^2", ASSUMED
    yield "gravity compensation", "on" if s.gravity_compensation else "off", ASSUMED
    low, high = m.rrs.joint_min, m.rrs.joint_max
    yield "3-RRS: range of joints and commands", f"{low:.4g} to {high:.4g} rad", "`RRSGeometry`"
    low, high = DELTA_RANGE
    yield "Delta: range of joints and commands", f"{low:.4g} to {high:.4g} rad", "beyond its reach"
    yield "effector: tilt within its play", f"{m.effector_play:g} rad", "`ContactTask`"
    yield "timestep", f"{m.timestep:g} s, implicitfast, Newton", ASSUMED
    yield (
        "collision tolerance",
        "1e-8 m",
        "with MuJoCo's 1e-6 a peg on two staves is now and then taken for 3 mm deep in one",
    )
    yield "friction cone", "elliptic, impratio 5", f"{ASSUMED}: a pyramid falsifies contact"
    yield "contact solref, solimp", f"{m.contact_time:g} s, 1; .95 .99 .0002", ASSUMED
    yield "equality solref, solimp", f"{LOOP_TIME:g} s, 1; .99 .999 .0001", ASSUMED
    yield "base plates", "discs 8 mm thick", DRAWN


def _numbers(values: tuple[float, ...], unit: str) -> str:
    return ", ".join(f"{value:g}" for value in values) + f" {unit}"
