"""Plots of a run. Each takes axes and returns them, so that one can go on from there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, axis_rows
from approxjac.robots import Robot
from approxjac.simulation import Trajectory
from approxjac.tasks import FrameKinematics
from approxjac.view.style import COLORS, TARGET, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_error(run: Trajectory, ax: Axes | None = None) -> Axes:
    """Draw each coordinate of the task error against time.

    Args:
        run: The run.
        ax: Axes to draw into; new ones by default.
    """
    with style():
        ax = _axes(ax)
        factor, unit = (1e3, "mm") if run.task_unit == "m" else (1.0, run.task_unit)
        ax.axhline(0.0, color=TARGET, linewidth=0.8)
        for i, label in enumerate(run.task_labels):
            ax.plot(run.t, factor * run.error[:, i], color=COLORS[i % len(COLORS)], label=label)
        ax.set(xlabel="time [s]", ylabel=f"x − x_d [{unit}]", title="Task error")
        ax.legend(loc="upper right", ncols=min(3, len(run.task_labels)))
    return ax


def plot_torque(run: Trajectory, ax: Axes | None = None) -> Axes:
    """Draw the torque of each joint against time.

    Args:
        run: The run.
        ax: Axes to draw into; new ones by default.
    """
    with style():
        ax = _axes(ax)
        for i, joint in enumerate(run.joint_names):
            ax.plot(run.t, run.tau[:, i], color=COLORS[i % len(COLORS)], label=joint)
        ax.set(xlabel="time [s]", ylabel=f"τ [{run.units['tau']}]", title="Joint torque")
        ax.legend(loc="upper right", ncols=2 if len(run.joint_names) > 3 else 1)
    return ax


def plot_path(
    run: Trajectory,
    robot: Robot,
    frame: str | None = None,
    plane: str = "xz",
    target: Sequence[float] | Array | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the path of a frame in a plane of the world, with the arm at start and end.

    Args:
        run: The run.
        robot: Robot whose kinematics to draw: the true one.
        frame: Frame to follow; the robot's `tip` by default.
        plane: Two world axes, such as "xz".
        target: Posture that attains the target, shape (nq,), drawn dashed if given.
        ax: Axes to draw into; new ones by default.
    """
    rows = axis_rows("plane", plane)
    frame = robot.tip_or(frame)
    kinematics = FrameKinematics(robot, frame)
    tips = np.array([kinematics.position(q) for q in run.q])[:, rows]
    with style():
        ax = _axes(ax)
        ax.plot(*tips.T, color=COLORS[0], linewidth=1.0, label=f"path of {frame}")
        for q, color, label in ((run.q[0], COLORS[5], "start"), (run.q[-1], COLORS[1], "end")):
            ax.plot(*_skeleton(robot, frame, q)[:, rows].T, "o-", color=color, ms=4, label=label)
        if target is not None:
            points = _skeleton(robot, frame, np.asarray(target, dtype=float))[:, rows]
            ax.plot(*points.T, "--", color=TARGET, linewidth=1.0, label="target")
            ax.plot(*points[-1], "x", color=TARGET, ms=8)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]", title="Path of the arm")
        ax.legend()
    return ax


def plot_run(run: Trajectory) -> Figure:
    """Return a new figure with the task error and the torques of a run."""
    figure, (left, right) = new_figure(2)
    plot_error(run, left)
    plot_torque(run, right)
    return figure


def _axes(ax: Axes | None) -> Axes:
    return new_figure()[1][0] if ax is None else ax


def _skeleton(robot: Robot, frame: str, q: Array) -> Array:
    """World positions of the base, of each joint on the way to a frame, and of the frame."""
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    frame_id = robot.frame_id(frame)
    joints = model.supports[model.frames[frame_id].parentJoint]
    chain = [np.array(data.oMi[joint].translation) for joint in joints]
    return np.array([*chain, np.array(data.oMf[frame_id].translation)])
