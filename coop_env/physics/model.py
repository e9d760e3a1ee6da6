"""The MJCF of both robots, the dome and the peg, written from the same geometry as the kinematics.

World frame: where the 3-RRS's base is believed to stand, z up. Every hinge has the analytic angle
as its coordinate, because the bodies are drawn at home and ``ref`` says which angle that is.
:mod:`~coop_env.physics.model_folder` says where each number comes from.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from scipy.spatial import ConvexHull

from coop_env.errors import ArgumentError, check_flag, check_list, check_number
from coop_env.geometry import DELTA, OPTIMIZED, DeltaGeometry, GeometryError, RRSGeometry
from coop_env.kinematics import delta as delta_kinematics
from coop_env.physics.dome import Bore, dome_solids
from coop_env.physics.joints import (
    RADIAL,
    TANGENTIAL,
    UP,
    Floats,
    TreeAngles,
    platform_mount,
    tree_angles,
)
from coop_env.simulation import rewards
from coop_env.simulation.insertion_task import PAPER_TASK, InsertionTask
from coop_env.simulation.task import EnvParams, make_params

TIP_SHAPES: Final = ("flat", "capsule")
TIMESTEP: Final = 0.002
"""s, unless the task asks for another."""
CONTACT_TIME: Final = 0.005
"""Time constant of a contact, a critically damped spring, s. It sets the forces."""
DELTA_RANGE: Final = (-math.pi, math.pi)
"""Range of the Delta's actuated angles, wider than any Delta's workspace; rad."""
LOOP_TIME: Final = 0.004
"""Time constant of the ties that close loops, s; the least that TIMESTEP allows."""
_PLAY_DAMPING: Final = 0.005  # of the effector's tilt within its play, N m s/rad
_DELTA_BITS: Final = {"contype": 1, "conaffinity": 0}  # the Delta's bodies touch the 3-RRS's alone
_RRS_BITS: Final = {"contype": 0, "conaffinity": 1}


@dataclass(frozen=True, slots=True)
class Servos:
    """Position servos and masses; SI units.

    Attributes:
        rrs_stiffness: kp of the 3-RRS, N m/rad; a soft one jumps its assembly mode.
        delta_stiffness: kp of the Delta, the compliant one, N m/rad.
        damping_time: kv = 2 sqrt(damping_time kp), kg m^2.
        torque_limit: of each servo, N m.
        armature: rotor inertia at each actuated joint, kg m^2.
        gravity_compensation: whether the links' weight is carried for the servos.
        rrs_masses: proximal link, distal link, platform with its dome, kg.
        delta_masses: proximal link, rod, effector, peg, kg.

    Raises:
        ArgumentError: a value is not finite, not above zero, or of the wrong kind.
    """

    rrs_stiffness: float = 1000.0
    delta_stiffness: float = 50.0
    damping_time: float = 0.02
    torque_limit: float = 10.0
    armature: float = 0.01
    gravity_compensation: bool = True
    rrs_masses: tuple[float, float, float] = (0.15, 0.12, 0.6)
    delta_masses: tuple[float, float, float, float] = (0.15, 0.08, 0.2, 0.03)

    def __post_init__(self) -> None:
        check_flag("Servos.gravity_compensation", self.gravity_compensation)
        positive = ("rrs_stiffness", "delta_stiffness", "damping_time", "torque_limit", "armature")
        for name in positive:
            check_number(f"Servos.{name}", getattr(self, name), 0.0, 1e6, above=True)
        for name, n in (("rrs_masses", 3), ("delta_masses", 4)):
            given = check_list(f"Servos.{name}", getattr(self, name), f"{n} masses", n)
            masses = (
                check_number(f"Servos.{name}[{i}]", mass, 0.0, 1e3, above=True)
                for i, mass in enumerate(given)
            )
            object.__setattr__(self, name, tuple(masses))

    @property
    def gains(self) -> tuple[Floats, Floats]:
        """kp, N m/rad, and kv, N m s/rad, of the six servos (6,), the Delta's first."""
        stiffness = np.repeat([self.delta_stiffness, self.rrs_stiffness], 3)
        damping = [2.0 * (self.damping_time * kp) ** 0.5 for kp in stiffness.tolist()]
        return stiffness, np.array(damping)


@dataclass(frozen=True, slots=True)
class Peg:
    """Fit of the peg in its holes; lengths in m.

    Attributes:
        clearance: radius of a bore, to its flats, minus the peg's.
        chamfer: width and depth of a bore's lead-in.
        depth: of a bore, the thickness of the dome's shell.
        tip: ``"flat"``, or ``"capsule"``, the kinematic task's round one.
        friction: Coulomb coefficient of the peg on the dome; episodes draw theirs.

    Raises:
        ArgumentError: a value is out of its range.
    """

    clearance: float = 0.0005
    chamfer: float = 0.001
    depth: float = 0.02
    tip: str = "flat"
    friction: float = 0.2

    def __post_init__(self) -> None:
        check_number("Peg.clearance", self.clearance, 0.0, 0.01, above=True)
        check_number("Peg.depth", self.depth, 0.0, 0.1, above=True)
        check_number("Peg.chamfer", self.chamfer, 0.0, self.depth / 2.0, above=True)
        check_number("Peg.friction", self.friction, 0.0, 2.0, above=True)
        if self.tip not in TIP_SHAPES:
            raise ArgumentError(f"Peg.tip = {self.tip!r}: must be one of {list(TIP_SHAPES)}")


@dataclass(frozen=True, slots=True)
class Machine:
    """All that the model is written from.

    ``timestep`` and ``contact_time`` in s; the Delta's effector may tilt about x and y by
    ``effector_play``, rad, to both sides.
    """

    rrs: RRSGeometry = OPTIMIZED
    delta: DeltaGeometry = DELTA
    task: InsertionTask = PAPER_TASK
    servos: Servos = Servos()
    peg: Peg = Peg()
    timestep: float = TIMESTEP
    contact_time: float = CONTACT_TIME
    effector_play: float = 0.0

    @property
    def bore(self) -> Bore:
        radius = self.delta.peg_radius + self.peg.clearance
        return Bore(radius, self.peg.chamfer, self.peg.depth)

    def kernel_params(self) -> EnvParams:
        """The same machine as the kinematic kernels take it.

        Raises:
            GeometryError: the 3-RRS cannot take its home pose.
        """
        reward = rewards.make_reward("progress", None)
        return make_params(self.rrs, reward, delta=self.delta, task=self.task)

    def home(self) -> Floats:
        """(6,): both robots upright, the peg's tip at its mean start height above the dome.

        Raises:
            GeometryError: a robot cannot be assembled there.
        """
        self.kernel_params()  # its error says what is wrong with the 3-RRS
        height = (
            self.rrs.home_heave + self.task.dome_radius + float(np.mean(self.task.start_clearance))
        )
        z = height + self.delta.peg_length - self.delta.base_height
        if not delta_kinematics.is_valid([0.0, 0.0, z], self.delta):
            raise GeometryError(
                f"the Delta cannot hold the peg {height:.3g} m above the 3-RRS's base: choose "
                "other lengths or another base_height"
            )
        return np.array([0.0, 0.0, z, 0.0, 0.0, self.rrs.home_heave])


def _add(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    texts = {}
    for name, value in attributes.items():
        if isinstance(value, (list, tuple, np.ndarray)):
            value = " ".join(f"{v:.12g}" for v in np.ravel(np.asarray(value, np.float64)))
        elif isinstance(value, float):
            value = f"{value:.12g}"
        texts[name] = str(value)
    return ET.SubElement(parent, tag, texts)


def build_mjcf(machine: Machine) -> ET.Element:
    """The model as MJCF.

    Raises:
        GeometryError: a robot cannot be assembled at home.
        ArgumentError: the holes do not fit the dome.
    """
    home = machine.home()
    angles = tree_angles(home, machine.rrs, machine.delta)
    root = ET.Element("mujoco", model="coop_insertion")
    _add(root, "compiler", angle="radian", autolimits="true")
    option = _add(
        root, "option", timestep=machine.timestep, integrator="implicitfast", solver="Newton",
        cone="elliptic", impratio=5, ccd_tolerance=1e-8, ccd_iterations=100,
    )  # fmt: skip
    # with the default ccd_tolerance a peg sliding over two staves may seem to be 3 mm deep in one
    # divergence must show; islands cost more than they save here
    _add(option, "flag", autoreset="disable", island="disable")
    default = _add(root, "default")
    _add(
        default, "geom", solref=[machine.contact_time, 1.0], solimp=[0.95, 0.99, 0.0002], condim=3,
        friction=[machine.peg.friction, 0.005, 0.0001], contype=0, conaffinity=0,
    )  # fmt: skip
    _add(default, "equality", solref=[LOOP_TIME, 1.0], solimp=[0.99, 0.999, 0.0001])
    asset, world = _add(root, "asset"), _add(root, "worldbody")
    _add(world, "light", pos=[0.5, -0.8, 1.6], dir=[-0.3, 0.5, -1.0])
    _add_rrs(world, asset, machine, angles)
    _add_delta(world, machine, angles, home)
    equality = _add(root, "equality")
    for tie in ("rrs_{}1", "rrs_{}2", "delta_{}0", "delta_{}1", "delta_{}2"):
        _add(equality, "connect", site1=tie.format("end"), site2=tie.format("socket"))
    _add_servos(root, machine, [*angles.theta, *angles.q])
    _add_sensors(root)
    _add(_add(root, "keyframe"), "key", name="home")
    return root


def _add_servos(root: ET.Element, m: Machine, at_home: list[float]) -> None:
    """Add the servos; commands count from home, so that a model opened with zeros stands still."""
    actuator, limit = _add(root, "actuator"), m.servos.torque_limit
    kp, kv = m.servos.gains
    for k, (robot, i) in enumerate(product(("delta", "rrs"), range(3))):
        low, high = DELTA_RANGE if robot == "delta" else (m.rrs.joint_min, m.rrs.joint_max)
        _add(
            actuator, "general", name=f"{robot}_servo{i}", joint=f"{robot}_joint{i}",
            gainprm=kp[k], biastype="affine", biasprm=[kp[k] * at_home[k], -kp[k], -kv[k]],
            ctrlrange=[low - at_home[k], high - at_home[k]], forcerange=[-limit, limit],
        )  # fmt: skip


def _add_sensors(root: ET.Element) -> None:
    sensor = _add(root, "sensor")
    _add(sensor, "force", name="force", site="tip")
    _add(sensor, "torque", name="moment", site="tip")
    for robot, i in product(("delta", "rrs"), range(3)):
        _add(sensor, "jointpos", name=f"{robot}_angle{i}", joint=f"{robot}_joint{i}")
    for name, kind in (("tip", "site"), ("platform", "xbody")):
        _add(sensor, "framepos", name=f"{name}_position", objtype=kind, objname=name)
    body = {"objtype": "xbody", "objname": "platform"}
    for axis in "xyz":
        _add(sensor, f"frame{axis}axis", name=f"platform_{axis}", **body)


def _body(parent: ET.Element, name: str, machine: Machine, **attributes: object) -> ET.Element:
    carried = int(machine.servos.gravity_compensation)
    return _add(parent, "body", name=name, gravcomp=carried, **attributes)


def _link(body: ET.Element, length: float, radius: float, mass: float, **bits: object) -> None:
    """A rod along the body's x axis."""
    _add(body, "geom", type="capsule", fromto=[0.0, 0.0, 0.0, length, 0.0, 0.0], size=radius,
         mass=mass, **bits)  # fmt: skip


def _hinge(body: ET.Element, name: str, axis: Sequence[int], ref: float, **more: object) -> None:
    _add(body, "joint", name=name, type="hinge", axis=axis, ref=ref, **more)


def _crank(
    base: ET.Element, robot: str, limb: int, m: Machine, radius: float, angle: float,
    limits: tuple[float, float],
) -> ET.Element:  # fmt: skip
    """A proximal link on its motor; the 3-RRS's angles turn it up, the Delta's down."""
    up = 1 if robot == "rrs" else -1
    x = np.cos(angle) * RADIAL[limb] + up * np.sin(angle) * UP
    link = _body(
        base, f"{robot}_proximal{limb}", m, pos=radius * RADIAL[limb],
        xyaxes=[*x, *TANGENTIAL[limb]],
    )  # fmt: skip
    more = {"armature": m.servos.armature, "range": limits}
    _hinge(link, f"{robot}_joint{limb}", (0, -up, 0), angle, **more)
    return link


def _at_end(link: ET.Element, name: str, m: Machine, length: float, turn: float) -> ET.Element:
    """The next body in a limb's plane, turned up from the link before."""
    axes = [np.cos(turn), 0.0, np.sin(turn), 0.0, 1.0, 0.0]
    return _body(link, name, m, pos=[length, 0.0, 0.0], xyaxes=axes)


def _add_rrs(world: ET.Element, asset: ET.Element, m: Machine, angles: TreeAngles) -> None:
    g, radius, (proximal, distal, platform) = m.rrs, m.task.limb_radius, m.servos.rrs_masses
    base = _body(world, "rrs_base", m)
    _add(base, "geom", type="cylinder", size=[g.base_radius, 0.004], pos=[0.0, 0.0, -0.02])
    for i in range(3):
        link = _crank(base, "rrs", i, m, g.base_radius, angles.q[i], (g.joint_min, g.joint_max))
        _link(link, g.proximal_length, radius, proximal, **_RRS_BITS)
        end = _at_end(link, f"rrs_distal{i}", m, g.proximal_length, angles.elbow[i])
        _hinge(end, f"rrs_elbow{i}", (0, -1, 0), angles.elbow[i])
        _link(end, g.distal_length, radius, distal, **_RRS_BITS)
        if i:
            _add(end, "site", name=f"rrs_end{i}", pos=[g.distal_length, 0.0, 0.0])
        else:
            _add_platform(end, asset, m, platform, platform_mount(angles).T)


def _add_platform(
    limb: ET.Element, asset: ET.Element, m: Machine, mass: float, turn: Floats
) -> None:
    """Platform and dome on the end of limb 0; ``turn`` is their rotation in its frame at home."""
    g = m.rrs
    ball = [g.platform_radius, 0.0, 0.0]
    body = _body(
        limb, "platform", m, pos=[g.distal_length, 0.0, 0.0] - turn @ ball,
        xyaxes=[*turn[:, 0], *turn[:, 1]],
    )  # fmt: skip
    _add(body, "joint", name="platform_ball", type="ball", pos=ball)
    for i in range(1, 3):
        _add(body, "site", name=f"rrs_socket{i}", pos=g.platform_radius * RADIAL[i])
    solids = dict(dome_solids(m.task, m.bore))
    volumes = {name: float(ConvexHull(vertices).volume) for name, vertices in solids.items()}
    disc = math.pi * g.platform_radius**2 * 2.0 * m.task.spoke_radius
    density = mass / (disc + sum(volumes.values()))  # plate and dome are of one material
    _add(body, "geom", name="platform_disc", type="cylinder", mass=density * disc,
         size=[g.platform_radius, m.task.spoke_radius], **_RRS_BITS)  # fmt: skip
    for name, vertices in solids.items():
        _add(asset, "mesh", name=name, vertex=vertices)
        _add(body, "geom", name=name, type="mesh", mesh=name, mass=density * volumes[name],
             **_RRS_BITS)  # fmt: skip


def _add_delta(world: ET.Element, m: Machine, angles: TreeAngles, home: Floats) -> None:
    d, radius = m.delta, m.task.forearm_radius
    proximal, rod, effector, peg = m.servos.delta_masses
    base = _body(world, "delta_base", m, pos=d.base_height * UP)
    _add(base, "geom", type="cylinder", size=[d.base_radius, 0.004], pos=[0.0, 0.0, 0.02])
    for i in range(3):
        link = _crank(base, "delta", i, m, d.base_radius, angles.theta[i], DELTA_RANGE)
        _link(link, d.proximal_length, radius, proximal)
        end = _at_end(link, f"delta_rod{i}", m, d.proximal_length, -angles.swing[i])
        _hinge(end, f"delta_swing{i}", (0, 1, 0), angles.swing[i])
        _hinge(end, f"delta_sway{i}", (0, 0, 1), angles.sway[i])
        _link(end, d.distal_length, radius, rod, **_DELTA_BITS)
        _add(end, "site", name=f"delta_end{i}", pos=[d.distal_length, 0.0, 0.0])
    body = _body(base, "effector", m, pos=home[:3])
    for axis, name, at_home in zip(np.eye(3), "xyz", home[:3], strict=True):
        _add(body, "joint", name=f"effector_{name}", type="slide", axis=axis, ref=at_home)
    if m.effector_play > 0.0:
        for axis, name in zip(np.eye(3), "xy", strict=False):
            _add(body, "joint", name=f"effector_play_{name}", type="hinge", axis=axis,
                 range=[-m.effector_play, m.effector_play], damping=_PLAY_DAMPING,
                 solreflimit=[LOOP_TIME, 1.0])  # fmt: skip
    _add(body, "geom", type="sphere", size=m.task.effector_radius, mass=effector, **_DELTA_BITS)
    for i in range(3):
        _add(body, "site", name=f"delta_socket{i}", pos=d.effector_radius * RADIAL[i])
    _add_peg(body, m, peg)


def _add_peg(effector: ET.Element, m: Machine, mass: float) -> None:
    """Add the peg, fixed to the effector but a body of its own: forces between both are sensed."""
    length, radius = m.delta.peg_length, m.delta.peg_radius
    body = _body(effector, "peg", m)
    end = radius if m.peg.tip == "capsule" else 0.0
    _add(
        body, "geom", name="peg", type="capsule" if end else "cylinder", size=radius, mass=mass,
        fromto=[0.0, 0.0, 0.0, 0.0, 0.0, end - length], priority=1, **_DELTA_BITS,
    )  # fmt: skip
    _add(body, "site", name="tip", pos=[0.0, 0.0, -length], size=0.001)


def to_xml(root: ET.Element) -> str:
    """XML with its indents, as text."""
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"
