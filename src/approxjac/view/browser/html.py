"""The page itself: one HTML file with all that it needs inside."""

from __future__ import annotations

import base64
import html
import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus, Status
from approxjac.simulation import Trajectory
from approxjac.simulation.scene import Scene
from approxjac.tasks.analysis import features
from approxjac.validation import Array, require
from approxjac.view.browser.cameras import image_axes
from approxjac.view.browser.frames import Frames, display_unit
from approxjac.view.browser.opening import open_browser
from approxjac.view.browser.stage import Stage
from approxjac.view.browser.viewpoint import link_points, reach_points, viewpoint
from approxjac.view.packages import view_package
from approxjac.view.style import COLORS, SERIES
from approxjac.view.tree import robot_joints

_USUAL = (Status.OK, Status.MEASUREMENT_HELD, LimitStatus.UNLIMITED, LimitStatus.FREE)
_RATE = 60.0  # frames of a second, at most
_FRAMES = 1000  # of a run, at most
_BACKGROUND = (np.array([[253, 253, 254], [241, 243, 245]]) / 255.0).tolist()  # top, bottom
_BELIEVED = ", and what its controller believes of it"
_SCRIPTS = ("scene.js", "plots.js", "image.js", "page.js")


def page(run: Trajectory, *, title: str | None = None) -> str:
    """Return a run as one HTML page that needs nothing else, no network either.

    The page shows at most 60 instants a second and 1000 in all, the first and the last among
    them. Torques and shares of limits are the largest since the instant shown before.

    Args:
        run: The run.
        title: Of the page; by default the name of the robot and what it does.

    Raises:
        InvalidInputError: A run that does not know who took part in it.
        MissingPackageError: meshcat is not installed.
    """
    require("run", run, Trajectory, "a Trajectory, as simulate returns it")
    if run.scene is None:
        raise InvalidInputError(
            "run must have a scene, to know which robots to draw: take one that "
            "approxjac.simulate returned, or give dataclasses.replace(run, scene=Scene(...))",
            given=run,
        )
    kept = _thinned(run.t)
    frames = Frames(run.scene, run.task_units)
    columns = frames.columns(*recorded(run, kept))
    data = page_data(
        Stage(run.scene),
        columns,
        q=run.q[kept],
        title=title or _title(run.scene),
        facts=[*_belief(run.scene), *_facts(run)],
        task_labels=run.task_labels,
        task_units=run.task_units,
    )
    return document(data)


def _title(scene: Scene) -> str:
    return scene.truth.name + ("" if scene.belief is None else _BELIEVED)


def _belief(scene: Scene) -> list[tuple[str, str]]:
    """In which lengths the controller is wrong, in a few words."""
    if scene.belief is None:
        return []
    lengths = [
        {joint.name: float(np.linalg.norm(joint.origin[:3, 3])) for joint in robot_joints(r)}
        for r in (scene.truth, scene.belief)
    ]
    said = []
    for name in dict.fromkeys([*lengths[0], *lengths[1]]):
        true, believed = (found.get(name, 0.0) for found in lengths)
        if name.endswith("_tip_joint") and abs(true - believed) > 1e-6:
            held = name.removesuffix("_tip_joint")
            said.append((held, f"{true:.3g} m long, believed {believed:.3g} m"))
    return said


def live_page(stage: Stage, columns: Mapping[str, Array], q: Array) -> str:
    """Return a page of a scene that is told over a WebSocket what there is to show.

    Args:
        stage: The scene, drawn.
        columns: What `Frames.columns` returned of one instant.
        q: The configuration then, shape (1, nq).
    """
    title = _title(stage.scene)
    data = page_data(stage, columns, q=q, title=title, facts=_belief(stage.scene), live=True)
    return document(data, [_asset("live.js")])


def recorded(run: Trajectory, kept: Any = slice(None)) -> tuple[Array, ...]:
    """What `Frames.columns` takes, of instants of a run; torques are peaks in between."""
    tau = run.tau if isinstance(kept, slice) else _peaks(run.tau, kept)
    task_torque = run.task_torque[kept]
    measured, x_d = run.x_measured[kept], run.x_d[kept]
    return (
        run.t[kept], run.q[kept], measured, x_d, run.error[kept], tau, task_torque, run.V[kept],
    )  # fmt: skip


def page_data(
    stage: Stage,
    columns: Mapping[str, Array],
    *,
    q: Array | None = None,
    title: str,
    facts: Sequence[tuple[str, str]] = (),
    task_labels: Sequence[str] | None = None,
    task_units: Sequence[str] | None = None,
    live: bool = False,
) -> dict[str, Any]:
    """Return what a page is made of, for `document`.

    Args:
        stage: The scene, drawn.
        columns: What `Frames.columns` returned, of any number of instants.
        q: Configurations of the same instants, shape (N, nq), to look at the right place; none
            looks at all that the arm reaches.
        title: Of the page.
        facts: What to say above it, each a name and a text.
        task_labels: Names of the error's coordinates; those of the sensor by default.
        task_units: Their units; those of the sensor by default.
        live: Whether instants come in while the page is open, and targets can be dragged.
    """
    scene = stage.scene
    if scene.sensor is not None:
        task_labels, task_units = (
            task_labels or scene.sensor.labels,
            (task_units or scene.sensor.units),
        )
    frames = Frames(scene, tuple(task_units or ()))
    data = stage.data()
    watched = [f.points for f in features(scene.sensor) if f.camera is not None and f.frame is None]
    if q is None or len(q) == 0:
        moving = reach_points(scene.truth)
        points = np.concatenate([moving, *watched])
    else:
        named = ("tip", "target", "believed_tip")
        moving = np.concatenate([columns[name][[0, -1]] for name in named])
        moving = np.concatenate([moving, columns["tip"]])
        shown = moving[np.isfinite(moving).all(axis=1)]
        arms = [link_points(scene.truth, q, stage.boxes["true"])]
        if scene.belief is not None:
            arms.append(link_points(scene.belief, q, stage.boxes["believed"]))
        room = []
        if live:  # for targets that are yet to come
            room = [
                columns["tip"][-1:] + 0.35 * stage.size * way for way in (*np.eye(3), *-np.eye(3))
            ]
        points = np.concatenate([*arms, *watched, shown, *room])
    view = viewpoint(scene.truth, moving, points, stage.cameras)
    data["commands"] += stage.grid(view["normal"], points)
    image = None
    if frames.image is not None and frames.image.camera is not None:
        image = image_axes(frames.image.camera) | {"points": len(frames.image.points)}
    data |= {
        "title": title,
        "facts": [list(fact) for fact in facts],
        "legend": _legend(scene, frames.image is not None),
        "live": live,
        "colours": COLORS,
        "background": _BACKGROUND,
        "size": stage.size,
        "view": {
            "direction": view["direction"].tolist(),
            "points": np.round(view["points"], 4).tolist(),
        },
        "image": image,
        "plots": _plots(scene, list(task_labels or ()), list(task_units or ())),
        "jointNames": list(scene.truth.joint_names),
        "columns": {name: _packed(column) for name, column in columns.items()},
        "shapes": {name: list(np.shape(column)[1:]) for name, column in columns.items()},
    }
    return data


def document(data: Mapping[str, Any], scripts: Sequence[str] = ()) -> str:
    """Return the HTML of a page.

    Args:
        data: What `page_data` returned.
        scripts: JavaScript to run after the page's own.
    """
    own = [_asset(name) for name in ("uPlot.iife.min.js", *_SCRIPTS)]
    code = [_meshcat_js(), *own, *scripts]
    # "</script" would end the element that it stands in, and "<!--" change how it is read
    values = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "title": html.escape(str(data["title"])),
        "description": html.escape("; ".join(f"{name}: {said}" for name, said in data["facts"])),
        "css": _asset("uPlot.min.css") + _asset("page.css"),
        "data": values,
        "licences": _licences(_asset("uPlot.LICENSE")),
        "scripts": "\n".join(_script(part) for part in code),
    }
    # all at once: what is put in is not looked at again
    return re.sub(r"{{(\w+)}}", lambda found: parts[found[1]], _asset("page.html"))


def save_page(run: Trajectory, path: str | Path, title: str | None = None) -> Path:
    """Write a run as a page for a web browser: the arm in motion and its plots.

    The page is one file that needs nothing else, no network either. It shows at most 60 instants a
    second, and 1000 in all.

    Args:
        run: The run.
        path: File to write.
        title: Of the page; says whose arm it is by default.

    Returns:
        The path written.

    Raises:
        InvalidInputError: A run without `scene`, or a file that cannot be written.
        MissingPackageError: The package meshcat is not installed.
    """
    require("path", path, (str, Path), "the name of a file")
    path, text = Path(path), page(run, title=title)
    try:
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InvalidInputError(
            f"path must be a file that can be written, got {path}: {error}", given=path
        ) from error
    return path


def show(run: Trajectory, title: str | None = None) -> Path:
    """Open a run's page (`save_page`) in a web browser.

    Where there is none, a line is printed that says where the page is.

    Args:
        run: The run.
        title: Of the page.

    Returns:
        The temporary file that holds the page.

    Raises:
        InvalidInputError: A run without `scene`.
        MissingPackageError: The package meshcat is not installed.
    """
    text = page(run, title=title)
    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", prefix="approxjac-", suffix=".html", delete=False
    ) as file:
        file.write(text)
    path = Path(file.name)
    if not open_browser(path.as_uri()):
        print(f"No browser could be opened here: the page is {path}")
    return path


def _thinned(t: Array) -> Any:
    """Indices of the instants that the page shows, the first and the last among them."""
    duration = float(t[-1] - t[0])
    count = min(len(t), _FRAMES, max(2, round(duration * _RATE) + 1))
    if count == len(t):
        return np.arange(len(t))
    wanted = np.linspace(t[0], t[-1], count)
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), wanted)
    return np.unique(np.concatenate([[0], nearest, [len(t) - 1]]))


def _peaks(tau: Array, kept: Any) -> Array:
    """Each joint's largest |τ| since the instant kept before, with its sign; shape (n, n_v)."""
    found = tau[kept]
    for i, (first, last) in enumerate(pairwise(kept), start=1):
        part = tau[first + 1 : last + 1]
        at = np.abs(part).argmax(axis=0)
        found[i] = part[at, np.arange(tau.shape[1])]
    return np.asarray(found)


def _facts(run: Trajectory) -> list[tuple[str, str]]:
    """What came out, from the run only."""
    units = [display_unit(unit) for unit in run.task_units]
    facts = []
    for unit in dict.fromkeys(name for name, _ in units):
        rows = [i for i, (name, _) in enumerate(units) if name == unit]
        scaled = run.error[:, rows] * [units[i][1] for i in rows]
        first, last = (float(np.linalg.norm(scaled[k])) for k in (0, -1))
        share = f" ({_short(100.0 * last / first)} % is left)" if first > 0.0 else ""
        facts.append(("error", f"{_short(first)} → {_short(last)} {unit}{share}"))
    n = len(run.t)
    lost = int((~np.isfinite(run.x_measured).all(axis=1)).sum())
    if lost:
        facts.append(("not measured", f"{100.0 * lost / n:.2g} % of the time"))
    for counts in (run.status_counts(), run.limit_status_counts()):
        for status, count in counts.items():
            if status not in _USUAL:
                name = status.name.lower().replace("_", " ")
                if isinstance(status, LimitStatus) and status is not LimitStatus.LIMITED:
                    name = f"limited, {name}"  # where it was not, the proof holds as well
                facts.append((name, f"{100.0 * count / n:.2g} % of the time"))
    return facts


def _legend(scene: Scene, image: bool) -> list[tuple[str, str, str]]:
    """What the colours mean: colour, kind of mark ("" is a dot) and words."""
    entries = [(COLORS["arm"], "bar", "the arm as it is")]
    if any(name.endswith("_tip_joint") for name in scene.truth.frame_names):
        entries.append((COLORS["object"], "bar", "object that it holds"))
    if scene.belief is not None:
        words = "arm and camera as the controller believes them"
        words = words if image else "the arm as the controller believes it"
        entries.append((COLORS["believed"], "bar", words))
        entries.append((COLORS["believed"], "", "believed tip"))
    entries.append((COLORS["true"], "", "true tip and its path"))
    if any(feature.axes for feature in features(scene.sensor)):
        entries.append((COLORS["measured"], "", "measured tip, where it differs"))
    entries.append((COLORS["target"], "", "target, line of sight" if image else "target"))
    if scene.task is not None:
        entries.append((COLORS["force"], "dash", "force that the control means to exert"))
    if np.isfinite(scene.torque_limits).any():
        entries.append((COLORS["saturated"], "bar", "link whose torque is at its limit"))
    if np.isfinite(np.array(scene.truth.position_limits)).any():
        entries.append((COLORS["at_limit"], "bar", "link whose joint is at a position limit"))
    return entries


def _short(value: float) -> str:
    """A number ≥ 0 as people read it: three digits, and no powers of ten."""
    if 0.0 < value < 1e-3:
        return "below 0.001"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _plots(scene: Scene, labels: list[str], units: list[str]) -> list[dict[str, Any]]:
    """The plots beside the scene; names, units and colours as in `approxjac.view`."""
    shown = " or ".join(dict.fromkeys(display_unit(unit)[0] for unit in units))
    known = bool(np.isfinite(scene.torque_limits).any())
    kinds = [unit for unit in ("rad", "m") if unit in scene.truth.joint_units]
    torque = " or ".join({"rad": "N m", "m": "N"}[kind] for kind in kinds)
    joints = list(scene.truth.joint_names)
    first = joints[0].partition("_")[0] + "_"
    if len(joints) > 1 and all(name.startswith(first) for name in joints):
        # panda_joint1 is joint1 here, where there is little room
        joints = [name.removeprefix(first) for name in joints]
    return [
        {
            "column": "error", "title": "Task error of each coordinate",
            "unit": f"x − x_d [{shown}]", "labels": labels,
            "colours": SERIES, "lines": [0.0],
        },
        {
            "column": "torque", "title": "Torque of each joint",
            "unit": "τ / limit" if known else f"τ [{torque}]", "labels": joints,
            "colours": SERIES, "lines": [-1.0, 1.0] if known else [],
        },
        {
            "column": "V", "title": "Lyapunov function", "unit": "V [J]", "labels": ["V"],
            "colours": SERIES, "lines": [],
        },
    ]  # fmt: skip


def _asset(name: str) -> str:
    folder = resources.files("approxjac.view.browser") / "assets"
    return (folder / name).read_text(encoding="utf-8")


def _packed(column: Array) -> str:
    """Numbers as base64 of little-endian float32, which the page reads without parsing."""
    return base64.b64encode(np.ascontiguousarray(column, dtype="<f4").tobytes()).decode()


def _meshcat_js() -> str:
    view_package("meshcat")  # for its error
    viewer = resources.files("meshcat") / "viewer" / "dist" / "main.min.js"
    return viewer.read_text(encoding="utf-8")


def _licences(uplot: str) -> str:
    """Licences of what is inside the page, which ask to be handed on with it."""
    viewer = resources.files("meshcat") / "viewer"
    parts = [f"uPlot:\n\n{uplot}"]
    for name in (
        "LICENSE",
        "dist/main.min.js.LICENSE.txt",
        "dist/main.min.js.THIRD_PARTY_LICENSES.json",
    ):
        file = viewer / name
        if file.is_file():
            parts.append(f"MeshCat, {name}:\n\n{file.read_text(encoding='utf-8')}")
    return "\n\n".join(parts).replace("<", "(").replace(">", ")")


def _script(code: str) -> str:
    code = code.replace("</script", "<\\/script")  # or it would end here
    return f"<script>{code}</script>"
