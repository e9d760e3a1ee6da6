"""Meshes and SDF, loaded back by their libraries and held against MJCF and kinematics."""

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
pytest.importorskip("trimesh", reason="trimesh is not installed (extra trajectory)")

import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coop_env import CoopInsertionEnv, InsertionTask
from coop_env.errors import ArgumentError
from coop_env.exports import links, save_glb, save_sdf, save_stl
from coop_env.geometry import DeltaGeometry, GeometryError
from coop_env.kinematics import delta, rrs
from coop_env.physics.model import Machine
from coop_env.physics.twin import make_model
from coop_env.rendering.bodies import COLOURS, ROD_SPACING, bodies, pixels
from coop_env.rendering.rasterizer import to_linear

OWN = Machine(delta=DeltaGeometry(proximal_length=0.22, distal_length=0.48, base_height=0.9))


def drawn(machine: Machine) -> np.ndarray:
    """All vertices of the renderer's picture at home but for the arrow, world frame, m."""
    env = CoopInsertionEnv(machine.rrs, delta=machine.delta, task=machine.task)
    env.reset(options={"configuration": machine.home()})
    parts = [part for part in bodies(env.scene()) if not part.shines]
    return np.concatenate([p.mesh.vertices @ p.rotation.T + p.position for p in parts])


@pytest.mark.parametrize("machine", [Machine(), OWN])
def test_stl_of_all_links_put_together_is_the_picture(machine: Machine, tmp_path: Path) -> None:
    paths = save_stl(str(tmp_path / "m"), machine)
    assert sorted((tmp_path / "m").iterdir()) == sorted(paths)
    corners = []
    for link in links(machine):
        mesh = trimesh.load_mesh(tmp_path / "m" / f"{link.name}.stl")
        corners.append(mesh.vertices @ link.rotation.T + link.position)
    placed, wanted = np.concatenate(corners), drawn(machine)
    for some, others in ((placed, wanted), (wanted, placed)):  # the same corners, in any order
        assert np.max(cKDTree(others).query(some)[0]) < 1e-6


def test_millimetres_are_a_thousand_times_as_many(tmp_path: Path) -> None:
    small, large = (
        {path.stem: trimesh.load_mesh(path) for path in save_stl(tmp_path / unit, unit=unit)}
        for unit in ("m", "mm")
    )
    for name in ("platform", "delta_rod0_left"):
        assert large[name].extents == pytest.approx(1000.0 * small[name].extents, rel=1e-5)
    rod, balls = large["delta_rod0_left"], 2 * 7.2
    assert rod.extents[0] == pytest.approx(1000.0 * Machine().delta.distal_length + balls, abs=0.2)
    assert rod.is_watertight
    with pytest.raises(GeometryError, match="cannot stand at home"):
        links(Machine(task=InsertionTask(effector_radius=0.2)))
    with pytest.raises(ArgumentError, match="unit = 'inch'"):
        save_stl(tmp_path / "no", unit="inch")
    assert not (tmp_path / "no").exists()


def test_glb_is_the_machine_at_home(tmp_path: Path) -> None:
    save_glb(tmp_path / "a.glb")
    scene, result = trimesh.load_scene(tmp_path / "a.glb"), links()
    upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # glTF's y points up
    wanted = drawn(Machine()) @ upright.T
    bounds = np.array([wanted.min(axis=0), wanted.max(axis=0)])
    assert scene.bounds == pytest.approx(bounds, abs=1e-6)
    assert set(scene.geometry) == {link.name for link in result}
    colours = {
        tuple(map(int, vertex[:3]))
        for mesh in scene.geometry.values()
        for vertex in np.unique(mesh.visual.vertex_colors, axis=0)
    }
    peg, aim = (pixels(tuple(to_linear(COLOURS[name]))) for name in ("peg", "target"))
    assert peg in colours
    assert aim not in colours
    for link in result:
        pose, _ = scene.graph[link.name]
        assert pose[:3, 3] == pytest.approx(upright @ link.position, abs=1e-6)
        assert pose[:3, :3] == pytest.approx(upright @ link.rotation, abs=1e-6)


def poses(model: ET.Element) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    result = {}
    for link in model.iter("link"):
        numbers = np.array(str(link.findtext("pose")).split(), float)
        rotation = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
        result[link.attrib["name"]] = rotation, numbers[:3]
    return result


def test_sdf_closes_its_loops_and_weighs_what_the_mjcf_does(tmp_path: Path) -> None:
    machine = OWN
    root = ET.parse(save_sdf(str(tmp_path), machine)).getroot()
    assert all((tmp_path / str(uri.text)).is_file() for uri in root.iter("uri"))
    freedom = {"fixed": 0, "revolute": 1, "universal": 2, "ball": 3}
    home = machine.home()
    balls = rrs.limb_points(home[3:], machine.rrs)[:, 2]
    wrists = delta.limb_points(home[:3], machine.delta)[:, 2] + [0, 0, machine.delta.base_height]
    for model in root.iter("model"):
        places = poses(model)
        joints = list(model.iter("joint"))
        free = 6 * len(places) - sum(6 - freedom[joint.attrib["type"]] for joint in joints)
        assert free == 3  # Chebyshev, Gruebler and Kutzbach
        assert Counter(joint.attrib["name"] for joint in joints).most_common(1)[0][1] == 1
        for joint in joints:
            parent, child = str(joint.findtext("parent")), str(joint.findtext("child"))
            assert child in places
            assert parent in {*places, "world"}
            if joint.attrib["type"] != "ball":
                continue
            rotation, position = places[parent]
            end = position + rotation[:, 0] * float(str(joint.findtext("pose")).split()[0])
            limb = int(joint.attrib["name"].split("_")[1][-1])
            wanted = balls[limb]
            if child == "effector":
                side = -1.0 if "left" in joint.attrib["name"] else 1.0
                wanted = wrists[limb] + side * ROD_SPACING * rotation[:, 1]
            assert end == pytest.approx(wanted, abs=1e-9)
    masses = [float(str(mass.text)) for mass in root.iter("mass")]
    assert sum(masses) == pytest.approx(make_model(machine).body_mass.sum())
    for tensor in root.iter("inertia"):
        i = {part.tag: float(str(part.text)) for part in tensor}
        matrix = [[i["ixx"], i["ixy"], i["ixz"]], [i["ixy"], i["iyy"], i["iyz"]],
                  [i["ixz"], i["iyz"], i["izz"]]]  # fmt: skip
        one, two, three = np.linalg.eigvalsh(matrix)
        assert one > 0.0
        assert one + two >= three * (1.0 - 1e-9)


def test_sdf_is_read_by_libsdformat(tmp_path: Path) -> None:
    """Drake's parser is libsdformat."""
    pytest.importorskip("pydrake", reason="drake is not installed")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(1e-3)
    models = Parser(plant).AddModels(str(save_sdf(tmp_path)))
    assert [plant.GetModelInstanceName(model) for model in models] == ["delta", "rrs"]
    kinds = Counter(plant.get_joint(i).type_name() for i in plant.GetJointIndices())
    assert kinds == {"weld": 2, "revolute": 9, "universal": 6, "ball_rpy": 9}
    assert plant.num_actuators() == 6
