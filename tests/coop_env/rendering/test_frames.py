"""Pictures of a scene: what is in them, where it is, and that they follow the robots."""

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from coop_env.env import CoopInsertionEnv
from coop_env.rendering import CAMERAS, Camera, frame_view, render_frame
from coop_env.rendering.bodies import COLOURS, bodies, hole_state
from coop_env.rendering.frame import _Card, triangles
from coop_env.rendering.rasterizer import cast_light, draw
from coop_env.rendering.scene import Scene
from coop_env.rendering.shapes import Mesh, arrow, bar, cylinder, plate, rod, sphere

Image8 = npt.NDArray[np.uint8]
# tilted so that holes 2 and 3 (azimuths 225 and 315 degrees) face the camera of this azimuth
FACING = Camera(35.0, -90.0, 1.0, (0.0, 0.0, 0.06), follows=True)
START = np.array([0.0, 0.06, -0.32, 0.25, 0.0, 0.23])


def make_scene(configuration: np.ndarray = START, **options: Any) -> Scene:
    env = CoopInsertionEnv(render_mode="rgb_array")
    env.reset(seed=0, options={"configuration": configuration, "target": 2, **options})
    return env.scene()


def hue_near(image: Image8, point: npt.NDArray[np.float64], radius: int) -> str:
    """Which hole colour the pixels around a point are most like."""
    column, row = (round(float(v)) for v in point)
    patch = image[row - radius : row + radius + 1, column - radius : column + radius + 1]
    pixels = patch.reshape(-1, 3).astype(float)
    strongest = pixels[np.argmax(np.ptp(pixels, axis=1))]
    hue = strongest - strongest.mean()
    names = ("open", "target", "filled")
    tints = [np.array(COLOURS[name]) - np.mean(COLOURS[name]) for name in names]
    return names[int(np.argmax([hue @ t / np.linalg.norm(t) for t in tints]))]


def test_every_camera_gives_a_picture_of_its_own() -> None:
    scene = make_scene()
    beside = Camera(10.0, 77.0)
    other = render_frame(scene, camera=beside, size=(320, 240), panel=False).astype(int)
    cameras: list[str | Camera] = [*CAMERAS, FACING]
    for camera in cameras:
        image = render_frame(scene, camera=camera, size=(320, 240), panel=False)
        assert image.shape == (240, 320, 3)
        assert image.dtype == np.uint8
        assert image.std() > 10.0
        assert (np.abs(image - other).max(axis=2) > 30).mean() > 0.02


@pytest.mark.parametrize("radius", [0.002, 0.004, 0.012])
def test_holes_are_drawn_as_wide_as_the_peg_needs(radius: float) -> None:
    env = CoopInsertionEnv(render_mode="rgb_array", delta={"peg_radius": radius})
    env.reset(seed=0)
    (bore,) = (b.mesh.vertices for b in bodies(env.scene()) if b.name == "platform/bore0")
    assert 1.2 * radius < np.hypot(*bore[:, :2].T).max() < 1.5 * radius


def test_picture_follows_every_degree_of_freedom() -> None:
    size = (320, 240)
    before = render_frame(make_scene(), size=size, panel=False).astype(int)
    for axis, step in enumerate((0.03, 0.03, -0.03, 0.06, 0.06, 0.015)):
        moved = make_scene(START + step * np.eye(6)[axis])
        after = render_frame(moved, size=size, panel=False).astype(int)
        assert (np.abs(after - before).max(axis=2) > 40).sum() > 50, axis


def test_holes_have_the_colours_of_their_states_where_they_are() -> None:
    """A filled one wears a plug that stands out of the dome."""
    # on the ring, on the side that neither the plug nor the arrow hides
    down = np.array([0.0, -0.0078, -0.0045])
    for filled in ([], [3]):
        scene, states = make_scene(filled=filled), ["target", "filled" if filled else "open"]
        assert [hole_state(scene, i) for i in (2, 3)] == states
        image = render_frame(scene, camera=FACING, size=(800, 800), panel=False)
        view = frame_view(scene, camera=FACING, size=(800, 800), panel=False)
        points = [view.project(scene.hole_mouths[i] + down) for i in (2, 3)]
        assert [hue_near(image, point, 4) for point in points] == states
        plugs = [body.name for body in bodies(scene) if "/plug" in body.name]
        assert plugs == [f"platform/plug{i}" for i in filled]
    plug = view.project(scene.hole_mouths[3] + 0.008 * scene.hole_normals[3])
    assert hue_near(image, plug, 2) == "filled"
    env = CoopInsertionEnv(stage=0, render_mode="rgb_array")
    env.reset(seed=0)  # without the inner holes
    states = [hole_state(env.scene(), i) for i in range(6)]
    assert [state == "inactive" for state in states] == [False] * 4 + [True] * 2


def test_trace_runs_through_its_points() -> None:
    scene = make_scene()
    way = scene.tip + np.array([[0.0, 0.0, 0.0], [0.0, -0.1, 0.02], [0.1, -0.1, 0.05]])
    view = frame_view(scene, panel=False, camera="front")
    plain = render_frame(scene, panel=False, camera="front").astype(int)
    moved = dataclasses.replace(scene, trace=way)
    traced = render_frame(moved, panel=False, camera="front").astype(int)
    changed = np.abs(traced - plain).max(axis=2) > 30
    for middle in (way[:2].mean(axis=0), way[1:].mean(axis=0)):
        column, row = np.round(view.project(middle)).astype(int)
        assert changed[row - 2 : row + 3, column - 2 : column + 3].any()


def test_links_behind_the_dome_are_hidden() -> None:
    scene = make_scene()
    dome = [body for body in bodies(scene) if body.name == "platform/dome"]
    behind = dataclasses.replace(
        dome[0], name="ball", mesh=sphere(0.02), colour=(1.0, 0.0, 1.0), shines=True
    )
    magenta = np.array([255, 0, 255])
    for shift, visible in ((0.2, False), (-0.2, True)):  # beyond the dome, and before it
        centre = scene.platform_centre + np.array([0.0, shift, 0.03])
        model = triangles([*dome, dataclasses.replace(behind, position=centre)])
        camera = Camera(0.0, -90.0, 2.0, (0.0, 0.0, 0.0), follows=True)
        view = frame_view(scene, camera=camera, size=(300, 300), panel=False)
        image = draw(model, cast_light(model, -90.0), view, (300, 300))
        assert (image == magenta).all(axis=2).any() == visible


def test_card_is_left_out_of_small_pictures_and_on_request() -> None:
    scene = make_scene()
    later = dataclasses.replace(scene, time=12.0)
    cases: tuple[dict[str, Any], ...] = ({"size": (160, 120)}, {"panel": False})
    for arguments in cases:
        assert np.array_equal(render_frame(scene, **arguments), render_frame(later, **arguments))
    assert not np.array_equal(render_frame(scene), render_frame(later))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera": "isometric"}, "unknown camera 'isometric'"),
        ({"size": (0, 480)}, "16 to 8192"),
        ({"size": 640}, "width, height"),
        ({"samples": 0}, "1 to 8"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render_frame(make_scene(), **arguments)


@pytest.mark.parametrize(
    "mesh",
    [
        rod(0.01, 0.3),
        cylinder(0.02, -0.1, 0.1, chamfer=0.002),
        cylinder(0.02, 0.0, 0.1),
        sphere(0.1),
        arrow(0.05, 0.002),
        bar(0.2, 0.017, 0.010, 0.02),
        bar(0.005, 0.017, 0.010, 0.02),  # shorter than its ends' radii differ
        plate(0.1, 0.05, 0.01),
    ],
    ids=["rod", "chamfered", "cylinder", "sphere", "arrow", "bar", "short bar", "plate"],
)
def test_solids_are_closed_and_face_outwards(mesh: Mesh) -> None:
    _, welded = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    faces = welded.reshape(-1)[mesh.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert all((b, a) in there for a, b in there), "an edge without its other side"
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert np.sum(a * np.cross(b, c)) > 0.0  # six times its volume
    turned = np.sum(np.cross(b - a, c - a) * mesh.normals[mesh.faces[:, 0]], axis=1)
    assert (turned >= -1e-12).all()
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)


def test_bodies_are_named_once_and_both_robots_are_whole() -> None:
    names = [body.name for body in bodies(make_scene())]
    assert len(names) == len(set(names))
    limbs = ("delta_proximal{}", "delta_rod{}_left", "delta_rod{}_right", "rrs_proximal{}",
             "rrs_distal{}")  # fmt: skip
    links = {"delta_base", "effector", "rrs_base", "platform", "target"}
    links |= {name.format(limb) for name in limbs for limb in range(3)}
    assert {name.split("/")[0] for name in names} == links


def test_the_card_has_room_for_many_holes() -> None:
    spans = []
    for holes in (6, 20):
        picture = Image.new("RGB", (300, 480))
        card = _Card(picture, (0, 0, 300, 480))
        card.dots([(255, 0, 0)] * holes)
        red = (np.asarray(picture) == [255, 0, 0]).all(axis=2).any(axis=0)
        spans.append(np.flatnonzero(red))
    assert spans[1].min() >= spans[0].min() - 3
    assert spans[1].max() <= card.right
