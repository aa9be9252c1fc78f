"""The style of all plots: colour-blind safe, readable in print, reproducible files."""

import io
import re
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy

from approxjac.files import refusing, replaced

_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
SERIES = (*_OKABE_ITO, "#962DFF")
"""Of lines in turn: Okabe and Ito's colours, and an eighth for the corners of a tag.

People with colour-blindness can tell them apart."""
COLORS: Mapping[str, str] = {
    "true": "#0072B2",  # the true arm, its path, what a camera truly sees
    "believed": "#CC79A7",  # what the controller believes of the same
    "target": "#009E73",  # where the arm shall go
    "neutral": "#555555",  # lines to compare with: zero, limits, tolerances
    "saturated": "#D55E00",  # torque at its limit
    "at_limit": "#E69F00",  # joint at its position limit
    "force": "#000000",  # the colour that differs most from all others, whatever one's eyes
    "measured": "#56B4E9",  # what was measured, where it differs from what is true
    "arm": "#C9CED4",  # in the browser: a grey that leaves the other colours their meaning
    "object": "#8C97A3",  # that the arm holds
}
"""Colours by their meaning, in figures and pages. Lines that mean none of this take `SERIES`."""

_DPI = 130
_LEGEND = 36.0  # below the axes, under their ticks and their label [pt]
_LEGEND_WIDTH = 270.0  # of a plot of usual size [pt]; a letter takes 4.4 of them, a line 34
_RC: Mapping[str, Any] = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=SERIES),
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
    "mathtext.fontset": "dejavusans",  # as the text around it
    "path.simplify_threshold": 0.3,  # pixels, hardly seen; half the file where torques are rough
    "pdf.fonttype": 42,  # TrueType, embedded: publishers refuse bitmaps of letters
    "svg.hashsalt": "approxjac",  # the same SVG from the same run
}


def style() -> AbstractContextManager[None]:
    """Apply the look inside a `with` block, and leave the user's settings alone after it."""
    return matplotlib.rc_context(dict(_RC))


class StyledFigure(Figure):
    """A figure that keeps the style wherever it is drawn; pyplot does not know it."""

    def draw(self, renderer: Any) -> None:
        """Draw it in the style: ticks are made only now, from the current settings."""
        layout = self.get_layout_engine()
        with style():
            # one pass takes the room beside an image of fixed shape for room under its legend
            if layout is not None and any(ax.get_aspect() != "auto" for ax in self.axes):
                layout.execute(self)
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows; as SVG it would keep all points of a run."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=_DPI)
        return buffer.getvalue()


def new_figure(
    columns: int = 1, rows: int = 1, *, size: tuple[float, float] | None = None, title: str = ""
) -> tuple[Figure, list[Axes]]:
    """Return an empty figure in the library's look, and its axes row by row.

    Args:
        columns: Plots side by side.
        rows: Plots one above the other.
        size: Width and height [inch]; 4.3 × 3.8 for each plot by default.
        title: Of the whole figure.
    """
    with style():
        figure = StyledFigure(size or (4.3 * columns, 3.8 * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        if title:
            figure.suptitle(title, fontweight="bold")
    return figure, list(axes.flat)


@contextmanager
def styled(
    ax: Axes | None, size: tuple[float, float] | None = None, columns: int | None = None
) -> Iterator[Axes]:
    """Yield the user's axes, or new ones, for drawing in the style, with the legend below."""
    with style():
        ax = new_figure(size=size)[1][0] if ax is None else ax
        yield ax
        if ax.get_legend_handles_labels()[1]:
            legend_below(ax, columns)


def legend_below(ax: Axes, columns: int | None = None) -> None:
    """Put the legend under the axes, where it covers no data.

    Entries are in `columns`, by default as many as fit under a plot of usual width.
    """
    if columns is None:
        labels = ax.get_legend_handles_labels()[1]
        longest = max(map(len, labels), default=1)
        columns = max(1, min(len(labels), int(_LEGEND_WIDTH / (4.4 * longest + 34.0))))
    # by a distance that does not change as the layout makes room for the legend
    below = offset_copy(ax.transAxes, ax.get_figure(root=True), y=-_LEGEND, units="points")
    ax.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=below, ncols=columns,
        borderaxespad=0.0, frameon=False, fontsize=8,
    )  # fmt: skip


def formulas(text: str) -> str:
    """Return a text with symbols such as K_v and x_d, one letter and an index, as mathtext."""
    return re.sub(r"(?<![\w$\\])([^\W\d_])_(\w{1,2})\b", r"$\1_{\2}$", text)


def save_figure(figure: Figure, stem: str | Path) -> list[Path]:
    """Write a figure as `stem`.png and `stem`.svg, without dates inside; return the paths.

    Raises:
        InvalidInputError: The files cannot be written.
    """
    stem = Path(stem)
    stem = stem.with_suffix("") if stem.suffix in (".png", ".svg") else stem
    paths = [stem.with_name(stem.name + ending) for ending in (".png", ".svg")]
    refused = refusing("stem must name files that can be written", stem)
    with refused, style(), replaced(paths[0]) as png, replaced(paths[1]) as svg:
        title = figure.get_suptitle() or "".join(ax.get_title() for ax in figure.axes[:1])
        figure.savefig(png, dpi=_DPI, metadata={"Title": title.replace("$", "")})
        layout = figure.get_layout_engine()
        figure.set_layout_engine(None)  # once is enough: it takes longer than to draw
        figure.savefig(svg, dpi=_DPI, metadata={"Date": None})  # dpi: of what is pixels
        figure.set_layout_engine(layout)
    return paths
