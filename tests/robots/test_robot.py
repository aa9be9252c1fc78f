import pickle

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.errors import UnknownNameError, UrdfError
from approxjac.robots import Dynamics, GravityRegressor, robot_names

MINIMAL = """
<robot name="minimal">
  <link name="base"/>
  <link name="arm">
    <inertial><origin xyz="0 0 0.5"/><mass value="1"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
    {visual}
  </link>
  <joint name="hinge" type="{kind}">
    <parent link="base"/><child link="{child}"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="{effort}" velocity="1"/>
  </joint>
</robot>
"""


def minimal(kind="revolute", child="arm", visual="", effort="5"):
    return MINIMAL.format(kind=kind, child=child, visual=visual, effort=effort)


# -- loading --------------------------------------------------------------------------------


def test_loads_by_name_path_and_text(tmp_path):
    by_name = aj.load_robot("two_link")
    path = tmp_path / "arm.urdf"
    path.write_text(by_name.urdf)
    assert aj.load_robot(path).joint_names == by_name.joint_names
    assert aj.load_robot(str(path)).joint_names == by_name.joint_names
    assert aj.load_robot(by_name.urdf) == aj.Robot(by_name.urdf)
    assert aj.load_robot("panda").tip == "panda_hand_tcp"
    assert aj.load_robot("panda").nq == aj.load_robot("panda").nv == 7
    kinova = aj.load_robot("kinova")
    assert (kinova.nq, kinova.nv) == (9, 6)


def test_configurations_are_the_same_each_time_and_all_different():
    kinova = aj.load_robot("kinova")
    drawn = np.array([*kinova.configurations(20)])
    assert_array_equal(drawn[:5], [*kinova.configurations(5)])
    assert len(np.unique(drawn, axis=0)) == 20
    rng = np.random.default_rng(0)
    assert_array_equal(drawn[0], kinova.random_configuration(rng))


def test_every_arm_starts_at_a_valid_neutral_and_random_configuration(arm, rng):
    assert pin.isNormalized(arm.model, arm.neutral())
    lower, upper = arm.position_limits
    assert (lower < upper).all()
    for _ in range(20):
        q = arm.random_configuration(rng)
        assert q.shape == (arm.nq,)
        assert pin.isNormalized(arm.model, q)
        motion = pin.difference(arm.model, arm.neutral(), q)
        assert (motion >= lower - 1e-12).all()
        assert (motion <= upper + 1e-12).all()
        assert_allclose(arm.configuration(arm.angles(q)), q, atol=1e-12)
    assert arm.angles(np.tile(q, (3, 2, 1))).shape == (3, 2, arm.nv)
    with pytest.raises(aj.InvalidInputError, match="q must have shape"):
        arm.angles(q[1:])


def test_a_zero_or_missing_effort_means_no_limit_known():
    assert np.isinf(aj.load_robot("double_pendulum").effort_limits).all()
    assert_allclose(aj.load_robot(minimal(effort="0")).effort_limits, [np.inf])
    assert_allclose(aj.load_robot(minimal(effort="5")).effort_limits, [5.0])


def test_limits_of_zero_width_mean_no_limit_known():
    lower, upper = aj.load_robot("double_pendulum").position_limits
    assert np.isneginf(lower).all()
    assert np.isposinf(upper).all()


@pytest.mark.parametrize("geometry", ["<capsule/>", '<mesh filename="a" scale="b"/>', ""])
def test_geometry_is_never_needed(geometry):
    visual = f"<visual><geometry>{geometry}</geometry></visual><collision/>"
    robot = aj.load_robot(minimal(visual=visual))
    assert robot.with_object(0.1, 0.2).nv == 1
    assert "<collision/>" in robot.urdf


def test_a_mesh_that_cannot_be_found_does_not_matter():
    mesh = '<visual><geometry><mesh filename="package://nowhere/arm.dae"/></geometry></visual>'
    robot = aj.load_robot(minimal(visual=mesh))
    assert robot.nv == 1
    assert robot.with_object(0.1, 0.2).mass == pytest.approx(1.2)


def test_every_name_loads():
    assert {"two_link", "panda", "ur5", "kinova"} < set(robot_names())
    assert all(aj.load_robot(name).nv >= 2 for name in robot_names())
    with pytest.raises(
        UnknownNameError, match="frame '' not in panda; likely tips are panda_hand_tcp, "
    ):
        aj.load_robot("panda", tip="")


def test_gravity_is_settable():
    robot = aj.load_robot("two_link", gravity=(0.0, 0.0, -1.62))
    assert_allclose(robot.gravity, [0.0, 0.0, -1.62])
    assert_allclose(robot.with_object(0.1).gravity, robot.gravity)
    assert_allclose(robot.with_gravity((1.0, 0.0, 0.0)).gravity, [1.0, 0.0, 0.0])
    assert_allclose(robot.gravity, [0.0, 0.0, -1.62])


def test_robots_are_values():
    a, b = aj.load_robot("two_link"), aj.load_robot("two_link")
    assert a == b
    assert hash(a) == hash(b)
    assert a.with_object(0.1) != a
    assert a.with_gravity((0.0, 0.0, 0.0)) != a
    assert a != "two_link"
    assert aj.load_robot("two_link", tip="link2") == a  # the tip is only a default
    copy = pickle.loads(pickle.dumps(a.with_object(0.1, axis="x")))
    assert copy == a.with_object(0.1, axis="x")
    with pytest.raises(ValueError, match="read-only"):
        a.gravity[0] = 1.0


def test_repr_says_what_it_is():
    text = repr(aj.load_robot("two_link"))
    assert text == "Robot('two_link': 2 joints joint1, joint2; tip 'tool0'; 4 kg)"


@pytest.mark.parametrize(
    ("source", "error", "text"),
    [
        ("pnada", UnknownNameError, "robot 'pnada' not in the robots known by name; did you me"),
        ("/nope", UrdfError, "URDF file /nope does not exist"),
        ("arm.xacro", UrdfError, "URDF file arm.xacro does not exist"),
        ("missing.urdf", UrdfError, "URDF file missing.urdf does not exist"),
        ("<robot name='r'><link", UrdfError, "URDF text is not well-formed XML"),
        ("<sdf/>", UrdfError, "must have <robot> as its root element, got <sdf>"),
        (
            minimal(kind="hinge"),
            UrdfError,
            "type of joint 'hinge' must be one of revolute,",
        ),
        (minimal(child="leg"), UrdfError, "joint 'hinge' refers to link 'leg', which does not"),
        (minimal(kind="fixed"), UrdfError, "URDF text has no moving joint"),
        (minimal(kind="planar"), UrdfError, "joint 'hinge' has 3 degrees of freedom"),
        (
            minimal().replace('<mass value="1"/>', '<mass value="one"/>'),
            UrdfError,
            "<mass value=...> of link 'arm' must be a finite number, got 'one'",
        ),
        (
            minimal().replace("<inertial>", "<!--").replace("</inertial>", "-->"),
            UrdfError,
            "nothing with inertia is moved by joint 'hinge' (the inertia matrix is singular)",
        ),
    ],
)
def test_bad_urdfs_are_refused(source, error, text):
    with pytest.raises(error) as caught:
        aj.load_robot(source)
    assert text in str(caught.value)
    assert caught.value.given is not None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (('<link name="base"/>', '<link name="arm"/>'), "two links are called 'arm'"),
        (('<link name="base"/>', '<link name="base"/><link name="lost"/>'), "one link without a"),
        (('xyz="0 1 0"', 'xyz="0 0 0"'), "the axis of joint 'hinge' is zero"),
        (('effort="5"', ""), "<limit effort=...> of joint 'hinge' must be a finite number, 0 if"),
        (('<limit lower="-1" upper="1" effort="5" velocity="1"/>', ""), "has no <limit>; with"),
        (('ixx="0.1"', 'ixx="-0.1"'), "the links moved by hinge have a negative mass or inertia"),
        (('value="1"', 'value="-1"'), "the links moved by hinge have a negative mass or inertia"),
        (('value="1"', 'value=" 1 "'), "<mass value=...> of link 'arm' must be a finite"),
        (('value="1"', 'value="1_0"'), "must be a finite number, got '1_0'"),
        (('<mass value="1"/>', ""), "<inertial> of link 'arm' has no <mass>"),
        (('<axis xyz="0 1 0"/>', "<axis/>"), "<axis xyz=...> of joint 'hinge' must be 3 finite"),
        (('name="minimal"', ""), "<robot> has no name"),
        (('<link name="base"/>', "<link/>"), "a <link> has no name"),
        (('<joint name="hinge"', "<joint"), "a <joint> has no name"),
        (('<parent link="base"/>', ""), "<joint> of joint 'hinge' has no <parent>"),
        (('xyz="0 1 0"', 'xyz="0 1"'), "<axis xyz=...> of joint 'hinge' must be 3 finite"),
        (('xyz="0 0 0.5"', 'xyz="0 0 nan"'), "<origin xyz=...> of link 'arm' must be 3 finite num"),
        (('ixy="0"', ""), "<inertia ixy=...> of link 'arm' must be a finite number, got None"),
        (('lower="-1"', 'lower="2"'), "the limits of joint 'hinge' are reversed"),
        (
            ("</robot>", '<joint name="again" type="fixed"><parent link="base"/><child link="arm"/>'
             "</joint></robot>"),
            "two joints have the child 'arm'",
        ),
        (
            ("</robot>", '<link name="a"/><link name="b"/>'
             '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
             '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'),
            "these links are not connected to 'base': a, b",
        ),
        (
            ("</robot>", '<xacro:arm xmlns:xacro="http://www.ros.org/wiki/xacro"/></robot>'),
            "holds <arm> of xacro: expand it first with the command xacro",
        ),
    ],
)  # fmt: skip
def test_faults_are_named(change, text):
    urdf = minimal()
    assert change[0] in urdf
    with pytest.raises(UrdfError) as caught:
        aj.load_robot(urdf.replace(*change))
    assert text in str(caught.value)


@pytest.mark.parametrize("source", [None, 5, b"<robot/>"])
def test_what_is_no_source_is_refused(source):
    with pytest.raises(
        aj.InvalidInputError, match="source must be a name, a path or URDF text, got"
    ):
        aj.load_robot(source)


def test_comments_encodings_and_instructions_are_taken(tmp_path):
    body = "<!-- first --><?note inside?>" + minimal().strip().replace("hinge", "gelänk")
    assert "<!-- first -->" in aj.load_robot(body).with_object(0.1).urdf
    path = tmp_path / "arm.urdf"
    for encoding, declaration in (
        ("utf-8", ""),
        ("utf-8-sig", ""),
        ("iso-8859-1", '<?xml version="1.0" encoding="ISO-8859-1"?>'),
    ):
        path.write_bytes((declaration + body).encode(encoding))
        assert aj.load_robot(path).joint_names == ("gelänk",)


def test_mimic_joints_are_locked_with_the_joint_they_follow():
    finger = """<link name="f{i}"><inertial><mass value="0.1"/><inertia ixx="1e-3" ixy="0" ixz="0"
      iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link><joint name="jf{i}" type="prismatic">
      <parent link="arm"/><child link="f{i}"/><axis xyz="1 0 0"/>
      <limit lower="0" upper="1" effort="1" velocity="1"/>{mimic}</joint>"""
    mimic = '<mimic joint="jf1" multiplier="-2" offset="0.1"/>'
    fingers = finger.format(i=1, mimic="") + finger.format(i=2, mimic=mimic)
    robot = aj.load_robot(minimal().replace("</robot>", fingers + "</robot>"))
    assert robot.joint_names == ("hinge", "jf1")
    locked = robot.with_locked_joints({"jf1": 0.3})
    assert locked.joint_names == ("hinge",)
    place = locked.model.frames[locked.frame_id("f2")].placement
    assert_allclose(place.translation, [-0.5, 0.0, 0.0], atol=1e-15)
    assert "mimic" not in locked.urdf
    # each to its own where both are given, and a fixed joint stays where it is
    own = robot.with_locked_joints({"jf1": 0.3, "jf2": 0.05})
    assert_allclose(own.model.frames[own.frame_id("f2")].placement.translation, [0.05, 0.0, 0.0])
    fixed = aj.load_robot(
        robot.urdf.replace('name="jf2" type="prismatic"', 'name="jf2" type="fixed"')
    )
    place = fixed.with_locked_joints({"jf1": 0.3}).model.frames[fixed.frame_id("f2")].placement
    assert_allclose(place.translation, np.zeros(3), atol=1e-15)


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "binary.urdf"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UrdfError, match="cannot be read"):
        aj.load_robot(path)


def test_a_branched_robot_needs_a_frame(panda):
    branched = aj.Robot(panda.urdf)
    assert branched.tip is None
    with pytest.raises(aj.InvalidInputError, match="frame must be named: panda has more than one"):
        aj.PositionTask(branched)


# -- objects --------------------------------------------------------------------------------


def test_an_object_has_the_inertia_of_a_uniform_cylinder(two_link):
    length, mass, radius = 0.4, 0.7, 0.05
    arm = aj.load_robot("two_link")
    held = arm.with_object(length, mass, radius=radius, axis="x")
    q = np.zeros(2)
    before, after = Dynamics(arm), Dynamics(held)
    about_joint2 = mass * (3 * radius**2 + length**2) / 12 + mass * (1.0 + length / 2) ** 2
    assert_allclose((after.M(q) - before.M(q))[1, 1], about_joint2, rtol=1e-12)
    assert held.mass == pytest.approx(arm.mass + mass)
    inertia = held.model.inertias[2] - arm.model.inertias[2]
    assert inertia.mass == pytest.approx(mass)
    assert_allclose(inertia.lever, [1.0 + length / 2, 0.0, 0.0])
    assert_allclose(inertia.inertia[0, 0], 0.5 * mass * radius**2, rtol=1e-9)


@pytest.mark.parametrize(
    ("axis", "direction"),
    [("x", (1, 0, 0)), ("-y", (0, -1, 0)), ("z", (0, 0, 1)), ("-z", (0, 0, -1)), ((3, 0, 4), None)],
)
def test_the_tip_lies_along_the_axis_and_keeps_the_orientation(panda, axis, direction, rng):
    direction = np.array((0.6, 0.0, 0.8) if direction is None else direction, dtype=float)
    held = panda.with_object(0.3, 0.5, axis=axis)
    model, data = held.model, held.model.createData()
    q = held.random_configuration(rng)
    pin.framesForwardKinematics(model, data, q)
    hand = data.oMf[held.frame_id("panda_hand_tcp")]
    tip = data.oMf[held.frame_id("object_tip")]
    offset = hand.rotation.T @ (tip.translation - hand.translation)
    assert_allclose(offset, 0.3 * direction, atol=1e-15)
    assert_allclose(tip.rotation, hand.rotation, atol=1e-14)
    # the centre of mass sits half-way, whatever the direction
    payload = model.inertias[7] - panda.model.inertias[7]
    in_joint = model.frames[held.frame_id("panda_hand_tcp")].placement.act(0.15 * direction)
    assert_allclose(payload.lever, in_joint, atol=1e-12)


def test_only_the_direction_of_an_axis_counts(panda):
    for size in (1e-200, 1.0, 1e200):
        tip = panda.with_object(0.3, axis=(0.0, size, 0.0))
        assert_allclose(
            aj.PositionTask(tip).value(np.zeros(7)),
            aj.PositionTask(panda.with_object(0.3, axis="y")).value(np.zeros(7)),
        )


def test_zero_length_and_zero_mass_are_legal(panda, rng):
    nothing = panda.with_object(0.0)
    q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
    for call in ("M", "g"):
        assert_allclose(
            getattr(Dynamics(nothing), call)(q), getattr(Dynamics(panda), call)(q), atol=1e-13
        )
    assert_allclose(Dynamics(nothing).coriolis(q, v), Dynamics(panda).coriolis(q, v))
    tip, hand = aj.PositionTask(nothing), aj.PositionTask(panda)
    assert tip.frame == "object_tip"
    assert_allclose(tip.value(q), hand.value(q), atol=1e-15)
    point = panda.with_object(0.0, 0.5, radius=0.0)
    assert point.mass == pytest.approx(panda.mass + 0.5)
    assert panda.with_object(0.2, 0.0).mass == pytest.approx(panda.mass)


def test_objects_can_be_stacked(panda):
    both = panda.with_object(0.1, 0.2).with_object(0.2, 0.1, axis="x", name="pen")
    assert both.tip == "pen_tip"
    assert both.mass == pytest.approx(panda.mass + 0.3)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"length": -0.1}, aj.InvalidInputError, "length must be a finite number >= 0 [m], got -0"),
        ({"mass": -1}, aj.InvalidInputError, "mass must be a finite number >= 0 [kg], got -1"),
        ({"mass": 1e300}, aj.InvalidInputError, "mass must be at most 10000 [kg], got 1e+300; 1e"),
        ({"radius": -1}, aj.InvalidInputError, "radius must be a finite number >= 0 [m], got -1"),
        ({"length": 1e308}, aj.InvalidInputError, "length must be at most 10 [m], got 1e+308; 1e+"),
        (
            {"radius": 11},
            aj.InvalidInputError,
            "radius must be at most 10 [m], got 11; 11 mm are 0.011",
        ),
        ({"length": np.nan}, aj.InvalidInputError, "length must be a finite number >= 0 [m], got"),
        ({"length": "long"}, aj.InvalidInputError, "got 'long'"),
        ({"axis": "w"}, UnknownNameError, "axis 'w' not in the axes; valid are -x, -y, -z, x,"),
        ({"axis": "xy"}, UnknownNameError, "axis 'xy' not in the axes; did you mean 'y' or"),
        ({"axis": (0, 0, 0)}, aj.InvalidInputError, "axis must not be zero"),
        ({"axis": (1, 0)}, aj.InvalidInputError, "axis must have shape (3,), got shape (2,)"),
        (
            {"parent": "panda_hnad"},
            UnknownNameError,
            "frame 'panda_hnad' not in panda; did you mean 'panda_hand'",
        ),
        ({"parent": "panda_joint4"}, UnknownNameError, "link 'panda_joint4' not in panda; did"),
        ({"name": "panda_hand"}, aj.InvalidInputError, "panda already has a frame 'panda_hand'"),
        (
            {"name": ""},
            aj.InvalidInputError,
            "name must be a text without spaces, such as 'object'",
        ),
        ({"name": 5}, aj.InvalidInputError, "name must be a text without spaces, such as 'object'"),
        ({"name": "a\0"}, aj.InvalidInputError, "name must be a text without spaces, such as"),
        (
            {"length": "0.5"},
            aj.InvalidInputError,
            "length must be a finite number >= 0 [m], got '0",
        ),
    ],
)
def test_bad_objects_are_refused(panda, arguments, error, text):
    with pytest.raises(error) as caught:
        panda.with_object(**{"length": 0.1, **arguments})
    assert text in str(caught.value)


# -- errors applied -------------------------------------------------------------------------


def test_kinematic_errors_move_joint_origins_and_nothing_else(panda):
    shift, turn = (0.01, -0.02, 0.03), (0.1, 0.2, -0.3)
    wrong = panda.with_kinematic_error({"panda_joint4": shift}, {"panda_joint4": turn})
    before, after = panda.model.jointPlacements, wrong.model.jointPlacements
    for i in range(8):
        if panda.model.names[i] == "panda_joint4":
            assert_allclose(after[i].translation, before[i].translation + shift, atol=1e-15)
            assert_allclose(after[i].rotation, before[i].rotation @ pin.exp3(np.array(turn)))
        else:
            assert_allclose(after[i].homogeneous, before[i].homogeneous, atol=1e-15)
    for a, b in zip(panda.model.inertias, wrong.model.inertias, strict=True):
        assert_allclose(a.toDynamicParameters(), b.toDynamicParameters(), atol=1e-14)


def test_kinematic_errors_reach_fixed_joints(two_link, rng):
    wrong = two_link.with_kinematic_error({"tool0_joint": (0.25, 0.0, 0.0)})
    q = np.zeros(2)
    moved = aj.PositionTask(wrong, axes="xz").value(q) - aj.PositionTask(two_link, axes="xz").value(
        q
    )
    assert_allclose(moved, [0.25, 0.0], atol=1e-14)


def test_no_error_is_the_same_robot_but_for_round_off(panda):
    nothing = dict.fromkeys(panda.joint_names, (0.0, 0.0, 0.0))
    same = panda.with_kinematic_error(nothing, nothing)
    for a, b in zip(panda.model.jointPlacements, same.model.jointPlacements, strict=True):
        assert_allclose(a.homogeneous, b.homogeneous, rtol=0, atol=4e-16)


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        (
            ({"panda_jiont4": (0, 0, 0)},),
            UnknownNameError,
            "joint 'panda_jiont4' not in panda; did you mean 'panda_joint4'",
        ),
        (
            ([1],),
            aj.InvalidInputError,
            "shifts must be a mapping from joint names to 3-vectors, got [1]",
        ),
        (
            ({"panda_joint4": (0, 0)},),
            aj.InvalidInputError,
            "shift of panda_joint4 must have shape (3,) [m], got shape (2,)",
        ),
        (
            ({}, {"panda_joint4": (0, 0, np.inf)}),
            aj.InvalidInputError,
            "rotation of panda_joint4 must be finite [rad], got [0.0, 0.0, inf]",
        ),
    ],
)
def test_bad_kinematic_errors_are_refused(panda, arguments, error, text):
    with pytest.raises(error) as caught:
        panda.with_kinematic_error(*arguments)
    assert text in str(caught.value)


def test_locked_joints_stay_where_they_are_put(panda, rng):
    angle = 0.7
    locked = panda.with_locked_joints({"panda_joint3": angle})
    assert locked.nv == 6
    assert "panda_joint3" not in locked.joint_names
    q = panda.random_configuration(rng)
    q[2] = angle
    without = np.delete(q, 2)
    assert_allclose(aj.PositionTask(locked).value(without), aj.PositionTask(panda).value(q))
    M = np.delete(np.delete(Dynamics(panda).M(q), 2, 0), 2, 1)
    assert_allclose(Dynamics(locked).M(without), M, atol=1e-12)


def test_prismatic_joints_lock_along_their_axis():
    text = minimal(kind="prismatic").replace("</robot>", "") + (
        '<link name="tool"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" '
        'iyz="0" izz="1"/></inertial></link><joint name="wrist" type="continuous">'
        '<parent link="arm"/><child link="tool"/></joint></robot>'
    )
    locked = aj.load_robot(text).with_locked_joints({"hinge": 0.4})
    assert locked.joint_names == ("wrist",)
    assert_allclose(locked.model.jointPlacements[1].translation, [0.0, 0.4, 0.0])


def test_bad_locks_are_refused(panda):
    with pytest.raises(UnknownNameError, match="moving joint 'panda_joint8' not in panda; did"):
        panda.with_locked_joints({"panda_joint8": 0.0})
    with pytest.raises(aj.InvalidInputError, match="position of panda_joint3 must be a finite"):
        panda.with_locked_joints({"panda_joint3": np.nan})


PENDULUM = """<robot name="pendulum"><link name="base"/><link name="tip"/>
<link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="50" velocity="10"/></joint>
<joint name="t" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="1 0 0"/></joint>
</robot>"""


@pytest.mark.parametrize("learnt", [False, True])
def test_an_arm_of_one_joint_reaches_its_target(learnt):
    """Pinocchio's Jacobian and regressor of one joint have one axis less; ours have not."""
    robot = aj.Robot(PENDULUM)
    task = aj.PositionTask(robot, axes="z")
    assert task.jacobian(np.array([0.3])).shape == (1, 1)
    assert task.jacobian_dot(np.array([0.3]), np.ones(1)).shape == (1, 1)
    regressor = GravityRegressor(robot)
    gravity = aj.AdaptiveGravity(regressor, theta0=np.zeros(regressor.p)) if learnt else None
    controller = aj.SetpointController(task, gravity=gravity)
    plant = aj.Plant(robot, aj.PositionTask(robot, axes="z"))
    run = aj.simulate(plant, controller, (0.2,), (0.3,), 8.0, dt=5e-3)
    assert abs(run.error[-1, 0]) < 1e-3


@pytest.mark.parametrize("name", ["position_limits", "usual_range"])
def test_ranges_that_are_computed_once_cannot_be_changed(name):
    robot = aj.load_robot("ur5")
    limits = getattr(robot, name)
    assert limits is getattr(robot, name)
    with pytest.raises(ValueError, match="read-only"):
        limits[0][0] = 0.0
    with pytest.raises(aj.InvalidInputError, match=f"{name} of a Robot cannot be changed"):
        setattr(aj.load_robot("panda"), name, limits)
