"""What a robot looks like: its meshes as Pinocchio reads them, capsules where there are none."""

import sys
from typing import NamedTuple

import arms
import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from lxml import etree
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.errors import MissingPackageError
from approxjac.robots.meshes import find_mesh, share_dir
from approxjac.robots.urdf import Urdf
from approxjac.view import look as look_module
from approxjac.view.look import load_mesh, simplify, smooth

ROBOTS = share_dir() / "example-robot-data/robots"
FINGER = "panda_description/meshes/visual/finger.dae"


class Look(NamedTuple):
    shapes: dict
    missing: list


def robot_look(robot):
    return Look(*look_module.robot_look(robot))


def bounds(vertices):
    return np.array([np.min(vertices, axis=0), np.max(vertices, axis=0)])


def numbers(element, name, default):
    text = default if element is None else element.get(name, default)
    return np.array([float(word) for word in text.split()])


def by_coal(path, scale=(1.0, 1.0, 1.0)):
    """Vertices as Pinocchio would show them."""
    return np.array(coal.MeshLoader().load(str(path), np.array(scale)).vertices())


def visuals(robot):
    """Link, mesh file or None, scale and origin of each <visual>."""
    for link in robot.tree.root.iterfind("link"):
        for visual in link.iterfind("visual"):
            origin = visual.find("origin")
            placed = pin.SE3(
                pin.utils.rpyToMatrix(*numbers(origin, "rpy", "0 0 0")),
                numbers(origin, "xyz", "0 0 0"),
            ).homogeneous
            mesh = visual.find("geometry/mesh")
            path = None if mesh is None else find_mesh(mesh.get("filename"), robot.urdf_dir)
            yield link.get("name"), path, numbers(mesh, "scale", "1 1 1"), placed


def check(shape):
    assert np.isfinite(shape.vertices).all()
    assert shape.vertices.shape[1:] == shape.faces.shape[1:] == (3,)
    assert shape.faces.min() >= 0
    assert set(np.unique(shape.faces)) == set(range(len(shape.vertices)))


def urdf(link="", joints="", links=""):
    """An arm of 1 m, whose link looks as the text says."""
    return f"""<robot name="arm">
      <link name="base"/>
      <link name="arm">
        <inertial><mass value="1"/>
          <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{link}
      </link>
      <link name="end"/>{links}
      <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/></joint>
      <joint name="tip" type="fixed"><origin xyz="0 0.6 0.8"/>
        <parent link="arm"/><child link="end"/></joint>{joints}
    </robot>"""


def visual(geometry, origin=""):
    return f"<visual>{origin}<geometry>{geometry}</geometry></visual>"


def look_of(*texts, **kwargs):
    return robot_look(aj.Robot(urdf("".join(texts)), **kwargs))


# -- the arms ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def look(arm):
    return robot_look(arm)


MANY_MESHES = ("kinova", "panda", "tiago_arm")  # which take a second to simplify
ARMS = [
    pytest.param(arm.id, marks=pytest.mark.study) if arm.id in MANY_MESHES else arm
    for arm in arms.SEVERAL
]


@pytest.mark.study
@pytest.mark.parametrize("arm", arms.SEVERAL, indirect=True)
def test_arms_look_as_pinocchio_shows_them(arm, look):
    assert look.missing == []
    assert set(look.shapes) <= set(arm.frame_names)
    places, checked = {}, {}
    for link, path, scale, origin in visuals(arm):
        place = places[link] = places.get(link, -1) + 1
        if path is None:
            continue
        key = (path, *scale)
        if key not in checked:
            vertices = by_coal(path, scale)
            size = np.linalg.norm(np.ptp(vertices, axis=0))
            read = load_mesh(path).apply_scale(scale)
            assert_allclose(bounds(read.vertices), bounds(vertices), atol=1e-6 * size)
            checked[key] = vertices, size
        vertices, size = checked[key]
        shown = look.shapes[link][place]
        expected = bounds(vertices @ origin[:3, :3].T + origin[:3, 3])
        assert_allclose(bounds(shown.vertices), expected, atol=max(0.005, 0.02 * size))


@pytest.mark.parametrize("arm", ARMS, indirect=True)
def test_arms_are_light(arm, look):
    shapes = [shape for shapes in look.shapes.values() for shape in shapes]
    for shape in shapes:
        check(shape)
    many_parts = 1.3 if arm.name == "talos_arm" else 1.0
    assert max(len(shape.faces) for shape in shapes) <= many_parts * 2500


@pytest.mark.study
def test_the_panda_keeps_its_form(panda):
    """Both ways between what is in the files and what is shown, where 2 mm is little."""
    from scipy.spatial import cKDTree

    look = robot_look(panda)
    for link, path, _, origin in list(visuals(panda))[::3]:
        full, light = load_mesh(path).apply_transform(origin), look.shapes[link][0]
        points = [trimesh.sample.sample_surface(mesh, 30_000, seed=1)[0] for mesh in (full, light)]
        for a, b in (points, points[::-1]):
            gap = cKDTree(a).query(b[:3000])[0]
            assert np.quantile(gap, 0.95) < 0.004, link  # 1 to 3 mm is between samples


def test_an_arm_whose_meshes_are_gone_is_drawn_as_capsules(arm):
    text = arm.urdf.replace(".dae", ".gone").replace(".DAE", ".gone")
    text = text.replace(".stl", ".gone").replace(".STL", ".gone")
    moved = aj.Robot(text, tip=arm.tip, urdf_dir=arm.urdf_dir)
    look = robot_look(moved)
    assert look.missing == [f"{name}: no such file" for name in dict.fromkeys(look_names(text))]
    seen = {
        link.get("name")
        for link in Urdf.parse(text, "").root.iterfind("link")
        if any(g.tag != "mesh" for g in link.iterfind("visual/geometry/*"))
    }
    wanted = {link for link, *_ in visuals(moved)}
    assert wanted <= set(look.shapes)
    for link, joint in moving_joints(moved):
        length = np.linalg.norm(joint)
        if link in seen or length < 0.01:
            continue
        ends = [(shape.vertices - joint) @ joint / length for shape in look.shapes.get(link, ())]
        # past the joint by a radius, as one of the capsules from the link's origin
        assert any(0.0 < end.max() < 0.1 and end.min() < -length for end in ends), link
    for shapes in look.shapes.values():
        for shape in shapes:
            check(shape)


def look_names(text):
    root = Urdf.parse(text, "").root
    return [mesh.get("filename") for mesh in root.iterfind("link/visual/geometry/mesh")]


def moving_joints(robot):
    """Parent link of each moving joint, and where the joint is in it."""
    for joint in robot.tree.root.iterfind("joint"):
        if joint.get("type") != "fixed":
            yield joint.find("parent").get("link"), numbers(joint.find("origin"), "xyz", "0 0 0")


# -- mesh files -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        FINGER,
        "tiago_description/meshes/arm/arm_6.stl",
        "laikago_description/meshes/hip.obj",
    ],
)
def test_every_format_is_read_as_pinocchio_does(name):
    path = ROBOTS / name
    look = look_of(visual(f'<mesh filename="package://{name}" scale="2 -1 1"/>'), urdf_dir=ROBOTS)
    assert look.missing == []
    expected = bounds(by_coal(path, (2.0, -1.0, 1.0)))
    assert_allclose(bounds(look.shapes["arm"][0].vertices), expected, atol=2e-3)


def test_a_mirrored_mesh_is_not_inside_out(tmp_path):
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "box.stl")
    look = look_of(visual('<mesh filename="box.stl" scale="1 -1 1"/>'), urdf_dir=tmp_path)
    shape = look.shapes["arm"][0]
    assert shape.volume == pytest.approx(6.0)


def test_unit_and_up_axis_of_a_file_are_ignored(tmp_path):
    text = (ROBOTS / FINGER).read_text()
    text = text.replace('meter="1"', 'meter="0.01"').replace("Z_UP", "Y_UP")
    assert 'meter="0.01"' in text
    path = tmp_path / "finger.dae"
    path.write_text(text)
    assert_allclose(bounds(load_mesh(path).vertices), bounds(by_coal(path)), atol=1e-7)
    assert load_mesh(path).scale == pytest.approx(0.06, abs=0.01)


@pytest.mark.parametrize("ending", ["dae", "stl", "obj", "ply", "unknown"])
@pytest.mark.parametrize("content", [b"", b"solid nothing", b"\x00\xff" * 200])
def test_a_broken_mesh_is_named(ending, content, tmp_path):
    (tmp_path / f"a.{ending}").write_bytes(content)
    look = look_of(visual(f'<mesh filename="a.{ending}"/>'), urdf_dir=tmp_path)
    (text,) = look.missing
    assert text.startswith(f"a.{ending}: ")
    assert "cannot be read: " in text or "holds no triangles" in text
    assert_tip_is_reached(look)


def assert_tip_is_reached(look):
    (capsule,) = look.shapes["arm"]
    along = capsule.vertices @ [0.0, 0.6, 0.8]
    assert_allclose([along.min(), along.max()], [-0.03, 1.03], atol=1e-9)  # 3 % of 1 m
    assert_allclose(np.ptp(capsule.vertices[:, 0]), 0.06, atol=0.002)


@pytest.mark.parametrize(
    ("element", "text"),
    [
        (visual('<mesh filename="no.stl"/>'), "no.stl: no such file"),
        (visual("<mesh/>"), "<mesh> of link 'arm': no such file"),
        (visual('<cone radius="1"/>'), "<cone> of link 'arm': cannot be read: Unknown tag: cone"),
        (visual(""), "<visual> of link 'arm': there is no <geometry>"),
        ("<visual/>", "<visual> of link 'arm': there is no <geometry>"),
        (
            visual('<box size="1 1"/>'),
            "<box> of link 'arm': Extents must be (3,)!",
        ),
        (
            visual('<sphere radius="-1"/>'),
            "<sphere> of link 'arm': its numbers must be finite, and its size > 0",
        ),
        (
            visual('<sphere radius="1"/>', '<origin xyz="0 0 nan"/>'),
            "<sphere> of link 'arm': its numbers must be finite, and its size > 0",
        ),
        (
            visual('<mesh filename="a.stl" scale="0 1 1"/>'),
            "a.stl: its numbers must be finite, and its size > 0",
        ),
    ],
)
def test_what_cannot_be_shown_is_named(element, text):
    look = look_of(element)
    assert look.missing == [text]
    assert_tip_is_reached(look)


def test_a_link_of_which_something_is_found_keeps_that():
    look = look_of(visual('<mesh filename="no.stl"/>'), visual('<sphere radius="0.1"/>'))
    assert look.missing == ["no.stl: no such file"]
    (sphere,) = look.shapes["arm"]
    assert_allclose(bounds(sphere.vertices), [[-0.1] * 3, [0.1] * 3])


# -- what is not from files -------------------------------------------------------------


def test_a_robot_that_says_nothing_is_drawn_as_capsules():
    look = look_of()
    assert look.missing == []
    assert set(look.shapes) == {"arm"}
    assert_tip_is_reached(look)


def test_frames_are_not_drawn():
    camera = '<link name="camera"/>'
    joint = """<joint name="camera" type="fixed"><origin xyz="1 0 0"/>
      <parent link="arm"/><child link="camera"/></joint>"""
    robot = aj.Robot(urdf(links=camera, joints=joint), tip="end")
    assert_tip_is_reached(robot_look(robot))


def test_the_last_link_is_a_ball_where_its_mesh_is_gone(two_link):
    root = etree.fromstring(two_link.urdf.encode())
    (tip,) = (link for link in root.iterfind("link") if link.get("name") == "object_tip")
    tip.append(etree.fromstring(visual('<mesh filename="no.stl"/>')))
    look = robot_look(aj.Robot(etree.tostring(root, encoding="unicode")))
    (ball,) = look.shapes["object_tip"]
    assert_allclose(np.linalg.norm(ball.vertices, axis=1), 0.075)  # 3 % of the way to it


@pytest.mark.parametrize(
    ("geometry", "size"),
    [
        ('<box size="0.2 0.4 0.6"/>', (0.2, 0.4, 0.6)),
        ('<cylinder radius="0.1" length="0.5"/>', (0.2, 0.2, 0.5)),
        ('<sphere radius="0.3"/>', (0.6, 0.6, 0.6)),
    ],
)
def test_primitives_have_their_size_where_their_origin_is(geometry, size):
    origin = '<origin xyz="1 2 3" rpy="0.3 -0.5 1.1"/>'
    look = look_of(visual(geometry), visual(geometry, origin))
    plain, placed = look.shapes["arm"]
    for shape in (plain, placed):
        check(shape)
    assert_allclose(bounds(plain.vertices), [-0.5 * np.array(size), 0.5 * np.array(size)])
    pose = pin.SE3(pin.utils.rpyToMatrix(0.3, -0.5, 1.1), np.array([1.0, 2.0, 3.0]))
    back = (placed.vertices - pose.translation) @ pose.rotation
    assert_allclose(back, plain.vertices, atol=1e-12)
    volume = plain.volume
    full = {"b": 0.048, "c": np.pi * 0.005, "s": 4 / 3 * np.pi * 0.027}[geometry[1]]
    assert 0.94 * full < volume < 1.0001 * full


def test_a_mesh_is_scaled_before_it_is_placed(tmp_path):
    """Along each of its own axes; the place of its origin is in metres of the link."""
    trimesh.creation.box((0.2, 0.4, 0.6)).export(tmp_path / "box.stl")
    origin = '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'
    mesh = f'<mesh filename="{tmp_path / "box.stl"}" scale="2 0.5 1"/>'
    (shape,) = look_of(visual(mesh, origin)).shapes["arm"]
    half = np.array([0.1, 0.2, 0.3])  # of 0.4, 0.2 and 0.6, turned by a quarter
    assert_allclose(bounds(shape.vertices), [[1, 2, 3] - half, [1, 2, 3] + half], atol=1e-6)


def test_an_object_reaches_from_its_parent_to_its_tip():
    arm = aj.load_robot("two_link")
    look = robot_look(arm.with_object(0.2, 0.5, radius=0.03, axis="z"))
    (cylinder,) = look.shapes["object"]
    assert_allclose(bounds(cylinder.vertices), [[-0.03, -0.03, 0.0], [0.03, 0.03, 0.2]], atol=1e-12)
    assert "object" not in robot_look(arm.with_object(0.0)).shapes


def test_the_two_link_arm_is_its_cylinders(two_link):
    look = robot_look(two_link)
    assert set(look.shapes) == {"link1", "link2", "object"}
    for link in ("link1", "link2"):
        (rod,) = look.shapes[link]
        expected = [[0.0, -0.02, -0.02], [1.0, 0.02, 0.02]]
        assert_allclose(bounds(rod.vertices), expected, atol=1e-12)


# -- triangles --------------------------------------------------------------------------


def test_sharp_edges_are_kept_and_others_shared():
    look = look_of(visual('<box size="1 1 1"/>'), visual('<cylinder radius="1" length="1"/>'))
    box, cylinder = look.shapes["arm"]
    assert len(box.vertices) == 24  # each corner three times
    assert len(cylinder.vertices) == 2 * 32 * 2 + 2  # a ring for the wall and one for each end
    ball = trimesh.creation.icosphere(subdivisions=3)
    assert len(smooth(ball).vertices) == len(ball.vertices)


def test_what_is_small_is_not_touched():
    box = look_of(visual('<box size="1 1 1"/>')).shapes["arm"][0]
    assert simplify(box, 200) is box


def test_without_the_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    look_module._light_mesh.cache_clear()
    with pytest.raises(MissingPackageError, match=r"pip install 'approxjac\[view\]'$"):
        look_of(visual(f'<mesh filename="package://{FINGER}"/>'), urdf_dir=ROBOTS)
