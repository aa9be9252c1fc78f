"""A reach in words and pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from approxjac.robots.joint_limits import farthest_beyond
from approxjac.simulation import Trajectory
from approxjac.studies.reach import Result
from approxjac.validation import Array
from approxjac.view import (
    legend_below,
    new_figure,
    plot_error,
    plot_path,
    plot_slack,
    plot_torque,
    save_figure,
    style,
)
from approxjac.view.style import COLORS, SERIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def text(result: Result) -> str:
    """Where the arm started, went and ended, in a few lines."""
    run, reach = result.run, result.reach
    shares = {k: n / len(run.t) for k, n in run.status_counts().items()}
    ratio, excess = result.peak_torque_ratio, result.joint_limit_excess
    asks = "asks for up to" if reach.settings.torque_limits is None else "up to"
    torque = "no limit known" if math.isnan(ratio) else f"{asks} {ratio:.2f} of the limits"
    lines = [
        f"{reach.plant.robot!r}",
        f"gains       {reach.controller.gains!r}",
        f"joints      {_numbers(run.q[0])} -> {_numbers(run.q[-1])}",
        f"start       x = {_numbers(run.x[0])}",
        f"target      x = {_numbers(run.target)}",
        f"end         x = {_numbers(run.x[-1])} after {run.t[-1]:g} s",
        f"error       {_errors(result.errors_at(0))} -> {_errors(result.errors_at(-1))}",
        f"settled     {'not' if math.isnan(result.settling_time) else _settled(result)}",
        f"torque      {torque}",
        f"status      {', '.join(f'{s.name} {100 * share:.3g} %' for s, share in shares.items())}",
        f"verdict     {'converged' if result.converged else 'not converged: ' + result.reason}",
    ]
    lines[-1:-1] = _limits(result)
    if excess > 0.0:
        cure = ", which --torque-limits urdf keeps" if result.tally is None else ""
        lines.insert(-1, f"limits      {farthest_beyond(reach.plant.robot, run.q)}{cure}")
    lines[-1:-1] = moved_target(run)
    return "\n".join(lines)


def moved_target(run: Trajectory) -> list[str]:
    """What to say of a target that was moved while a run was shown; nothing if it was not."""
    if (run.x_d == run.x_d[0]).all():
        return []
    return ["shown       the target was moved while it ran: errors are to the target then"]


def _limits(result: Result) -> list[str]:
    """What a limiter did in all steps, in two lines; none without one."""
    tally, settings = result.tally, result.reach.settings
    if tally is None:
        return []
    shares = ", ".join(f"{s.name} {100.0 * share:.3g} %" for s, share in tally.shares().items())
    slack = tally.largest_slack
    known = "slack not known" if math.isnan(slack) else f"slack up to {slack:.3g} W"
    speed = result.peak_speed_ratio
    fast = "no speed limit known" if math.isnan(speed) else f"speeds up to {speed:.3g} of theirs"
    urdf = settings.torque_limits == "urdf"
    which = "the URDF's effort limits" if urdf else f"{settings.torque_limits} of the effort limits"
    return [
        f"limiter     {settings.limiter or 'qp'}, {which}: {shares}",
        f"            {known}; torques at most {tally.torque_violation:.1g} N m beyond their "
        f"limits, {fast}",
    ]


def draw(result: Result) -> Figure:
    """Error, torque against limits, the path in three planes; with a limiter slack and speeds."""
    run, reach = result.run, result.reach
    truth, belief = reach.plant.robot, reach.controller.task.robot
    settings = reach.settings
    title = (
        f"{run.robot_name}: the object is {settings.object_length:g} m long, "
        f"the controller believes {settings.believed_length:g} m"
    )
    limited = result.tally is not None
    figure, axes = new_figure(4 if limited else 3, 2, title=title)
    error, size, torque, *paths = [ax for i, ax in enumerate(axes) if not limited or i % 4 < 3]
    if limited:
        plot_slack(run, axes[3])
        _plot_speed(result, axes[7])
    plot_error(run, error)
    with style():
        size.semilogy(run.t, run.error_norm, color=SERIES[0])
        size.axhline(settings.tolerance, color=COLORS["neutral"], linewidth=1.0, linestyle="--")
        label = f"‖x − x_d‖ [{run.task_unit}]"
        size.set(
            xlabel="time [s]", ylabel=label, title="Size of the task error (dashed: tolerance)"
        )
    asked = "Torque of each joint" + (", asked for" if settings.torque_limits is None else "")
    plot_torque(run, torque, limits=result.motor_limits, title=asked)
    target = _position(result)
    for ax, plane in zip(paths, ("xz", "xy", "yz"), strict=True):
        plot_path(run, truth, plane=plane, ax=ax, believed=belief, target=target)
    return figure


def _plot_speed(result: Result, ax: Axes) -> None:
    """Draw the speed of each joint as a share of its limit; those without one are left out."""
    run, limits = result.run, result.speed_limits
    with style():
        for i, joint in enumerate(run.joint_names):
            if math.isfinite(limits[i]):
                color = SERIES[i % len(SERIES)]
                ax.plot(run.t, run.v[:, i] / limits[i], color=color, label=joint)
        for side, name in ((1.0, "limit"), (-1.0, None)):
            ax.axhline(side, color=COLORS["neutral"], linewidth=1.0, linestyle="--", label=name)
        ax.set(xlabel="time [s]", ylabel="q̇ / limit [–]", title="Speed of each joint")
    legend_below(ax)


def write(result: Result, out: Path) -> None:
    """Write run.png, run.svg, run.npz and summary.json into a folder."""
    save_figure(draw(result), out / "run")
    result.run.save(out / "run.npz")
    (out / "summary.json").write_text(
        json.dumps(result.summary(), indent=2) + "\n", encoding="utf-8"
    )


def _position(result: Result) -> Array | None:
    """Target in the world [m], or None where a target does not fix all three axes."""
    labels = result.run.task_labels
    if labels[:3] == ("x", "y", "z"):
        return result.run.target[:3]
    return None


def _settled(result: Result) -> str:
    units = " and ".join(dict.fromkeys(result.run.task_units))
    return f"to {result.reach.settings.tolerance:g} {units} after {result.settling_time:.3g} s"


def _errors(errors: dict[str, float]) -> str:
    scales = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "deg")}
    shown = [(value, *scales.get(unit, (1.0, unit))) for unit, value in errors.items()]
    return " and ".join(f"{factor * value:.3g} {unit}" for value, factor, unit in shown)


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:.4g}" for value in values) + "]"
