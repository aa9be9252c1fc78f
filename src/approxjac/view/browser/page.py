"""Runs as pages, each one self-contained HTML file, and an index of those in a folder."""

import base64
import hashlib
import json
import os
import re
import sys
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

from approxjac.cameras import PinholeCamera
from approxjac.errors import InvalidInputError, package_of
from approxjac.files import refusing, write_text
from approxjac.formatting import display_unit, joined, share, short
from approxjac.interface import LimitStatus, Status
from approxjac.simulation import Trajectory
from approxjac.simulation.trajectory import Scene
from approxjac.tasks.analysis import features, image_feature
from approxjac.validation import Array, require
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.stage import Stage, frame_points, grid, viewpoint
from approxjac.view.style import COLORS, SERIES
from approxjac.view.tree import held_objects, learnt_regressor

# one set for each kind: as numbers, statuses of two kinds are equal
_USUAL = {Status.OK, Status.MEASUREMENT_HELD}
_USUAL_LIMITS = {LimitStatus.UNLIMITED, LimitStatus.FREE}
_NAMED = 3  # events, of which a page tells in words
_RATE = 60.0  # frames of a second, at most
_FRAMES = 1000  # of a run, at most
_HEAD = 4000  # characters of a page in which its name stands
_MARK = '<meta name="generator" content="approxjac">'
# what a page may do: run the scripts that stand in it, and show pictures beside it
_POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; img-src 'self' file: data:; "
    "style-src 'unsafe-inline'"  # MeshCat sets styles
)
_LIVE = "; connect-src ws://127.0.0.1:* ws://localhost:*"
_SCRIPTS = ("uPlot.iife.min.js", "scene.js", "plots.js", "image.js", "page.js")
_ROOM = 0.35  # to all sides, for targets of a live page that are yet to come, of the arm's size


def save_page(run: Trajectory, path: str | Path, title: str | None = None) -> Path:
    """Write a run as a page for a web browser, the arm in motion and its plots; return the path.

    The page is one self-contained file that needs no network. It shows at most 60 instants a
    second and 1000 in all, including the first and the last; torques and shares of limits are the
    largest since the last instant shown.

    Args:
        run: The run.
        path: File to write.
        title: Title of the page; by default it names the arm.

    Raises:
        InvalidInputError: A run without `scene`, or a file that cannot be written.
        MissingPackageError: The package meshcat is not installed.
    """
    require("path", path, (str, Path), "the name of a file")
    path, text = Path(path), page(run, title)
    with refusing("path must be a file that can be written", path, (OSError, ValueError)):
        write_text(path, text)
    return path


def show(run: Trajectory, title: str | None = None) -> Path:
    """Open a run's page (`save_page`) in a web browser; return the temporary file that holds it.

    Without a browser, the page's path is printed.
    """
    text = page(run, title)  # or an error, before there is a file
    handle, name = tempfile.mkstemp(".html", "approxjac-")
    os.close(handle)
    path = Path(name)
    write_text(path, text)
    if not open_browser(path.as_uri()):
        print(f"No browser could be opened here: the page is {path}")
    return path


def open_browser(url: str) -> bool:
    """Open a page in the user's browser; return whether there is one."""
    # without a screen, `webbrowser` would take a browser for terminals and wait until it is left
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        return False
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False


def page(run: Trajectory, title: str | None = None) -> str:
    """Return the text of a run's page, as `save_page` writes it."""
    require("run", run, Trajectory, "a Trajectory, as simulate returns it")
    if run.scene is None:
        raise InvalidInputError(
            "run must have a scene, to know which robots to draw: take one that "
            "approxjac.simulate returned, or give dataclasses.replace(run, scene=Scene(...))",
            given=run,
        )
    stage, kept = Stage(run.scene), _thinned(run.t, run.q)
    columns = RunFrames(run.scene).columns(run, kept)
    data = page_data(stage, run, columns, run.q[kept], title, _facts(run))
    data["events"] = [
        {"from": e.begin, "to": min(e.end, float(run.t[-1])), "name": e.condition.label}
        for e in run.events
    ]
    if run.fault_name:  # in the tab, in an index, and above all else
        data |= {"title": f"{run.fault_name}: {data['title']}", "alarm": run.ended}
    return document(data)


def _thinned(t: Array, q: Array) -> Any:
    """Return indices of instants to show, half by time and half by motion: paths are round then."""
    duration = float(t[-1] - t[0])
    count = min(len(t), _FRAMES, max(2, round(duration * _RATE) + 1))
    if count == len(t):
        return np.arange(len(t))
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1)))
    progress = (t - t[0]) / duration + (way / way[-1] if way[-1] > 0.0 else 0.0)
    wanted = np.linspace(0.0, progress[-1], count)
    nearest = np.searchsorted(0.5 * (progress[1:] + progress[:-1]), wanted)
    return np.unique(np.concatenate([[0], nearest, [len(t) - 1]]))


def _facts(run: Trajectory) -> list[tuple[str, str]]:
    """List the end of the run and its unusual events, each a name and a text."""
    facts = [("ended", run.ended)] if run.ended and not run.fault_name else []
    shown, factors = zip(*map(display_unit, run.task_units), strict=True)
    errors = run.error * np.array(factors)
    for unit in dict.fromkeys(shown):
        norms = np.linalg.norm(errors[:, [name == unit for name in shown]], axis=1)
        sizes = norms[0], norms[-1], np.nanmax(norms)
        first, last, largest = ("below 0.001" if 0.0 < e < 1e-3 else short(e) for e in sizes)
        if (run.x_d != run.x_d[0]).any():  # a path begins where the arm is
            facts.append(("error", f"up to {largest} {unit}, {last} {unit} at the end"))
        else:
            facts.append(("error", f"{first} → {last} {unit}"))
    counts = {"not measured": int((~np.isfinite(run.x_measured).all(axis=1)).sum())}
    counts |= {s.label: n for s, n in run.status_counts().items() if s not in _USUAL}
    limited = run.limit_status_counts().items()
    counts |= {f"limits: {s.label}": n for s, n in limited if s not in _USUAL_LIMITS}
    facts += [(name, f"{share(n, len(run.t))} of the time") for name, n in counts.items() if n]
    return facts + [(event.condition.label, event.described) for event in run.events[:_NAMED]]


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
    """Return the contents of a page that shows columns of `RunFrames` and further facts.

    A live page gets instants while it is open, and its targets can be dragged.
    """
    scene, truth, known = stage.scene, stage.scene.truth, stage.scene.knows_truth
    believed = ": true and believed arm" if known and scene.belief else ""
    ends = [columns[name][[0, -1]] for name in ("tip", "target", "believed_tip")]
    moving = np.concatenate([*ends, columns["tip"]])
    moving = moving[np.isfinite(moving).all(axis=1)]
    seen = [frame_points(robot, q) for robot in stage.robots.values()]
    seen += [f.points for f in features(scene.sensor) if f.camera is not None and f.frame is None]
    middle = moving.mean(axis=0)  # and where it would meet each wall
    walls = [(middle + (point - middle).dot(n) * n, n) for point, n in scene.walls]
    seen += [moving, stage.camera_points, *(centre[np.newaxis] for centre, _ in walls)]
    if live:
        around = _ROOM * stage.size * np.concatenate([np.eye(3), -np.eye(3)])
        seen.append(columns["tip"][-1:] + around)
    points = np.concatenate(seen)
    data = stage.data()
    data["commands"] += grid(points, stage.floor)
    tip = "believed tip" if learnt_regressor(scene) is None else "learnt tip"
    image = _image(scene)
    held, thought = held_objects(truth), held_objects(scene.belief or truth)
    wrong = [
        (name, f"{held.get(name, 0.0):.3g} m long, believed {thought.get(name, 0.0):.3g} m")
        for name in held | thought
        if abs(held.get(name, 0.0) - thought.get(name, 0.0)) > 1e-6
    ]
    return data | {
        "title": title or truth.name + believed,
        "facts": [*wrong, *facts],
        "events": [],
        "tip": tip,
        "legend": _legend(scene, tip, image is not None),
        "live": live,
        "colours": COLORS,
        "size": stage.size,
        "walls": np.array(walls).tolist(),
        "view": viewpoint(moving, points, stage.size),
        "image": image,
        "plots": _plots(scene, run),
        "jointNames": list(truth.joint_names),
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
    files = (*viewer.iterdir(), *(viewer / "dist").iterdir())
    named = {file.name: file for file in files if "LICENSE" in file.name}
    licences += [f"MeshCat, {name}:\n\n{named[name].read_text('utf-8')}" for name in sorted(named)]
    # "</script" would end the element that it stands in, and "<!--" change how it is read
    values = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    ended = [part.replace("</script", "<\\/script") for part in code]
    alarm = str(data.get("alarm", ""))
    facts = [f"{name}: {said}" for name, said in data["facts"]]
    parts = {
        "title": escape(str(data["title"])),
        "alarm": escape(alarm),
        "description": escape("; ".join([alarm] * bool(alarm) + facts)),
        "css": asset("uPlot.min.css") + asset("page.css"),
        "data": values,
        "licences": "\n\n".join(licences).replace("<", "(").replace(">", ")"),
        "scripts": "\n".join(f"<script>{part}</script>" for part in ended),
    }
    return filled("page.html", parts, _LIVE if scripts else "")


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    return (resources.files("approxjac.view.browser") / "assets" / name).read_text(encoding="utf-8")


def policy_of(page: str) -> str:
    """Return the Content-Security-Policy that a page states."""
    return page.partition('Policy" content="')[2].partition('"')[0]


def filled(template: str, parts: Mapping[str, str], connect: str = "") -> str:
    """Return an asset with parts in place of their names, {{name}}, and a policy on connections."""
    parts = {"link": COLORS["true"], "text": COLORS["neutral"], **parts}
    # all at once: parts are not looked at again
    text = re.sub(r"{{(\w+)}}", lambda name: parts.get(name[1], name[0]), asset(template))
    scripts = re.findall("<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(each.encode()).digest()) for each in scripts]
    allowed = " ".join(f"'sha256-{each.decode()}'" for each in hashes) or "'none'"
    return text.replace("{{policy}}", f"{_POLICY}{connect}; script-src {allowed}", 1)


def _legend(scene: Scene, tip: str, image: bool) -> list[tuple[str, str, str, str]]:
    """Return the meaning of colours: what, colour, kind of mark ("" is a dot) and words.

    The page shows those of what occurs in it.
    """
    known, seen = scene.knows_truth, "arm and camera as the controller believes them"
    entries = [
        ("arm", "arm", "bar", "true arm" if known else "believed arm"),
        ("object", "object", "bar", "held object"),
        ("believed", "believed", "bar",
         seen if image else "believed arm"),
        ("believed_tip", "believed", "", tip),
        ("true", "true", "", f"{'true tip' if known else 'tip by the belief'} and its path"),
        ("measured", "measured", "", "measured tip" + ", where it differs" * known),
        ("target", "target", "", "target, line of sight" if image else "target"),
        ("wall", "neutral", "bar", "wall that a limit of motion keeps to"),
        ("force", "force", "dash", "commanded task force"),
        ("saturated", "saturated", "bar", "link near or at its torque limit"),
        ("at_limit", "at_limit", "bar", "link at a position limit of its joint"),
        ("event", "at_limit", "shade", "in plots: an event named above"),
    ]  # fmt: skip
    absent = {"object": not any(held_objects(scene.truth).values()), "wall": not len(scene.walls)}
    return [(a, COLORS[role], mark, words) for a, role, mark, words in entries if not absent.get(a)]


def _plots(scene: Scene, run: Trajectory) -> list[dict[str, Any]]:
    """Return the plots beside the scene; names, units and colours as in `approxjac.view`."""
    shown = joined(display_unit(unit)[0] for unit in run.task_units)
    known = bool(np.isfinite(scene.torque_limits).any())
    joints = list(scene.truth.joint_names)
    # panda_joint1 is joint1 here, where there is little room
    first = joints[0].partition("_")[0] + "_"
    if all(name.startswith(first) for name in joints):
        joints = [name.removeprefix(first) for name in joints]
    plots = [
        ("error", "Task error of each coordinate", f"error [{shown}]",
         list(run.task_labels), [0.0]),
        ("command", "Commanded velocity of each joint", f"q̇ [{run.units['command']}]", joints, []),
        ("torque", "Torque of each joint", "τ / limit" if known else f"τ [{run.units['tau']}]",
         joints, [-1.0, 1.0] if known else []),
        ("V", "Lyapunov function", "V [J]", ["V"], []),
    ]  # fmt: skip
    unknown = ["command"] * (run.command_kind == "torque") + ["torque"] * (not run.has_torque)
    plots = [plot for plot in plots if plot[0] not in unknown]
    names = ("column", "title", "unit", "labels", "lines")
    return [dict(zip(names, plot, strict=True)) | {"colours": SERIES} for plot in plots]


def _image(scene: Scene) -> dict[str, Any] | None:
    """Return the image that is plotted: its coordinates, unit, border and points; None if none."""
    feature = image_feature(scene.sensor)
    if feature is None or feature.camera is None:
        return None
    camera = feature.camera
    size = camera.size if isinstance(camera, PinholeCamera) else ()  # where v points down
    border = [-0.5, -0.5, *(side - 0.5 for side in size)] if size else None
    unit, scale = display_unit(camera.unit)
    return {
        "labels": list(camera.labels), "unit": unit, "scale": scale, "border": border,
        "down": bool(size), "points": len(feature.points),
        "seen": "seen" if scene.knows_truth else "seen, by the belief",
    }  # fmt: skip


def write_index(folder: str | Path, title: str = "Runs to look at") -> Path:
    """Write index.html, a link to every run page in a folder by their names; return its path.

    A picture of the same name beside a page (run.png beside run.html) is shown with its link, and
    other PNGs among the pages, each with the title that `save_figure` gave it.

    Args:
        folder: Folder with pages from `save_page`.
        title: Title of the index.

    Raises:
        InvalidInputError: A folder without such pages, or that cannot be written to.
    """
    require("folder", folder, (str, Path), "a folder")
    folder = Path(folder)
    with refusing("folder must be one that can be read and written", folder):
        heads = {path: path.read_text("utf-8", "replace")[:_HEAD] for path in folder.glob("*.html")}
        entries = {path: _entry(path, head) for path, head in heads.items() if _MARK in head}
        if not entries:
            raise InvalidInputError(
                f"folder must hold pages that save_page(run, path) wrote, got {folder} without any",
                given=folder,
            )
        for path in folder.glob("*.png"):
            if path.with_suffix(".html") not in entries:
                with suppress(OSError), Image.open(path) as picture:  # or it is none
                    named = escape(picture.info.get("Title") or path.stem.replace("_", " "))
                    shown = f'<img src="{quote(path.name)}" alt=""><b>{named}</b>'
                    entries[path] = f"<li><div>{shown}</div></li>"
        names = {re.sub(r"\d+", lambda n: n[0].zfill(9), path.name): path for path in entries}
        listed = [entries[names[name]] for name in sorted(names)]  # fig10 after fig9
        parts = {"title": escape(title), "entries": "\n".join(listed)}
        write_text(folder / "index.html", filled("index.html", parts))
    return folder / "index.html"


def _entry(path: Path, head: str) -> str:
    """Return a link to a page, with its title and its description of itself."""
    title = re.search(r"<title>(.+?)</title>", head, re.DOTALL)
    text = re.search(r'<meta name="description" content="(.+?)">', head, re.DOTALL)
    image = path.with_suffix(".png")
    picture = f'<img src="{quote(image.name)}" alt="">' if image.is_file() else ""
    named = title[1] if title else escape(path.stem)
    named = re.sub(r"\b(\w)_(\w)\b", r"\1<sub>\2</sub>", named)  # K_v, say
    line = f"<p>{text[1]}</p>" if text else ""
    return f'<li><a href="{quote(path.name)}">{picture}<b>{named}</b>{line}</a></li>'
