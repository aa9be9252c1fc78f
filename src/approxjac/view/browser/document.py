"""The page itself: one HTML file with all that it needs inside."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from approxjac.cameras import Camera, PinholeCamera
from approxjac.extras import package_of
from approxjac.simulation import Trajectory
from approxjac.simulation.trajectory import Scene
from approxjac.tasks.analysis import features, image_feature
from approxjac.validation import Array
from approxjac.view.browser.stage import Stage, grid
from approxjac.view.browser.view_direction import link_points, viewpoint
from approxjac.view.learnt import learnt_regressor
from approxjac.view.style import COLORS, SERIES, display_unit
from approxjac.view.tree import held_objects

_SCRIPTS = ("uPlot.iife.min.js", "scene.js", "plots.js", "image.js", "page.js")
_TIPS = ("believed tip", "learnt tip")  # the second where it moves as it is learnt
_BUNDLED = "dist/main.min.js."
_LICENCES = ("LICENSE", f"{_BUNDLED}LICENSE.txt", f"{_BUNDLED}THIRD_PARTY_LICENSES.json")
_MARKER = 0.03  # radius of the largest marker, of the arm's size
_ROOM = 0.35  # to all sides, for targets of a live page that are yet to come, of the arm's size


def _belief_facts(scene: Scene) -> list[tuple[str, str]]:
    """Return the lengths of held objects that the controller has wrong: names and texts."""
    true, believed = held_objects(scene.truth), held_objects(scene.belief or scene.truth)
    return [
        (name, f"{true.get(name, 0.0):.3g} m long, believed {believed.get(name, 0.0):.3g} m")
        for name in true | believed
        if abs(true.get(name, 0.0) - believed.get(name, 0.0)) > 1e-6
    ]


def page_data(
    stage: Stage,
    run: Trajectory,
    columns: Mapping[str, Array],
    q: Array,
    title: str | None = None,
    facts: Sequence[tuple[str, str]] = (),
    *,
    live: bool = False,
) -> dict[str, Any]:
    """Return the contents of a page, for `document`.

    It shows the `Frames.columns` of a run at configurations q (N, nq), and further facts, each a
    name and a text. A live page gets instants while it is open, and its targets can be dragged.
    """
    scene = stage.scene
    is_known = scene.knows_truth and scene.belief is not None
    believed = ", and what its controller believes of it" if is_known else ""
    ends = [columns[name][[0, -1]] for name in ("tip", "target", "believed_tip")]
    moving = np.concatenate([*ends, columns["tip"]])
    seen = [link_points(robot, q, stage.boxes[role]) for role, robot in stage.robots.items()]
    seen += [f.points for f in features(scene.sensor) if f.camera is not None and f.frame is None]
    seen.append(moving[np.isfinite(moving).all(axis=1)])
    if live:
        around = _ROOM * stage.size * np.concatenate([np.eye(3), -np.eye(3)])
        seen.append(columns["tip"][-1:] + around)
    points = np.concatenate(seen)
    view = viewpoint(scene.truth, moving, points, stage.cameras, _MARKER * stage.size)
    data = stage.data()
    data["commands"] += grid(view["normal"], points, stage.ground)
    image, axes = image_feature(scene.sensor), None
    if image is not None and image.camera is not None:
        seen_by = "seen" if scene.knows_truth else "seen, by the belief"
        axes = _image_axes(image.camera) | {"points": len(image.points), "seen": seen_by}
    return data | {
        "title": title or scene.truth.name + believed,
        "facts": [*_belief_facts(scene), *facts],
        "tip": _TIPS[learnt_regressor(scene) is not None],
        "legend": _legend(scene, axes is not None),
        "live": live,
        "colours": COLORS,
        "size": stage.size,
        "view": {name: np.round(view[name], 4).tolist() for name in ("direction", "points")},
        "image": axes,
        "plots": _plots(scene, list(run.task_labels), run.task_units),
        "jointNames": list(scene.truth.joint_names),
        # base64 of little-endian float32, which the page reads without parsing
        "columns": {
            name: base64.b64encode(np.asarray(column, dtype="<f4").tobytes()).decode()
            for name, column in columns.items()
        },
        "shapes": {name: list(np.shape(column)[1:]) for name, column in columns.items()},
    }


def document(data: Mapping[str, Any], *scripts: str) -> str:
    """Return the HTML of a page of `page_data`, which runs scripts after its own."""
    package_of("view", "meshcat")  # for its error
    viewer = resources.files("meshcat") / "viewer"
    code = [(viewer / "dist" / "main.min.js").read_text(encoding="utf-8")]
    code += [*map(asset, _SCRIPTS), *scripts]
    licences = ["uPlot:\n\n" + asset("uPlot.LICENSE")]  # which ask to be handed on
    for name in filter(lambda name: (viewer / name).is_file(), _LICENCES):
        licences.append(f"MeshCat, {name}:\n\n{(viewer / name).read_text(encoding='utf-8')}")
    # "</script" would end the element that it stands in, and "<!--" change how it is read
    values = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    ended = [part.replace("</script", "<\\/script") for part in code]
    alarm = str(data.get("alarm", ""))
    facts = [f"{name}: {said}" for name, said in data["facts"]]
    parts = {
        "title": html.escape(str(data["title"])),
        "alarm": html.escape(alarm),
        "description": html.escape("; ".join([alarm] * bool(alarm) + facts)),
        "css": asset("uPlot.min.css") + asset("page.css"),
        "data": values,
        "licences": "\n\n".join(licences).replace("<", "(").replace(">", ")"),
        "scripts": "\n".join(f"<script>{part}</script>" for part in ended),
    }
    return filled("page.html", parts)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """Return an asset with parts in place of their names, {{name}}."""
    # all at once: parts are not looked at again
    return re.sub(r"{{(\w+)}}", lambda found: parts[found[1]], asset(template))


def _legend(scene: Scene, image: bool) -> list[tuple[str, str, str, str]]:
    """Return the meaning of colours: what, colour, kind of mark ("" is a dot) and words.

    The page shows those of what occurs in it.
    """
    held, believes = bool(held_objects(scene.truth)), scene.belief is not None
    ghost = "arm and camera as the controller believes them"
    ghost = ghost if image else "the arm as the controller believes it"
    known = scene.knows_truth
    entries = (
        (True, "arm", "bar", "the arm as it is" if known else "the arm as believed"),
        (held, "object", "bar", "object that it holds"),
        (believes, "believed", "bar", ghost),
        (believes, "believed_tip", "", _TIPS[learnt_regressor(scene) is not None]),
        (True, "true", "", f"{'true tip' if known else 'tip by the belief'} and its path"),
        (any(feature.axes for feature in features(scene.sensor)),
         "measured", "", "measured tip" + ", where it differs" * known),
        (True, "target", "", "target, line of sight" if image else "target"),
        (scene.task is not None, "force", "dash", "force that the control means to exert"),
        (np.isfinite(scene.torque_limits).any(),
         "saturated", "bar", "link whose torque is at its limit"),
        (np.isfinite(np.array(scene.truth.position_limits)).any(),
         "at_limit", "bar", "link whose joint is at a position limit"),
    )  # fmt: skip
    return [
        (what, COLORS["believed" if what == "believed_tip" else what], mark, words)
        for shown, what, mark, words in entries
        if shown
    ]


def _plots(scene: Scene, labels: list[str], units: Sequence[str]) -> list[dict[str, Any]]:
    """Return the plots beside the scene; names, units and colours as in `approxjac.view`."""
    shown = " or ".join(dict.fromkeys(display_unit(unit)[0] for unit in units))
    known = bool(np.isfinite(scene.torque_limits).any())
    kinds = {"rad": "N m", "m": "N"}.items()
    torque = " or ".join(name for unit, name in kinds if unit in scene.truth.joint_units)
    joints = list(scene.truth.joint_names)
    first = joints[0].partition("_")[0] + "_"
    if len(joints) > 1 and all(name.startswith(first) for name in joints):
        # panda_joint1 is joint1 here, where there is little room
        joints = [name.removeprefix(first) for name in joints]
    plots = [
        ("error", "Task error of each coordinate", f"error [{shown}]", labels, [0.0]),
        ("torque", "Torque of each joint", "τ / limit" if known else f"τ [{torque}]", joints,
         [-1.0, 1.0] if known else []),
        ("V", "Lyapunov function", "V [J]", ["V"], []),
    ]  # fmt: skip
    names = ("column", "title", "unit", "labels", "lines")
    return [dict(zip(names, plot, strict=True)) | {"colours": SERIES} for plot in plots]


def _image_axes(camera: Camera) -> dict[str, Any]:
    """Return names, unit and borders of the image's coordinates, as they are plotted."""
    unit, scale = display_unit(camera.unit)
    axes = {"labels": list(camera.labels), "unit": unit, "scale": scale}
    if isinstance(camera, PinholeCamera):  # whose v points down
        width, height = camera.size
        return axes | {"border": [-0.5, -0.5, width - 0.5, height - 0.5], "down": True}
    return axes | {"border": None, "down": False}


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    file = resources.files("approxjac.view.browser") / "assets" / name
    return file.read_text(encoding="utf-8")
