"""What `save_urdf` writes opens in Pinocchio, yourdfpy, MuJoCo and MeshCat alike."""

import base64
import re

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import umsgpack
import yourdfpy
from arms import FEW
from lxml import etree
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.errors import UrdfError
from approxjac.robots import Dynamics

OBJECTS = {
    "rod": {"length": 0.5, "mass": 0.5, "radius": 0.0, "axis": "x"},
    "cylinder": {"length": 0.2, "mass": 0.5, "radius": 0.03},
    "slanted": {"length": 0.2, "mass": 0.5, "axis": (1.0, -2.0, 0.5)},
    "nothing": {"length": 0.0, "mass": 0.0},
    "point": {"length": 0.0, "mass": 0.3, "radius": 0.0},
    "massless": {"length": 0.3, "mass": 0.0},
}


@pytest.fixture(
    params=[("panda", kind) for kind in sorted(OBJECTS)]
    + [pytest.param((arm.id, "cylinder"), marks=arm.marks) for arm in FEW]
    + [("two_link", "rod")],
    ids="-".join,
)
def saved(request, tmp_path):
    name, kind = request.param
    robot = aj.load_robot(name).with_object(**OBJECTS[kind])
    return robot, robot.save_urdf(tmp_path / "held.urdf")


def tip(robot, q):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.frame_id("object_tip")].homogeneous


def angles(robot, q):
    """One number a joint, as MuJoCo and yourdfpy have it, continuous joints included."""
    return pin.difference(robot.model, robot.neutral(), q)


def test_pinocchio(saved, rng):
    robot, path = saved
    model = pin.buildModelFromUrdf(str(path))
    assert list(model.names) == list(robot.model.names)
    inertias = list(zip(robot.model.inertias, model.inertias, strict=True))
    assert inertias[0][0].mass == pytest.approx(inertias[0][1].mass)  # of what does not move
    for a, b in inertias[1:]:
        assert_allclose(a.toDynamicParameters(), b.toDynamicParameters(), rtol=1e-14, atol=1e-15)
    q = robot.random_configuration(rng)
    assert_allclose(tip(aj.load_robot(path), q), tip(robot, q), atol=1e-14)


def test_mujoco(saved, rng, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    robot, path = saved
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    q = robot.random_configuration(rng)
    data.qpos[:] = angles(robot, q)
    mujoco.mj_forward(model, data)
    body = data.body("object_tip")
    assert_allclose(body.xpos, tip(robot, q)[:3, 3], atol=1e-12)
    assert_allclose(body.xmat.reshape(3, 3), tip(robot, q)[:3, :3], atol=1e-12)
    moved = model.body_weldid != 0  # 0 is the world
    assert_allclose(model.body_mass[moved].sum(), robot.mass, rtol=1e-12)
    M = np.zeros((robot.nv, robot.nv))
    mujoco.mj_fullM(model, data, M)
    assert_allclose(M, Dynamics(robot).M(q), atol=1e-9 + 1e-9 * np.abs(M).max())


def test_yourdfpy(saved, rng):
    robot, path = saved
    urdf = yourdfpy.URDF.load(str(path), load_meshes=False)
    q = robot.random_configuration(rng)
    urdf.update_cfg(dict(zip(robot.joint_names, angles(robot, q), strict=True)))
    base = urdf.base_link
    assert_allclose(urdf.get_transform("object_tip", base), tip(robot, q), atol=1e-12)
    masses = [link.inertial.mass for link in urdf.robot.links if link.inertial is not None]
    fixed = robot.model.inertias[0].mass
    assert_allclose(sum(masses), robot.mass + fixed, rtol=1e-12)


@pytest.mark.parametrize("name", ["two_link", pytest.param("panda", marks=pytest.mark.study)])
def test_meshcat(name, tmp_path, rng):
    from pinocchio.visualize import MeshcatVisualizer

    robot = aj.load_robot(name).with_object(0.2, 0.5, axis="z")
    path = robot.save_urdf(tmp_path / "held.urdf")
    viewer = MeshcatVisualizer(*pin.buildModelsFromUrdf(str(path)))
    viewer.initViewer(open=False)
    try:
        viewer.loadViewerModel()
        q = robot.random_configuration(rng)
        viewer.display(q)
        page = viewer.viewer.static_html()
    finally:
        window = viewer.viewer.window
        window.zmq_socket.close(linger=0)
        window.server_proc.kill()
        window.server_proc.wait(timeout=10)
    blobs = [base64.b64decode(data) for data in re.findall(r"base64,([^\"]+)", page)]
    commands = [umsgpack.unpackb(blob) for blob in blobs if b"set_transform" in blob[:40]]
    placed = {command["path"]: np.reshape(command["matrix"], (4, 4)).T for command in commands}
    object_path = next(path for path in placed if path.endswith("visuals/object_0"))
    middle = tip(robot, q) @ [0.0, 0.0, -0.1, 1.0]
    assert_allclose(placed[object_path] @ [0.0, 0.0, 0.0, 1.0], middle, atol=1e-9)


def test_nothing_of_the_original_is_lost(tmp_path):
    text = """
    <robot name="gripper">
      <!-- kept -->
      <link name="base"/>
      <link name="a"><inertial><mass value="1"/>
        <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
      <link name="b"><inertial><mass value="1"/>
        <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
      <joint name="ja" type="revolute"><parent link="base"/><child link="a"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/>
        <safety_controller k_velocity="3"/></joint>
      <joint name="jb" type="revolute"><parent link="a"/><child link="b"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/>
        <mimic joint="ja" multiplier="2"/></joint>
      <transmission name="t"><type>simple</type></transmission>
      <gazebo reference="a"><kp>7</kp></gazebo>
    </robot>"""
    robot = aj.load_robot(text).with_kinematic_error({"jb": (0.1, 0.0, 0.0)}).with_object(0.1)
    written = robot.save_urdf(tmp_path / "gripper.urdf").read_text()
    for kept in (
        "<!-- kept -->",
        '<mimic joint="ja" multiplier="2"/>',
        '<safety_controller k_velocity="3"/>',
        '<transmission name="t">',
        "<kp>7</kp>",
    ):
        assert kept in written
    assert '<origin xyz="0.1 0.0 0.0" rpy="0.0 0.0 0.0"/>' in written.replace("-0.0", "0.0")


def test_a_urdf_that_already_speaks_to_mujoco_is_left_alone(tmp_path):
    text = aj.load_robot("two_link").urdf.replace(
        "<material", '<mujoco><compiler fusestatic="true"/></mujoco><material', 1
    )
    written = aj.load_robot(text).save_urdf(tmp_path / "own.urdf").read_text()
    assert written.count("<mujoco>") == 1
    assert 'fusestatic="true"' in written


def with_mesh(name):
    """The two-link arm with a mesh on its base."""
    visual = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    return aj.load_robot("two_link").urdf.replace(
        '<link name="base_link"/>', f'<link name="base_link">{visual}</link>'
    )


@pytest.fixture
def mesh(tmp_path):
    path = tmp_path / "robots" / "thing_description" / "meshes" / "a.stl"
    path.parent.mkdir(parents=True)
    path.write_text("solid a\nendsolid a\n")
    return path


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("package://thing_description/meshes/a.stl", True),
        ("thing_description/meshes/a.stl", True),
        ("package://thing_description/meshes/b.stl", False),
    ],
)
def test_meshes_are_found_near_the_urdf(tmp_path, mesh, name, found):
    path = tmp_path / "robots" / "arm.urdf"
    path.write_text(with_mesh(name))
    written = aj.load_robot(path).save_urdf(tmp_path / "out.urdf").read_text()
    assert (str(mesh) if found else name) in written


def test_meshes_are_found_on_the_ros_package_path(tmp_path, mesh, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "robots"))
    robot = aj.load_robot(with_mesh("package://thing_description/meshes/a.stl"))
    assert str(mesh) in robot.save_urdf(tmp_path / "out.urdf").read_text()


def test_inertias_that_no_body_has_are_zeroed_where_nothing_moves(tmp_path):
    impossible = (
        '<inertial><mass value="0.5"/>'
        '<inertia ixx="{}" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="9"/></inertial>'
    )
    text = aj.load_robot("two_link").urdf.replace(
        '<link name="base_link"/>', f'<link name="base_link">{impossible.format(0.1)}</link>'
    )
    robot = aj.load_robot(text)
    saved = robot.save_urdf(tmp_path / "out.urdf")
    assert 'ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"' in saved.read_text()
    assert robot.urdf == text
    written = aj.load_robot(saved).model.inertias
    assert written[0].mass == 0.5
    for a, b in zip(robot.model.inertias[1:], written[1:], strict=True):
        assert_allclose(a.toDynamicParameters(), b.toDynamicParameters(), rtol=1e-14)


def test_a_folder_that_does_not_exist(two_link, tmp_path):
    with pytest.raises(aj.InvalidInputError, match="path must be a file that can be written, got"):
        two_link.save_urdf(tmp_path / "nowhere" / "arm.urdf")


def test_meshes_of_one_name_do_not_overwrite_each_other(tmp_path):
    import trimesh

    sizes = {"a": 1.0, "b": 2.0}
    urdf = aj.load_robot("two_link").urdf
    for (folder, size), link in zip(sizes.items(), ("link1", "link2"), strict=True):
        (tmp_path / folder).mkdir()
        trimesh.creation.box((size, size, size)).export(tmp_path / folder / "m.ply")
        collision = f'<collision><geometry><mesh filename="{folder}/m.ply"/></geometry></collision>'
        urdf = urdf.replace(f'<link name="{link}">', f'<link name="{link}">{collision}')
    path = tmp_path / "arm.urdf"
    path.write_text(urdf)
    aj.load_robot(path).save_urdf(tmp_path / "out.urdf")
    written = sorted((tmp_path / "out_meshes").iterdir())
    assert [trimesh.load(mesh).extents[0] for mesh in written] == pytest.approx([1.0, 2.0])
    (tmp_path / "a" / "m.ply").write_text("broken")
    with pytest.raises(UrdfError, match=r"collision mesh .* cannot be converted"):
        aj.load_robot(path).save_urdf(tmp_path / "out.urdf")


@pytest.mark.parametrize(("length", "shapes"), [(0.2, 1), (0.0, 0)])
def test_an_object_can_be_touched_where_it_is_seen(length, shapes):
    base = aj.load_robot("two_link")
    root = etree.fromstring(base.with_object(length, radius=0.03).urdf.encode())
    link = root.find("link[@name='object']")
    assert len(link.findall("visual")) == len(link.findall("collision")) == shapes
    for touched in link.findall("collision"):
        for part in ("geometry", "origin"):
            seen = link.find(f"visual/{part}")
            assert etree.tostring(touched.find(part)).split() == etree.tostring(seen).split()
