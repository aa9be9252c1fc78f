"""A figure that keeps the library's look wherever it is drawn, also in a notebook."""

from __future__ import annotations

import io
from typing import Any

from matplotlib.figure import Figure

from approxjac.view.style import DPI, style


class StyledFigure(Figure):
    """What `new_figure` makes. Nothing of pyplot knows it, so it is closed by nobody."""

    def draw(self, renderer: Any) -> None:
        """Draw it in the look: ticks are made only now, from the settings of this moment."""
        layout = self.get_layout_engine()
        with style():
            # one pass takes the room beside an image of fixed shape for room under its legend
            if layout is not None and any(ax.get_aspect() != "auto" for ax in self.axes):
                layout.execute(self)
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        """The picture that a notebook shows where the figure is the last line of a cell.

        There is none as SVG beside it: that would be shown instead, and a notebook would keep all
        points of a run in its file.
        """
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=DPI)
        return buffer.getvalue()
