"""Plots of runs, of what cameras see and of stability; runs in the browser."""

from approxjac.errors import package_of

package_of("study", "matplotlib")  # for its error

from approxjac.view.browser.live import LiveView
from approxjac.view.browser.page import save_page, show, write_index
from approxjac.view.plots import (
    plot_command,
    plot_error,
    plot_image,
    plot_parameters,
    plot_path,
    plot_run,
    plot_shares,
    plot_slack,
    plot_torque,
)
from approxjac.view.style import COLORS, SERIES, legend_below, new_figure, save_figure, style

__all__ = [
    "COLORS",
    "SERIES",
    "LiveView",
    "legend_below",
    "new_figure",
    "plot_command",
    "plot_error",
    "plot_image",
    "plot_parameters",
    "plot_path",
    "plot_run",
    "plot_shares",
    "plot_slack",
    "plot_torque",
    "save_figure",
    "save_page",
    "show",
    "style",
    "write_index",
]
