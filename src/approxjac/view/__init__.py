"""Plots of runs."""

from approxjac.view.plots import plot_error, plot_parameters, plot_path, plot_run, plot_torque
from approxjac.view.style import legend_below, new_figure, save_figure

__all__ = [
    "legend_below",
    "new_figure",
    "plot_error",
    "plot_parameters",
    "plot_path",
    "plot_run",
    "plot_torque",
    "save_figure",
]
