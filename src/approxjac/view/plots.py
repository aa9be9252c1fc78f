"""Plots of a run. Each draws into axes, by default new ones, and returns them to go on from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus
from approxjac.robots import Robot
from approxjac.simulation import Trajectory
from approxjac.tasks import FrameKinematics
from approxjac.validation import Array, as_vector, plane_rows, require
from approxjac.view.learnt import learnt_tips
from approxjac.view.style import COLORS, SERIES, display_unit, formulas, new_figure, styled

_STATUS_COLORS = dict(
    zip(LimitStatus, ("#BBBBBB", *(SERIES[i] for i in (2, 3, 5, 1, 6, 4, 0))), strict=True)
)


def _require_run(run: Trajectory) -> None:
    require("run", run, Trajectory, "a Trajectory, such as simulate returns")


def plot_error(
    run: Trajectory, ax: Axes | None = None, *, title: str = "Task error of each coordinate"
) -> Axes:
    """Draw each coordinate of the task error against time."""
    _require_run(run)
    with styled(ax) as ax:
        units = [display_unit(unit) for unit in run.task_units]
        ax.axhline(0.0, color=COLORS["neutral"], linewidth=0.8)
        for i, (label, (_, factor)) in enumerate(zip(run.task_labels, units, strict=True)):
            color = SERIES[i % len(SERIES)]
            ax.plot(run.t, factor * run.error[:, i], color=color, label=formulas(label))
        shown = " or ".join(dict.fromkeys(unit for unit, _ in units))
        over_time(ax, run, ylabel=f"$x - x_d$ [{shown}]", title=title)
    return ax


def plot_torque(
    run: Trajectory,
    ax: Axes | None = None,
    *,
    limits: Array | None = None,
    title: str = "Torque of each joint",
) -> Axes:
    """Draw the torque of each joint against time.

    With effort `limits`, shape (n_v,) [N m or N], infinite where none is known, each torque is
    drawn as a share of its limit.
    """
    _require_run(run)
    with styled(ax) as ax:
        tau, known = run.tau, False
        if limits is not None and np.isfinite(limits).any():
            # no line where none is known
            tau, known = tau / np.where(np.isfinite(limits), limits, np.nan), True
        for i, joint in enumerate(run.joint_names):
            ax.plot(run.t, tau[:, i], color=SERIES[i % len(SERIES)], label=joint)
        if known:
            for side, name in ((1.0, "limit"), (-1.0, None)):
                ax.axhline(side, color=COLORS["neutral"], linewidth=1.0, linestyle="--", label=name)
        label = r"$\tau$ / limit [–]" if known else rf"$\tau$ [{run.units['tau']}]"
        over_time(ax, run, ylabel=label, title=title)
    return ax


def plot_slack(run: Trajectory, ax: Axes | None = None) -> Axes:
    """Draw the slack that limits took from the proof against time, and what limits did.

    The status is a band of colours above the slack, which has no line where it is not known.
    """
    _require_run(run)
    with styled(ax) as ax:
        ax.plot(run.t, run.slack, color=SERIES[0])
        largest = np.nanmax(run.slack) if np.isfinite(run.slack).any() else 0.0
        ax.set_ylim(0.0, 1.2 * float(largest) or 1.0)
        # a status holds from its instant to the next one
        starts = np.append(0, np.nonzero(np.diff(run.limit_status))[0] + 1)
        ends = np.append(run.t[starts[1:]], run.t[-1])
        for status in run.limit_status_counts():
            held = run.limit_status[starts] == status
            spans = list(zip(run.t[starts][held], (ends - run.t[starts])[held], strict=True))
            ax.broken_barh(
                spans, (0.88, 0.1), transform=ax.get_xaxis_transform(),
                facecolors=_STATUS_COLORS[status], label=status.name,
            )  # fmt: skip
        over_time(ax, run, ylabel=rf"$\sigma$ [{run.units['slack']}]")
        ax.set_title(r"Slack $\sigma$ that limits add to $\dot{V}$, and status")
    return ax


def plot_path(
    run: Trajectory,
    robot: Robot,
    frame: str | None = None,
    plane: str = "xz",
    q_target: Sequence[float] | Array | None = None,
    ax: Axes | None = None,
    *,
    believed: Robot | None = None,
    target: Sequence[float] | Array | None = None,
    title: str | None = None,
) -> Axes:
    """Draw the path of a frame in a plane of the world, with the arm at start and end.

    Args:
        run: The run.
        robot: Robot whose kinematics to draw: the true one.
        frame: Frame to follow; the robot's `tip` by default.
        plane: Two world axes, such as "xz".
        q_target: Configuration that attains the target, shape (nq,), drawn dashed if given.
        ax: Axes to draw into; new ones by default.
        believed: Robot that the controller believes; the path of its frame is drawn if given, and
            where the controller learnt its kinematics, the path as it was learnt by then.
        target: Where in the world the frame shall go, shape (3,) [m], a cross if given.
        title: Of the axes; says frame and plane by default.

    Raises:
        InvalidInputError: A plane, a configuration or a target of another shape, or another arm.
    """
    _require_run(run)
    rows = plane_rows(plane)
    if believed is not None and believed.joint_names != robot.joint_names:
        raise InvalidInputError(
            f"believed must have the joints of the robot, got {', '.join(believed.joint_names)}",
            given=believed,
        )
    seen = None if believed is None else _tips(run, believed, believed.tip_or(frame))[:, rows]
    frame = robot.tip_or(frame)
    tips = _tips(run, robot, frame)[:, rows]
    if target is not None:
        target = as_vector("target", target, 3)[rows]
    with styled(ax) as ax:
        ax.plot(*tips.T, color=COLORS["true"], linewidth=1.0, label=f"path of {frame}")
        for q, alpha, label in ((run.q[0], 0.35, "start"), (run.q[-1], 1.0, "end")):
            corners = skeleton(robot, frame, q)[:, rows]
            ax.plot(*corners.T, "o-", color=COLORS["true"], alpha=alpha, ms=4, label=label)
        if seen is not None:
            learnt = None if run.scene is None else learnt_tips(run.scene, run.q, run.learnt)
            first = "believed path" if learnt is None else "believed at first"
            style = "-" if learnt is None else ":"
            ax.plot(*seen.T, style, color=COLORS["believed"], label=first, zorder=5)
            if learnt is not None:
                seen = learnt[:, rows]
                ax.plot(*seen.T, "--", color=COLORS["believed"], label="as it is learnt", zorder=5)
            ax.plot(*seen[-1], "o", color=COLORS["believed"], ms=4, zorder=5)
        if q_target is not None:
            points = skeleton(robot, frame, robot.configuration(q_target, "q_target"))[:, rows]
            ax.plot(*points.T, "--", color=COLORS["target"], lw=1.0, label="arm at the target")
            target = points[-1] if target is None else target
        if target is not None:
            ax.plot(*target, "x", color=COLORS["target"], ms=8, mew=2, label="target", zorder=6)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
        ax.set_title(f"Path of {frame}, {plane[0]}-{plane[1]} plane" if title is None else title)
    return ax


def plot_run(run: Trajectory) -> tuple[Figure, list[Axes]]:
    """Return a new figure with the task error and the torques of a run, and its two axes."""
    _require_run(run)
    figure, axes = new_figure(2, title=f"{run.robot_name}: error and torque")
    plot_error(run, axes[0])
    plot_torque(run, axes[1])
    return figure, axes


def over_time(ax: Axes, run: Trajectory, **settings: Any) -> None:
    """Name the axes of a plot over time, from the first instant to the last."""
    ax.set(xlabel="time [s]", **settings)
    if run.t[-1] > run.t[0]:
        ax.set_xlim(run.t[0], run.t[-1])


def _tips(run: Trajectory, robot: Robot, frame: str) -> Array:
    """Return world positions of a frame in all configurations of a run, shape (N, 3)."""
    kinematics = FrameKinematics(robot, frame)
    return np.array([kinematics.position(q) for q in run.q])


def skeleton(robot: Robot, frame: str, q: Array) -> Array:
    """Return world positions of all joints and fixed frames from base to frame, shape (N, 3)."""
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    chain = [robot.frame_id(frame)]
    while chain[-1] != 0:
        chain.append(model.frames[chain[-1]].parentFrame)
    points = np.array([data.oMf[i].translation for i in reversed(chain)])
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return np.asarray(points[np.append(True, apart)])
