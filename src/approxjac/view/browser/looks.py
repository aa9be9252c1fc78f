"""What the two robots of a scene look like, worked out once for what they have in common."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from approxjac.robots import Robot
from approxjac.robots import urdf as urdf_xml
from approxjac.view.shapes import Look, robot_look


def looks_of(truth: Robot, belief: Robot | None) -> dict[str, Look]:
    """Return the look of the true and of the believed robot, by role.

    Links with the same <visual>s have the same shapes, the very same objects. That saves the page
    half its size, and a live view the time of simplifying meshes when only an object changes.
    """
    true = _look(truth, truth.urdf_dir)
    if belief is None:
        return {"true": true}
    common = _common(truth, belief)
    believed = _look(_boxed(belief, common), belief.urdf_dir) if common else robot_look(belief)
    shapes = dict(believed.shapes)
    for link in common:
        if link in true.shapes:
            shapes[link] = true.shapes[link]
    return {"true": true, "believed": Look(shapes, believed.missing)}


@functools.lru_cache(maxsize=8)
def _look(robot: Robot, folder: Path | None) -> Look:
    return robot_look(robot)


def _common(truth: Robot, belief: Robot) -> set[str]:
    """Links that look the same in both: by their <visual>s, not as capsules between joints."""
    if truth.urdf_dir != belief.urdf_dir:
        return set()
    own, other = _visuals(truth), _visuals(belief)
    missing = " ".join(_look(truth, truth.urdf_dir).missing)
    return {
        link
        for link, visuals in other.items()
        if visuals and visuals == own.get(link) and not _broken(visuals, missing)
    }


def _visuals(robot: Robot) -> dict[str, tuple[bytes, ...]]:
    from lxml import etree

    root = urdf_xml.parse(robot.urdf, robot.name)
    return {
        link.get("name"): tuple(
            etree.tostring(visual, method="c14n") for visual in link.iterfind("visual")
        )
        for link in root.iterfind("link")
    }


def _broken(visuals: tuple[bytes, ...], missing: str) -> bool:
    """Whether one of the meshes could not be shown, so that the link may be a capsule."""
    from lxml import etree

    names = [
        mesh.get("filename") for text in visuals for mesh in etree.fromstring(text).iter("mesh")
    ]
    return any(name in missing for name in names if name)


def _boxed(robot: Robot, links: set[str]) -> Robot:
    """The robot with boxes for what some links look like, so that no mesh is read for them."""
    from lxml import etree

    root = urdf_xml.parse(robot.urdf, robot.name)
    for link in root.iterfind("link"):
        if link.get("name") in links:
            for visual in link.findall("visual"):
                link.remove(visual)
            visual = etree.SubElement(link, "visual")
            box: Any = etree.SubElement(etree.SubElement(visual, "geometry"), "box")
            box.set("size", "0.01 0.01 0.01")
    return Robot(
        urdf_xml.to_text(root), gravity=robot.gravity, tip=robot.tip, urdf_dir=robot.urdf_dir
    )
