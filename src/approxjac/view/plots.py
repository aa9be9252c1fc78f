"""Plots of runs and of stability tests: each draws into axes, by default new ones."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from approxjac.cameras import Camera, PinholeCamera
from approxjac.errors import InvalidInputError, require_known
from approxjac.formatting import display_unit, joined
from approxjac.interface import LimitStatus
from approxjac.robots import Robot
from approxjac.simulation import Trajectory
from approxjac.tasks import FrameKinematics
from approxjac.validation import Array, as_vector, plane_rows, require
from approxjac.view.style import COLORS, SERIES, formulas, new_figure, styled
from approxjac.view.tree import learnt_tips

_STATUS_COLORS = dict(
    zip(LimitStatus, ("#BBBBBB", *(SERIES[i] for i in (2, 3, 5, 1, 6, 4, 0))), strict=True)
)
_INSTANTS = 200
_USUAL = ("tool.", "camera.")
_SHOWN = 0.1  # share of the run after which values and bands are to be within the axes
_SEEN = 0.7  # of a first standard deviation: below it half of the variance was resolved
_AROUND = 0.06  # of the image, shown around its border
# of the paths of points: none of them is that of targets or of what is believed
_POINTS = (COLORS["true"], SERIES[4], SERIES[5], SERIES[6], SERIES[1])


def _require_run(run: Trajectory) -> None:
    require("run", run, Trajectory, "a Trajectory, such as simulate returns")


def plot_error(
    run: Trajectory, ax: Axes | None = None, *, title: str = "Task error of each coordinate"
) -> Axes:
    """Draw each coordinate of the task error against time."""
    _require_run(run)
    units, factors = zip(*map(display_unit, run.task_units), strict=True)
    with styled(ax) as ax:
        ax.axhline(0.0, color=COLORS["neutral"], linewidth=0.8)
        _over_time(ax, run, np.array(factors) * run.error, map(formulas, run.task_labels))
        ax.set(ylabel=f"$x - x_d$ [{joined(units)}]", title=title)
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

    Raises:
        InvalidInputError: A run on a robot that takes velocities, whose torque is not known.
    """
    _require_run(run)
    if not run.has_torque:
        message = (
            f"run must have torques, got {run!r} on a robot that takes velocities: plot_command"
        )
        raise InvalidInputError(message, given=run)
    tau, label = run.tau, rf"$\tau$ [{run.units['tau']}]"
    with styled(ax) as ax:
        if limits is not None and np.isfinite(limits).any():
            # no line where none is known
            tau = tau / np.where(np.isfinite(limits), limits, np.nan)
            label = r"$\tau$ / limit [–]"
            for side, name in ((1.0, "limit"), (-1.0, None)):
                ax.axhline(side, color=COLORS["neutral"], linewidth=1.0, linestyle="--", label=name)
        _over_time(ax, run, tau, run.joint_names)
        ax.set(ylabel=label, title=title)
    return ax


def plot_command(run: Trajectory, ax: Axes | None = None) -> Axes:
    """Draw the command for each joint against time: torques, or velocities."""
    _require_run(run)
    symbol = r"$\tau$" if run.command_kind == "torque" else r"$\dot q$"
    with styled(ax) as ax:
        _over_time(ax, run, run.command, run.joint_names)
        title = f"Commanded {run.command_kind} of each joint"
        ax.set(ylabel=f"{symbol} [{run.units['command']}]", title=title)
    return ax


def _over_time(ax: Axes, run: Trajectory, values: Array, labels: Iterable[str | None]) -> None:
    """Draw columns of values (N, n) against time, from the first instant to the last."""
    for i, label in enumerate(labels):
        ax.plot(run.t, values[:, i], color=SERIES[i % len(SERIES)], label=label)
    ax.set_xlabel("time [s]")
    if run.t[-1] > run.t[0]:
        ax.set_xlim(run.t[0], run.t[-1])


def plot_slack(run: Trajectory, ax: Axes | None = None) -> Axes:
    """Draw the slack against time, and the status of the limits.

    The status is a band of colours above the slack, which has no line where it is not known.
    """
    _require_run(run)
    with styled(ax) as ax:
        _over_time(ax, run, run.slack[:, np.newaxis], [None])
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
        title = r"Slack $\sigma$ that limits add to $\dot{V}$, and status"
        ax.set(ylabel=rf"$\sigma$ [{run.units['slack']}]", title=title)
    return ax


def plot_path(
    run: Trajectory,
    robot: Robot,
    plane: str = "xz",
    ax: Axes | None = None,
    *,
    believed: Robot | None = None,
    target: Sequence[float] | Array | None = None,
    title: str | None = None,
) -> Axes:
    """Draw the path of the tip in a plane of the world, with the arm at start and end.

    Args:
        run: The run.
        robot: Robot whose kinematics to draw: the true one.
        plane: Two world axes, such as "xz".
        ax: Axes to draw into; new ones by default.
        believed: Believed robot, whose path of its tip is drawn if given: by the kinematics
            learnt at each instant, if they are learnt.
        target: Target of the tip in the world, shape (3,) [m], drawn as a cross if given.
        title: Title of the axes; by default frame and plane.

    Raises:
        InvalidInputError: A plane or a target of another shape.
    """
    _require_run(run)
    rows = plane_rows(plane)
    seen = None if believed is None else _tips(run, believed)[:, rows]
    frame, tips = robot.tip_or(None), _tips(run, robot)[:, rows]
    if target is not None:
        target = as_vector("target", target, 3)[rows]
    with styled(ax) as ax:
        ax.plot(*tips.T, color=COLORS["true"], linewidth=1.0, label=f"path of {frame}")
        for q, alpha, label in ((run.q[0], 0.35, "start"), (run.q[-1], 1.0, "end")):
            corners = _skeleton(robot, frame, q)[:, rows]
            ax.plot(*corners.T, "o-", color=COLORS["true"], alpha=alpha, ms=4, label=label)
        if seen is not None:
            learnt = None if run.scene is None else learnt_tips(run.scene, run.q, run.learnt)
            label, style = ("believed path", "-") if learnt is None else ("believed at first", ":")
            ax.plot(*seen.T, style, color=COLORS["believed"], label=label, zorder=5)
            if learnt is not None:
                seen = learnt[:, rows]
                ax.plot(*seen.T, "--", color=COLORS["believed"], label="as it is learnt", zorder=5)
            ax.plot(*seen[-1], "o", color=COLORS["believed"], ms=4, zorder=5)
        if target is not None:
            ax.plot(*target, "x", color=COLORS["target"], ms=8, mew=2, label="target", zorder=6)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]")
        ax.set_title(f"Path of {frame}, {plane[0]}-{plane[1]} plane" if title is None else title)
    return ax


def plot_run(run: Trajectory) -> tuple[Figure, list[Axes]]:
    """Return a new figure with the task error and the commands of a run, and its two axes."""
    _require_run(run)
    figure, axes = new_figure(2, title=f"{run.robot_name}: error and {run.command_kind}")
    plot_error(run, axes[0])
    plot_command(run, axes[1])
    return figure, axes


def _tips(run: Trajectory, robot: Robot) -> Array:
    kinematics = FrameKinematics(robot, robot.tip_or(None))
    return np.array([kinematics.position(q) for q in run.q])


def _skeleton(robot: Robot, frame: str, q: Array) -> Array:
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


def plot_parameters(
    run: Trajectory,
    names: Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    truth: Mapping[str, float] | None = None,
    title: str = "What is learnt",
) -> Axes:
    """Draw learnt numbers against time, ± two standard deviations where known.

    Because bands are wide at first, the axes are scaled to the run after its first tenth.

    Args:
        run: A run of a controller that learns.
        names: Names of the numbers in `run.parameters`, such as "tool.x" or "panda_joint1.m"; by
            default tool and camera if they are learnt, else all.
        ax: Axes to draw into; new ones by default.
        truth: True numbers by name, drawn dashed.
        title: Title of the axes.

    Raises:
        InvalidInputError: No run, or one without learning.
        UnknownNameError: No such number is learnt.
    """
    _require_run(run)
    truth = truth or {}
    known = list(run.parameters)
    if not known:
        message = f"run must be one in which something was learnt, got {run!r}"
        raise InvalidInputError(message, given=run)
    usual = [name for name in known if name.startswith(_USUAL)] or known
    chosen = usual if names is None else list(names)
    for name in chosen:
        require_known("number", name, "what is learnt", known)
    columns = [known.index(name) for name in chosen]
    kept = np.unique(np.linspace(0, len(run.t) - 1, _INSTANTS).astype(int))
    bands = 2.0 * np.array([run.learnt_sd(k) for k in kept])[:, columns]
    values, has_bands = run.learnt[:, columns], bool(np.isfinite(bands).any())
    with styled(ax) as ax:
        _over_time(ax, run, values, chosen)
        low, high = values[kept] - bands, values[kept] + bands
        for i, name in enumerate(chosen):
            color = SERIES[i % len(SERIES)]
            if has_bands:
                ax.fill_between(run.t[kept], low[:, i], high[:, i], color=color, alpha=0.15, lw=0)
            if name in truth:
                ax.axhline(truth[name], color=color, linestyle="--", linewidth=0.9)
        if truth:
            ax.plot([], [], "--", color=COLORS["neutral"], linewidth=0.9, label="true values")
        units = joined(run.parameters[name] or "–" for name in chosen)
        ax.set(ylabel=f"learnt{', ± 2 sd' if has_bands else ''} [{units}]", title=title)
        if has_bands:
            # a band of what is not seen is that of the belief, beside which curves are flat
            seen = np.where(bands < _SEEN * bands[0], bands, 0.0)
            late = kept[kept >= _SHOWN * kept[-1]]
            ends = np.stack([values[kept] - seen, values[kept] + seen])[:, -len(late) :]
            shown = [*ends.ravel(), *(truth[name] for name in chosen if name in truth)]
            room = 0.05 * (max(shown) - min(shown)) or 1e-3
            ax.set_ylim(min(shown) - room, max(shown) + room)
    return ax


def plot_image(
    run: Trajectory,
    camera: Camera,
    ax: Axes | None = None,
    *,
    title: str = "Paths of the points in the image",
) -> Axes:
    """Draw the true path of each point through the image, from its start to its target.

    Measured images are dots. The border is a pinhole camera's field of view; v points down.

    Args:
        run: A run whose task is an image.
        camera: The true camera.
        ax: Axes to draw into; new ones by default.
        title: Of the axes.

    Raises:
        InvalidInputError: A run of another task, or no camera.
    """
    require("camera", camera, Camera, "a camera, such as that of the plant's ImageTask")
    if run.error.shape[1] % 2 or set(run.task_units) != {camera.unit}:
        raise InvalidInputError(
            f"run must be that of an image task, with coordinates in {camera.unit}, got "
            f"{', '.join(run.task_labels)} in {run.task_unit}",
            given=run,
        )
    k = run.error.shape[1] // 2
    true, measured = (x.reshape(len(run.t), k, -1)[:, :, :2] for x in (run.x, run.x_measured))
    target, grey = run.target.reshape(k, -1)[:, :2], COLORS["neutral"]
    dot: dict[str, Any] = {"color": grey, "ms": 3.5, "mew": 0, "alpha": 0.7}
    with styled(ax, columns=3) as ax:
        for i in range(k):
            color = _POINTS[i % len(_POINTS)]
            label = "path" if k == 1 else f"path {i + 1}"
            # an image that is held is one image; as pixels, or files would grow with the run
            new = np.append(True, (np.diff(measured[:, i], axis=0) != 0.0).any(axis=1))
            ax.plot(*true[:, i].T, color=color, label=label)
            ax.plot(*measured[new, i].T, ".", rasterized=True, **dot)
        ax.plot(*true[0].T, "o", color=grey, mfc="white", ms=7, label="start", zorder=4)
        ax.plot(*target.T, "x", color=COLORS["target"], ms=9, mew=2, label="target", zorder=5)
        ax.plot(*true[-1].T, "o", color=grey, ms=4, label="end", zorder=6)
        ax.plot([], [], ".", label="measured", **dot)
        ax.set_aspect("equal", adjustable="box", anchor="N")
        if isinstance(camera, PinholeCamera):
            low, high = np.array([-0.5, -0.5]), np.array(camera.size) - 0.5
            border = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
            ax.plot(*border.T, color=grey, linewidth=1.2, zorder=2)
            around = _AROUND * max(camera.size)
            ax.set(xlim=(low[0] - around, high[0] + around))
            ax.set(ylim=(high[1] + around, low[1] - around))  # v points down
        u, v = (formulas(f"{name} [{camera.unit}]") for name in camera.labels)
        ax.set(xlabel=u, ylabel=v, title=title)
    return ax


def plot_shares(
    x: Array,
    y: Array,
    shares: Array,
    *,
    labels: tuple[str, str],
    own: tuple[float, float] | None = None,
    ax: Axes | None = None,
    title: str = "Share of runs that converge",
) -> Axes:
    """Draw the share of runs that converge over two parameters, or an end of its interval.

    Args:
        x: Values of the first parameter, shape (N_x,).
        y: Values of the second, shape (N_y,).
        shares: Shares, shape (N_y, N_x), 0 to 1; NaN is left grey.
        labels: Labels of the two axes.
        own: The controller's own parameters, marked.
        ax: Axes to draw into; new ones by default.
        title: Title of the axes.
    """
    with styled(ax, (5.6, 4.6)) as ax:
        ax.set_facecolor("0.85")
        shown = ax.pcolormesh(
            x, y, np.ma.masked_invalid(shares), cmap="RdYlBu", vmin=0.0, vmax=1.0,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        ax.figure.colorbar(shown, ax=ax, label="share that converges [–]", shrink=0.8)
        if own is not None:
            ax.plot(*own, "*", color=SERIES[6], mec="white", ms=14, label="as given")
        for values, set_scale in ((x, ax.set_xscale), (y, ax.set_yscale)):
            if values[0] > 0.0 and values[-1] / values[0] > 20.0:
                set_scale("log")
        ax.set(xlabel=formulas(labels[0]), ylabel=formulas(labels[1]), title=title)
        ax.grid(visible=False)
    return ax
