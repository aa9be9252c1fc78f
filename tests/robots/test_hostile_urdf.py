"""URDFs that are huge, odd or of other tools: quick, and loaded or refused by name."""

import time

import pytest

import approxjac as aj
from approxjac.robots.load import implausible
from approxjac.robots.urdf import Urdf

INERTIA = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
QUICK = 2.0  # s; the worst takes 0.4 s, and took 15 s and more


def link(name, mass=1.0):
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{INERTIA}</inertial></link>'


def joint(name, parent, child, kind="revolute", mimic="", effort=1.0):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>'
        f'<limit effort="{effort}" velocity="1" lower="-1" upper="1"/>{mimic}</joint>'
    )


def robot(*parts):
    return f'<robot name="r">{"".join(parts)}</robot>'


def chain(n, kind="revolute", effort=1.0, mass=lambda i: 1.0 + i / 1000):
    """n joints in a row; the first always moves."""
    links = [link(f"l{i}", mass(i)) for i in range(n + 1)]
    kinds = ["revolute", *[kind] * (n - 1)]
    joints = [joint(f"j{i}", f"l{i}", f"l{i + 1}", kinds[i], effort=effort) for i in range(n)]
    return robot(*links, *reversed(joints))  # in an order that does not help


def star(n, kind):
    joints = [joint(f"j{i}", "l0", f"l{i}", kind if i > 1 else "revolute") for i in range(1, n)]
    return robot(*[link(f"l{i}", 1.0 + i / 1000) for i in range(n)], *joints)


def with_first(text):
    """Two links, of which the first has a text inside its tag."""
    return chain(2).replace('<link name="l0"', f'<link name="l0" {text}', 1)


def with_inside(text):
    """Two links, the first of which holds a text."""
    return chain(2).replace('<link name="l0">', f'<link name="l0">{text}', 1)


def with_mass(text):
    return chain(2).replace('<mass value="1.0"/>', f'<mass value="{text}"/>', 1)


REFUSED = {
    "digits": (lambda: with_mass("1" * 20_000), "must be a finite number, got '111"),
    "digits, then none": (lambda: with_mass("1" * 20_000 + "x"), "must be a finite number"),
    "fractions": (lambda: with_mass("1." + "0" * 20_000), "must be a finite number"),
    "many numbers": (
        lambda: chain(2).replace("0 1 0", "0 " * 100_000, 1), "must be 3 finite numbers"
    ),
    "attributes": (
        lambda: with_first(" ".join(f'a{i}="1"' for i in range(50_000))),
        "must have at most 100 attributes, got 50001",
    ),
    "a chain": (lambda: chain(10_000), "it has 10001 links; there may be at most 2000"),
    "a chain of fixed joints": (lambda: chain(10_000, "fixed"), "it has 10001 links"),
    "a star": (lambda: star(20_000, "fixed"), "it has 20000 links"),
    "joints that move": (lambda: chain(1000), "at most 150 joints that move, got 1000"),
    "joints without links": (
        lambda: robot(link("l0"), *[joint(f"j{i}", "l0", "l0") for i in range(20_000)]),
        "it has 20000 joints",
    ),
    "a long text": (lambda: chain(2) + " " * 20_000_000, "at most 16000000 characters, got 200"),
    "deep": (lambda: with_inside("<a>" * 5000 + "</a>" * 5000), "not well-formed XML"),
    "entities of entities": (
        lambda: "<!DOCTYPE r [<!ENTITY a0 'aaaaaaaaaaaaaaaaaaaaaaaaa'>"
        + "".join(f"<!ENTITY a{i + 1} '{f'&a{i};' * 10}'>" for i in range(9))
        + f"]>{with_inside('&a9;')}",
        "not well-formed XML",
    ),
    "a file of the machine": (
        lambda: f"<!DOCTYPE r [<!ENTITY a SYSTEM 'file:///etc/passwd'>]>{with_inside('&a;')}",
        "not well-formed XML",
    ),
    "half a character": (lambda: with_first('x="\ud800"'), "not well-formed XML"),
    "many prefixes": (
        lambda: with_inside("".join(f"<p{i}:a/>" for i in range(50_000))), "not well-formed XML"
    ),
    "mimic joints in a row": (
        lambda: robot(
            *[link(f"l{i}") for i in range(1999)],
            *[
                joint(f"j{i}", f"l{i}", f"l{i + 1}", mimic=f'<mimic joint="j{i - 1}"/>' * (i > 0))
                for i in range(1998)
            ],
        ),
        "at most 150 joints that move",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_would_take_forever_is_refused_at_once(name):
    text, told = REFUSED[name][0](), REFUSED[name][1]
    start = time.process_time()
    with pytest.raises(aj.errors.UrdfError, match=told) as caught:
        aj.load_robot(text)
    assert time.process_time() - start < QUICK
    assert len(str(caught.value)) < 300


LARGE = {
    "a chain": (lambda: chain(1900, "fixed"), {}),
    "a star": (lambda: star(1900, "fixed"), {"tip": "l1"}),
    "a star that moves, locked": (lambda: star(1900, "revolute"), {"tip": "l3"}),
    "comments": (lambda: with_inside("<!-- x -->" * 100_000), {}),
    "depth": (lambda: with_inside("<a>" * 200 + "</a>" * 200), {}),
    "shapes": (lambda: with_inside("<visual/>" * 100_000), {}),
}


@pytest.mark.study
@pytest.mark.parametrize("name", LARGE)
def test_what_is_large_loads_and_is_written_quickly(name, tmp_path):
    text, options = LARGE[name]
    start = time.process_time()
    arm = aj.load_robot(text(), **options)
    arm.with_object(0.1, 0.2, parent="l1").save_urdf(tmp_path / "arm.urdf")
    assert time.process_time() - start < QUICK
    assert aj.load_robot(tmp_path / "arm.urdf").nv == arm.nv


def test_a_file_that_is_too_long_is_not_read(tmp_path):
    path = tmp_path / "arm.urdf"
    with path.open("wb") as file:
        file.truncate(1_000_000_000)
    with pytest.raises(aj.errors.UrdfError, match="at most 16000000 bytes, got 1000000000"):
        aj.load_robot(path)


def test_namespaces_that_nobody_declared_are_declared(tmp_path):
    """As in files for Drake: elements and attributes of its own, without xmlns:drake."""
    rotor = '<drake:joint name="d" type="x"><drake:rotor value="1"/></drake:joint>'
    text = f"<?xml version='1.0'?>\n<!-- an arm <robot --> {with_inside(rotor)}"
    text = text.replace('<link name="l1"', '<link acme:id="7" name="l1"', 1)
    arm = aj.load_robot(text)
    assert arm.joint_names == ("j0", "j1")
    path = arm.with_object(0.1).save_urdf(tmp_path / "arm.urdf")
    saved = path.read_text()
    assert 'xmlns:drake="urn:drake"' in saved
    assert '<drake:rotor value="1"/>' in saved
    assert 'acme:id="7"' in saved
    assert aj.load_robot(path).joint_names == arm.joint_names
    assert Urdf.parse(arm.urdf, "again").links == ("l0", "l1", "l2")


def test_of_two_prefixes_only_the_missing_one_is_declared():
    text = with_inside("<b:y/><a:x/>").replace("<robot", '<robot xmlns:b="urn:other"', 1)
    root = aj.load_robot(text).tree.root
    assert root.nsmap == {"b": "urn:other", "a": "urn:a"}


def test_xacro_without_a_namespace_is_still_told():
    with pytest.raises(aj.errors.UrdfError, match="expand it first"):
        aj.load_robot(with_inside("<xacro:include x='1'/>"))


# -- placeholders ---------------------------------------------------------------------------


def test_links_that_are_all_alike_are_placeholders():
    text = chain(6, mass=lambda i: 2.0)
    with pytest.warns(aj.errors.ImplausibleRobotWarning) as caught:
        aj.load_robot(text)
    (warning,) = caught
    assert "6 of 6 joints, j0 first, has the same mass of 2 kg" in str(warning.message)
    assert warning.filename == __file__


def test_efforts_that_no_such_arm_needs_are_placeholders():
    text, names = chain(6, effort=50_000, mass=lambda i: 1.5 + 0.2 * i), [f"j{i}" for i in range(6)]
    with pytest.warns(aj.errors.ImplausibleRobotWarning, match="effort limit of 50000") as caught:
        arm = aj.load_robot(text)
    assert len(caught) == 1
    assert all(f"joint {name} " in each for name, each in zip(names, implausible(arm), strict=True))
    assert (arm.effort_limits == 50_000).all()  # it is loaded as it says
    assert implausible(aj.load_robot(text.replace('effort="50000"', 'effort="500"'))) == []


def test_grams_are_no_kilograms():
    """An arm that reaches 1.5 m, of aluminium through and through, would weigh some 5 t."""
    text = chain(6, mass=lambda i: 6900.0 + 100.0 * i)
    with pytest.warns(aj.errors.ImplausibleRobotWarning, match="joint j0 has 7000 kg, of an arm"):
        arm = aj.load_robot(text)
    assert len(implausible(arm)) == 6
    light = aj.load_robot(chain(6, effort=50, mass=lambda i: 6.9 + 0.1 * i))
    assert implausible(light) == []


@pytest.mark.parametrize("name", aj.robots.robot_names())
def test_nothing_is_said_of_arms_that_load_by_name(name):
    assert implausible(aj.load_robot(name)) == []


# -- which end, and which base --------------------------------------------------------------


def test_of_several_ends_those_called_like_tips_are_offered_first():
    names = ("camera", "knee_link", "tool0", "finger_tool", "ee_link", "left_gripper")
    fixed = [joint(f"f_{name}", "l2", name, "fixed") for name in names]
    text = chain(2).replace("</robot>", "".join([*map(link, names), *fixed, "</robot>"]))
    told = "likely tips are tool0, ee_link, left_gripper, camera, knee_link, finger_tool$"
    with pytest.raises(aj.InvalidInputError, match=told):
        aj.PositionTask(aj.load_robot(text))


def test_of_many_ends_only_some_are_told():
    with pytest.raises(aj.InvalidInputError, match=r"likely tips are l1, .*, l12 and 7 more$"):
        aj.PositionTask(aj.load_robot(star(20, "revolute")))


@pytest.mark.parametrize("kind", ["planar", "floating"])
def test_a_base_that_moves_is_told_with_the_remedy(kind):
    text = chain(3).replace('name="j0" type="revolute"', f'name="j0" type="{kind}"')
    with pytest.raises(aj.errors.UrdfError, match=r"with tip=\.\.\. and base='l1'"):
        aj.load_robot(text)
    assert aj.load_robot(text, tip="l3", base="l1").joint_names == ("j1", "j2")
