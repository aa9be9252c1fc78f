"""One look for every plot: colour-blind safe, readable in print, reproducible files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from approxjac.errors import InvalidInputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which people with colour-blindness can tell apart."""
# What a colour means, in every figure. Series that mean none of this take COLORS in turn.
TRUE = "#0072B2"
"""The true arm, its path, what a camera truly sees."""
BELIEVED = "#CC79A7"
"""What the controller believes of the same."""
TARGET = "#009E73"
"""Where the arm shall go."""
NEUTRAL = "#555555"
"""Lines to compare with: zero, limits, tolerances."""
SATURATED = "#D55E00"
"""Torque at its limit."""
AT_LIMIT = "#E69F00"
"""Joint at its position limit."""
FORCE = "#000000"
"""Forces: the colour that differs most from all others, whatever one's eyes."""
DPI = 130
"""Of every picture made of pixels."""
_LEGEND = 36.0  # below the axes, under their ticks and their label [pt]

_LEGEND_WIDTH = 270.0  # of a plot of usual size [pt]; a letter takes 4.4 of them, a line 34

_RC: Mapping[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "figure.constrained_layout.h_pad": 0.08,
    "figure.constrained_layout.w_pad": 0.10,  # a label belongs to its own plot, not the last one
    "font.size": 9,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "path.simplify_threshold": 0.3,  # pixels, hardly seen; half the file where torques are rough
    "svg.hashsalt": "approxjac",  # the same SVG from the same run
}


@contextmanager
def style() -> Iterator[None]:
    """Apply the look inside a `with` block, and leave the user's settings alone after it."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({**_RC, "axes.prop_cycle": cycler(color=COLORS)}):
        yield


def new_figure(
    columns: int = 1, rows: int = 1, *, size: tuple[float, float] | None = None, title: str = ""
) -> tuple[Figure, list[Axes]]:
    """Return an empty figure in the library's look, and its axes row by row.

    In a notebook the figure shows itself.

    Args:
        columns: Plots side by side.
        rows: Plots one above the other.
        size: Width and height [inch]; 4.3 × 3.8 for each plot by default.
        title: Of the whole figure.
    """
    from approxjac.view.figure import StyledFigure  # loads Matplotlib

    with style():
        figure = StyledFigure(size or (4.3 * columns, 3.8 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        if title:
            figure.suptitle(title, fontweight="bold")
    return figure, list(axes.flat)


def axes_or_new(ax: Axes | None, size: tuple[float, float] | None = None) -> Axes:
    """Return the axes that a user gave, or those of a new figure."""
    return new_figure(size=size)[1][0] if ax is None else ax


def legend_below(ax: Axes, columns: int | None = None) -> None:
    """Put the legend under the axes, where it covers no data.

    Args:
        ax: The axes.
        columns: Entries side by side; as many as fit under a plot of usual width by default.
    """
    from matplotlib.transforms import offset_copy

    labels = ax.get_legend_handles_labels()[1]
    longest = max((len(label) for label in labels), default=1)
    if columns is None:
        columns = max(1, min(len(labels), int(_LEGEND_WIDTH / (4.4 * longest + 34.0))))
    # by a distance that does not change as the layout makes room for the legend
    below = offset_copy(ax.transAxes, ax.get_figure(root=True), y=-_LEGEND, units="points")
    ax.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=below, ncols=columns,
        borderaxespad=0.0, frameon=False, fontsize=8,
    )  # fmt: skip


def save_figure(figure: Figure, stem: str | Path) -> list[Path]:
    """Write a figure as `stem`.png and `stem`.svg, without dates inside.

    Returns:
        The two paths.

    Raises:
        InvalidInputError: The files cannot be written.
    """
    stem = Path(stem)
    if stem.suffix in (".png", ".svg"):
        stem = stem.with_suffix("")
    paths = [stem.with_name(stem.name + ending) for ending in (".png", ".svg")]
    try:
        with style():
            figure.savefig(paths[0], dpi=DPI)
            figure.savefig(paths[1], dpi=DPI, metadata={"Date": None})  # dpi: of what is pixels
    except OSError as error:
        raise InvalidInputError(
            f"stem must name files that can be written, got {stem}: {error}", given=stem
        ) from error
    return paths
