"""Plots of runs, of what cameras see and of stability; and what robots look like."""

from approxjac.view.images import plot_camera_view, plot_image, plot_lanes
from approxjac.view.plots import (
    plot_error,
    plot_parameters,
    plot_path,
    plot_run,
    plot_slack,
    plot_torque,
)
from approxjac.view.shapes import Look, robot_look
from approxjac.view.stability import plot_allowed_error, plot_map, plot_margins
from approxjac.view.style import COLORS, legend_below, new_figure, save_figure, style
from approxjac.view.triangles import Shape

__all__ = [
    "COLORS",
    "Look",
    "Shape",
    "legend_below",
    "new_figure",
    "plot_allowed_error",
    "plot_camera_view",
    "plot_error",
    "plot_image",
    "plot_lanes",
    "plot_map",
    "plot_margins",
    "plot_parameters",
    "plot_path",
    "plot_run",
    "plot_slack",
    "plot_torque",
    "robot_look",
    "save_figure",
    "style",
]
