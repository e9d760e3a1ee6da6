"""The MJCF: what is in it, its folder, and machines that cannot be."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from coop_env import InsertionTask
from coop_env.errors import ArgumentError
from coop_env.geometry import DeltaGeometry, GeometryError, RRSGeometry
from coop_env.physics.dome import Bore, dome_solids, staves
from coop_env.physics.model import Machine, Peg, Servos
from coop_env.physics.model_folder import MODEL, README, describe, rows, save_model
from coop_env.physics.twin import Twin, make_model
from coop_env.simulation.insertion_task import PAPER_TASK

BORE = Bore(radius=0.0045, chamfer=0.001, depth=0.02)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    result = tmp_path_factory.mktemp("new") / "model"
    save_model(Machine(), result)
    return result


@pytest.fixture(scope="module")
def opened(folder: Path) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(folder / MODEL))


def test_the_folder_opens_assembled_at_home(folder: Path, opened: mujoco.MjModel) -> None:
    machine, data = Machine(), mujoco.MjData(opened)
    assert (opened.nv, opened.nu, opened.neq) == (21, 6, 5)
    mujoco.mj_forward(opened, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-9
    assert data.qpos == pytest.approx(Twin(machine).joint_positions(machine.home()), abs=1e-9)
    text = (folder / README).read_text("utf-8")
    for name, value, origin in rows(machine):
        assert f"| {name} | {value} | {origin} |" in text


def test_opened_in_a_viewer_it_stands_still(opened: mujoco.MjModel) -> None:
    """A viewer steps what it has loaded, with all commands at zero, or the keyframe: the same."""
    data, key = mujoco.MjData(opened), opened.key("home")
    for part, of_key in ((data.qpos, key.qpos), (data.qvel, key.qvel), (data.ctrl, key.ctrl)):
        assert np.array_equal(part, of_key)
    mujoco.mj_forward(opened, data)
    before, height = data.qpos.copy(), data.body("platform").xpos[2]
    for _ in range(round(10.0 / opened.opt.timestep)):
        mujoco.mj_step(opened, data)
    assert data.qpos == pytest.approx(before, abs=1e-6)
    assert data.body("platform").xpos[2] == pytest.approx(height, abs=1e-6)


def test_servos_and_their_joints_have_ranges_around_home(opened: mujoco.MjModel) -> None:
    g = Machine().rrs
    joints = opened.actuator_trnid[:, 0]
    spans, home = opened.jnt_range[joints], opened.qpos0[opened.jnt_qposadr[joints]]
    assert opened.actuator_ctrllimited.all()
    assert opened.jnt_limited[joints].all()
    assert ((spans[:, 0] < home) & (home < spans[:, 1])).all()
    assert opened.actuator_ctrlrange + home[:, None] == pytest.approx(spans)
    assert opened.joint("rrs_joint1").range == pytest.approx([g.joint_min, g.joint_max])


def test_a_new_twin_reads_where_it_stands() -> None:
    twin = Twin(Machine(servos=Servos(gravity_compensation=False)))
    first = twin.readings()
    placed = twin.place(0, twin.machine.home())
    np.testing.assert_array_equal(first.joints[0], placed.joints)
    np.testing.assert_array_equal(first.tip[0], placed.tip)


def test_the_peg_meets_the_platforms_disc(opened: mujoco.MjModel) -> None:
    data = mujoco.MjData(opened)
    disc, peg = opened.geom("platform_disc").id, opened.geom("peg").id
    x, z = (opened.joint(f"effector_{axis}").qposadr[0] for axis in "xz")
    mujoco.mj_forward(opened, data)
    data.qpos[z] += data.body("platform").xpos[2] - data.site("tip").xpos[2]
    data.qpos[x] += 0.107  # beside the dome
    mujoco.mj_forward(opened, data)
    assert any({*map(int, pair)} == {disc, peg} for pair in data.contact.geom)


def test_the_platforms_weight_is_plates_and_domes(opened: mujoco.MjModel) -> None:
    m = Machine()
    outer, inner = m.task.dome_radius, m.task.dome_radius - m.peg.depth
    disc = np.pi * m.rrs.platform_radius**2 * 2.0 * m.task.spoke_radius
    dome = 2.0 / 3.0 * np.pi * (outer**3 - inner**3)  # half a shell
    centre = 3.0 / 8.0 * (outer**4 - inner**4) / (outer**3 - inner**3)
    body = opened.body("platform")
    assert body.mass == pytest.approx(m.servos.rrs_masses[2])
    assert body.ipos == pytest.approx([0.0, 0.0, dome * centre / (dome + disc)], abs=2e-3)


@pytest.mark.parametrize("play", [0.0, 0.01])
def test_the_effector_tilts_by_its_play(play: float) -> None:
    """Pushed at its tip, to the side and hard."""
    machine = Machine(effector_play=play)
    model = make_model(machine)
    assert f"{model.nv} degrees of freedom" in describe(machine)
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_forward(model, data)
        at, body = data.site("tip").xpos.copy(), model.body("peg").id
        data.qfrc_applied[:] = 0.0
        mujoco.mj_applyFT(model, data, [2.0, 0.0, 0.0], np.zeros(3), at, body, data.qfrc_applied)
        mujoco.mj_step(model, data)
    lean = np.arccos(min(1.0, data.body("peg").xmat[8]))
    assert lean == pytest.approx(play, abs=1e-3 * (play > 0.0) + 1e-9)


def test_the_dome_is_closed_but_for_its_bores() -> None:
    """Random points in the middle of the shell are in a solid, or in a bore; none in both."""
    rng = np.random.default_rng(0)
    n = rng.normal(size=(20_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n = n[n[:, 2] > 0.1]
    normals = np.array(PAPER_TASK.hole_normals)
    points = 0.088 * n
    off_axis = np.linalg.norm(np.cross(points[:, None], normals), axis=2).min(axis=1)
    solid = np.zeros(len(points), bool)
    for _, vertices in dome_solids(PAPER_TASK, BORE):
        planes = ConvexHull(vertices).equations
        solid |= (points @ planes[:, :3].T + planes[:, 3] < 1e-9).all(axis=1)
    assert solid[off_axis > BORE.radius / np.cos(np.pi / 8) + 1e-6].all()
    assert not solid[off_axis < BORE.radius - 1e-6].any()
    assert (off_axis < BORE.radius).sum() > 50


def test_staves_are_convex_and_have_the_chamfer() -> None:
    for stave in staves(BORE):
        assert len(ConvexHull(stave).vertices) == len(stave)
        radii = np.hypot(stave[:, 0], stave[:, 1]) * np.cos(np.pi / 8)
        assert radii.min() == pytest.approx(BORE.radius)
        assert radii[stave[:, 2] == 0.0].min() == pytest.approx(BORE.radius + BORE.chamfer)


def twin(**parts: Any) -> Twin:
    return Twin(Machine(**parts))


def solids(**task: Any) -> list[Any]:
    return list(dome_solids(InsertionTask(**task), BORE))


WEAK: dict[str, Any] = {"gravity_compensation": False}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: twin(servos=Servos(torque_limit=0.3, **WEAK)), "cannot hold"),
        # its weight lets the platform sink, level
        (lambda: twin(servos=Servos(rrs_stiffness=5.0, **WEAK)), "the platform 12.8 mm"),
        (lambda: twin(rrs=RRSGeometry(0.1778, 0.1024, 0.1114, distal_length=0.1)), "home_heave"),
        (lambda: twin(delta=DeltaGeometry(base_height=2.0)), "base_height"),
        # one hole runs into the other, or onto the rim
        (lambda: twin(task=InsertionTask(holes=((0.3, 0.0), (0.3, 0.1)))), "too near"),
        (lambda: twin(task=InsertionTask(holes=((np.pi / 2, 0.0),))), "too near"),
        (lambda: solids(dome_radius=0.01), "dome_radius"),
        # a bore into the dome's own filling, or bores into each other
        (lambda: solids(dome_radius=0.03, holes=((0.0, 0.0),)), "hole depth 0.02 m"),
        (lambda: Peg(clearance=0.0), "Peg.clearance"),
        (lambda: Peg(chamfer=0.02), "Peg.chamfer"),
        (lambda: Peg(tip="round"), "Peg.tip"),
        (lambda: Servos(rrs_masses=(1.0, 2.0)), r"Servos\.rrs_masses"),  # type: ignore[arg-type]
    ],
)
def test_machines_that_cannot_be(make: Callable[[], Any], message: str) -> None:
    error = GeometryError if message in ("home_heave", "base_height") else ArgumentError
    with pytest.raises(error, match=message):
        make()
    assert Servos(rrs_masses=[0.1, 0.1, 0.5]) == Servos(rrs_masses=(0.1, 0.1, 0.5))  # type: ignore[arg-type]
