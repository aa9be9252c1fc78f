"""The arms that tests run over: five that stand for the others, which have a marker."""

from xml.etree import ElementTree

import pytest

import approxjac as aj
from approxjac.robots.load import NAMED

# planar; seven joints; six, outwards in another frame; continuous joints; joints that mimic others
REPRESENTATIVE = ("two_link", "panda", "ur5", "kinova", "tiago_arm")


def among(*names):
    """Return parameters of a test for these arms; all but the representative have a marker."""
    return [
        pytest.param(name, marks=[] if name in REPRESENTATIVE else pytest.mark.every_arm, id=name)
        for name in names
    ]


ARMS = among(*sorted(NAMED))
# for tests that take a second on each: one more, on which nothing was tuned; the others are `long`
SEVERAL = [
    arm
    if arm.id in (*REPRESENTATIVE, "so100")
    else pytest.param(arm.id, marks=(pytest.mark.every_arm, pytest.mark.long), id=arm.id)
    for arm in ARMS
]
# by default two of them: for tests that take long on each
FEW = [
    arm
    if arm.marks or arm.id in REPRESENTATIVE[::4]
    else pytest.param(arm.id, marks=pytest.mark.study, id=arm.id)
    for arm in SEVERAL
]


def light_wristed(folder, name="ur5"):
    """Write the URDF of a UR arm whose wrist has a hundredth of its inertia, as real ones have."""
    tree = ElementTree.fromstring(aj.load_robot(name).urdf)
    for link in tree.findall("link"):
        if link.get("name").startswith("wrist"):
            inertia = link.find("inertial/inertia")
            for key, value in inertia.attrib.items():
                inertia.set(key, f"{float(value) / 100.0}")
    path = folder / "light_wrist.urdf"
    path.write_text(ElementTree.tostring(tree, encoding="unicode"), encoding="utf-8")
    return path
