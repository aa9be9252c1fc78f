"""Runs as pages: writing them, opening them, and an index of those in a folder."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.files import reason, write_text
from approxjac.interface import LimitStatus, Status
from approxjac.simulation import Trajectory
from approxjac.validation import Array, require
from approxjac.view.browser.document import document, filled, page_data
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.stage import Stage
from approxjac.view.style import COLORS, display_unit

# one set for each kind: as numbers, statuses of two kinds are equal
_USUAL = {Status.OK, Status.MEASUREMENT_HELD}
_USUAL_LIMITS = {LimitStatus.UNLIMITED, LimitStatus.FREE}
_RATE = 60.0  # frames of a second, at most
_FRAMES = 1000  # of a run, at most
_HEAD = 4000  # characters of a page in which its name stands
_MARK = '<meta name="generator" content="approxjac">'


def save_page(run: Trajectory, path: str | Path, title: str | None = None) -> Path:
    """Write a run as a page for a web browser, the arm in motion and its plots; return the path.

    The page is one file that needs nothing else, no network either. It shows at most 60 instants a
    second and 1000 in all, the first and the last among them; torques and shares of limits are the
    largest since the instant shown before.

    Args:
        run: The run.
        path: File to write.
        title: Of the page; says whose arm it is by default.

    Raises:
        InvalidInputError: A run without `scene`, or a file that cannot be written.
        MissingPackageError: The package meshcat is not installed.
    """
    require("path", path, (str, Path), "the name of a file")
    path, text = Path(path), page(run, title)
    try:
        write_text(path, text)
    except (OSError, ValueError) as error:
        raise InvalidInputError(
            f"path must be a file that can be written, got {path}: {reason(error)}", given=path
        ) from error
    return path


def show(run: Trajectory, title: str | None = None) -> Path:
    """Open a run's page (`save_page`) in a web browser; return the temporary file that holds it.

    Where there is no browser, a line is printed that says where the page is.
    """
    handle, name = tempfile.mkstemp(".html", "approxjac-")
    os.close(handle)
    path = save_page(run, name, title)
    if not open_browser(path.as_uri()):
        print(f"No browser could be opened here: the page is {path}")
    return path


def write_index(
    folder: str | Path,
    title: str = "Runs to look at",
    pictures: Mapping[str, str] | None = None,
    table: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Write index.html, a link to every run page in a folder by their names; return its path.

    A picture of the same name beside a page (run.png beside run.html) is shown with its link.

    Args:
        folder: With pages that `save_page` wrote.
        title: Of the index.
        pictures: Titles of pictures in the folder that have no page, by the names of their files;
            none by default. They are shown among the pages.
        table: A table that opens the index, none by default: its heads by "", and its rows by the
            names of the files that their first cells link to.

    Raises:
        InvalidInputError: A folder without such pages, or that cannot be written to, or a picture
            that is not in it, or rows of a table that are not as long as its heads.
    """
    require("folder", folder, (str, Path), "a folder")
    folder = Path(folder)
    pictures = {} if pictures is None else pictures
    require("pictures", pictures, Mapping, 'titles by file names, such as {"map.png": "Map"}')
    try:
        entries = {}
        for path in folder.glob("*.html"):
            with path.open(encoding="utf-8", errors="replace") as file:
                head = file.read(_HEAD)
            if _MARK in head:
                entries[path.name] = _entry(path, head)
        if not entries:
            raise InvalidInputError(
                f"folder must hold pages that save_page(run, path) wrote, got {folder} without any",
                given=folder,
            )
        entries |= {name: _shown(folder, name, said) for name, said in pictures.items()}
        listed = "\n".join(entries[name] for name in sorted(entries, key=_natural))
        parts = {"title": escape(title), "entries": listed, "table": _table(table or {})}
        parts |= {"link": COLORS["true"], "text": COLORS["neutral"]}
        index = folder / "index.html"
        write_text(index, filled("index.html", parts))
    except OSError as error:
        raise InvalidInputError(
            f"folder must be one that can be read and written, got {folder}: {reason(error)}",
            given=folder,
        ) from error
    return index


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
    if run.fault_name:  # in the tab, in an index, and above all else
        data |= {"title": f"{run.fault_name}: {data['title']}", "alarm": run.ended}
    return document(data)


def open_browser(url: str) -> bool:
    """Open a page in the user's browser; return whether there is one."""
    # without a screen, `webbrowser` would take a browser for terminals and wait until it is left
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        return False
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False


def _thinned(t: Array, q: Array) -> Any:
    """Return indices of the instants that the page shows, the first and the last among them.

    Half of them are shared out by time and half by motion, so that paths are round where it is
    fast.
    """
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
    units = [display_unit(unit) for unit in run.task_units]
    facts = [("ended", run.ended)] if run.ended and not run.fault_name else []
    for unit in dict.fromkeys(name for name, _ in units):
        rows = [i for i, (name, _) in enumerate(units) if name == unit]
        scaled = run.error[:, rows] * [units[i][1] for i in rows]
        first, last = (float(np.linalg.norm(scaled[k])) for k in (0, -1))
        if (run.x_d != run.x_d[0]).any():  # a path begins where the arm is
            largest = float(np.nanmax(np.linalg.norm(scaled, axis=1)))
            facts.append(("error", f"up to {_short(largest)} {unit}, {_short(last)} at the end"))
            continue
        share = f" ({_short(100.0 * last / first)} % is left)" if first > 0.0 else ""
        facts.append(("error", f"{_short(first)} → {_short(last)} {unit}{share}"))
    counts = {"not measured": int((~np.isfinite(run.x_measured).all(axis=1)).sum())}
    for status, count in (*run.status_counts().items(), *run.limit_status_counts().items()):
        if status not in (_USUAL_LIMITS if isinstance(status, LimitStatus) else _USUAL):
            name = status.name.lower().replace("_", " ")
            if isinstance(status, LimitStatus) and status is not LimitStatus.LIMITED:
                name = f"limited, {name}"  # where it was not, the proof holds as well
            counts[name] = count
    shares = {name: 100.0 * count / len(run.t) for name, count in counts.items() if count}
    return [*facts, *((name, f"{_percent(share)} of the time") for name, share in shares.items())]


def _percent(share: float) -> str:
    return f"{share:.2g} %" if share < 99.5 else "100 %"


def _short(value: float) -> str:
    """Return a number ≥ 0 as people read it: three digits, and no powers of ten."""
    if 0.0 < value < 1e-3:
        return "below 0.001"
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _entry(path: Path, head: str) -> str:
    """Return a link to a page, with its title and its description of itself."""
    title = re.search(r"<title>(.+?)</title>", head, re.DOTALL)
    text = re.search(r'<meta name="description" content="(.+?)">', head, re.DOTALL)
    image = path.with_suffix(".png")
    picture = f'<img src="{quote(image.name)}" alt="">' if image.is_file() else ""
    named = title[1] if title else escape(path.stem)
    line = f"<p>{text[1]}</p>" if text else ""
    return f'<li><a href="{quote(path.name)}">{picture}<b>{_indexed(named)}</b>{line}</a></li>'


def _table(rows: Mapping[str, Sequence[str]]) -> str:
    """Return a table of cells by the files that its rows are about; its heads are by ""."""
    if not rows:
        return ""
    heads, lines = rows.get("", ()), []
    for name, row in rows.items():
        if len(row) != len(heads) or not all(isinstance(cell, str) for cell in row):
            raise InvalidInputError(
                f'table must have its heads by "", and rows of so many texts, got {name!r}: {row}',
                given=row,
            )
        cells = [_indexed(escape(cell)) for cell in row]
        if name:
            cells[0] = f'<a href="{quote(name)}">{cells[0]}</a>'
            named = zip(map(escape, heads), cells, strict=True)
            shown = (f'<td data-head="{head}"><span>{cell}</span></td>' for head, cell in named)
            lines.append(f"<tr>{''.join(shown)}</tr>")
    top = "".join(f"<th>{escape(head)}</th>" for head in heads)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody></table>"


def _indexed(text: str) -> str:
    """Return a text with symbols such as K_v, a letter and an index, as they are written."""
    return re.sub(r"\b(\w)_(\w)\b", r"\1<sub>\2</sub>", text)


def _shown(folder: Path, name: str, title: str) -> str:
    """Return a picture without a page."""
    texts = isinstance(name, str) and isinstance(title, str)
    if not texts or Path(name).name != name or not (folder / name).is_file():
        raise InvalidInputError(
            f"pictures must be titles by the names of files in {folder}, got {name!r}: {title!r}",
            given=name,
        )
    return f'<li><div><img src="{quote(name)}" alt=""><b>{escape(title)}</b></div></li>'


def _natural(name: str) -> list[Any]:
    """Return a key that sorts fig10 after fig9."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", name))]
