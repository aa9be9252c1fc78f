"""Plots of a calibration, and a page that shows them."""

import base64
import io
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from approxjac.calibration import Calibration
from approxjac.files import refusing, write_text
from approxjac.validation import plane_rows, require
from approxjac.view.browser.page import filled
from approxjac.view.style import COLORS, SERIES, new_figure, style, styled

_CELLS = 16  # of a map, across
_ROW = 0.19  # inch, of a number's name


def plot_residuals(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """Draw the residuals at each place: by the drawing, fitted, and left out of the fit."""
    at, columns = range(len(calibration.places)), list(zip(*calibration.places, strict=True))
    labels = {"believed": "by the drawing", "measured": "fitted", "true": "left out of the fit"}
    with styled(ax, (5.6, 1.7 + 0.3 * len(at))) as ax:
        for (role, label), sizes in zip(labels.items(), columns[2:], strict=True):
            ax.plot(1e3 * np.array(sizes), at, "o", label=label, color=COLORS[role])
        ax.set(xscale="log", yticks=at, yticklabels=columns[0], ylim=(len(at) - 0.5, -0.5))
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
        ax.set(xlabel="rms of residuals [mm]", ylabel="place [–]", title="Residuals by place")
    return ax


def plot_determined(calibration: Calibration, ax: Axes | None = None) -> Axes:
    """Draw the share of each number that the data determine, with its standard deviation."""
    names, units = calibration.names, calibration.units
    with styled(ax, (6.4, 1.4 + _ROW * len(names))) as ax:
        shares, colors = 100.0 * calibration.share, [SERIES[unit == "rad"] for unit in units]
        ax.barh(names, shares, 0.7, color=colors, label="share of the data, and sd beside it")
        for y, (sd, unit) in enumerate(zip(calibration.sd, units, strict=True)):
            ax.text(101.0, y, f"{1e3 * sd:.2g} m{unit}", va="center", fontsize=7)
        ax.tick_params(axis="y", labelsize=7)
        ax.set(xlim=(0.0, 100.0), ylim=(len(names) - 0.4, -0.6), ylabel="number of the arm [–]")
        ax.set(xlabel="determined by the data [%]", title="Numbers that the data determine")
    return ax


def plot_accuracy(calibration: Calibration, plane: str = "xz", ax: Axes | None = None) -> Axes:
    """Draw the sd of the tip over the workspace in two axes of the base, cells by their median."""
    rows, accuracy = plane_rows(plane), calibration.accuracy
    (x, y), seen = (accuracy.linear(q)[0].T[rows] for q in (accuracy.workspace, accuracy.recorded))
    sd = 1e3 * accuracy(accuracy.workspace)
    with styled(ax) as ax:
        cells = ax.hexbin(
            x, y, sd, gridsize=_CELLS, reduce_C_function=np.median, cmap="viridis_r", lw=0.2,
            vmin=0.0, vmax=np.quantile(sd, 0.98),
        )  # fmt: skip
        ax.figure.colorbar(cells, ax=ax, label="sd of the tip [mm]", shrink=0.8)
        ax.plot(*seen, ".", color=COLORS["saturated"], ms=5, label="recorded")
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
        ax.set_title(f"Accuracy over the workspace, {plane[0]}-{plane[1]} plane")
    return ax


def save_calibration_page(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration as a page, one self-contained HTML file with plots; return its path.

    Raises:
        InvalidInputError: No calibration, or a file that cannot be written.
    """
    require("calibration", calibration, Calibration, "a Calibration")
    maps, axes = new_figure(2)
    for plane, ax in zip(("xy", "xz"), axes, strict=True):
        plot_accuracy(calibration, plane, ax)
    verdict, text = (escape(part) for part in (calibration.verdict, str(calibration)))
    entries = [f"<div><b>{verdict}</b><p>{escape(calibration.coverage)}</p></div>"]
    others: list[Any] = [plot_residuals(calibration).figure, plot_determined(calibration).figure]
    for figure in (maps, *others):
        with style(), io.BytesIO() as buffer:
            figure.savefig(buffer, format="svg", metadata={"Date": None})
            data = base64.b64encode(buffer.getvalue()).decode()
        alt = escape(figure.axes[0].get_title())
        entries.append(f'<div><img src="data:image/svg+xml;base64,{data}" alt="{alt}"></div>')
    listed = "\n".join(f"<li>{each}</li>" for each in (*entries, f"<pre>{text}</pre>"))
    parts = {"title": escape(f"{calibration.robot.name}: calibration"), "entries": listed}
    with refusing("path must be a file that can be written", path):
        write_text(Path(path), filled("index.html", parts))
    return Path(path)
