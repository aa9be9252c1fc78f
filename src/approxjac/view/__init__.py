"""Plots of runs."""

from approxjac.view.plots import plot_error, plot_path, plot_run, plot_torque
from approxjac.view.style import new_figure, save_figure

__all__ = ["new_figure", "plot_error", "plot_path", "plot_run", "plot_torque", "save_figure"]
