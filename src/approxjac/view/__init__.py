"""Plots of runs."""

from approxjac.view.plots import plot_error, plot_parameters, plot_path, plot_run, plot_torque
from approxjac.view.style import COLORS, legend_below, new_figure, save_figure, style

__all__ = [
    "COLORS",
    "legend_below",
    "new_figure",
    "plot_error",
    "plot_parameters",
    "plot_path",
    "plot_run",
    "plot_torque",
    "save_figure",
    "style",
]
