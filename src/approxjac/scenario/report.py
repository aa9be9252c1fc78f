"""What became of a scenario, in words and pictures."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.interface import Status
from approxjac.robots.joint_limits import farthest_beyond
from approxjac.scenario.image_result import ImageResult
from approxjac.scenario.result import Result
from approxjac.scenario.scenario import Scenario
from approxjac.tasks import CombinedTask
from approxjac.validation import Array
from approxjac.view import (
    new_figure,
    plot_camera_view,
    plot_error,
    plot_image,
    plot_lanes,
    plot_path,
    plot_slack,
    plot_torque,
    save_figure,
    style,
)
from approxjac.view.images import POINTS
from approxjac.view.style import COLORS, SERIES, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def write(result: Result, out: Path) -> None:
    """Write the pictures, run.npz, summary.json and scenario.toml into a folder."""
    for name, figure in draw(result).items():
        save_figure(figure, out / name)
    result.run.save(out / "run.npz")
    result.built.scenario.save(out / "scenario.toml")
    summary = json.dumps(result.summary(), indent=2)
    (out / "summary.json").write_text(summary + "\n", encoding="utf-8")


def draw(result: Result) -> dict[str, Figure]:
    """Draw the pictures of a result, by name."""
    if isinstance(result, ImageResult):
        return {
            "run": _draw_image_run(result),
            "image": _draw_image(result),
            "views": _draw_views(result),
        }
    return {"run": _draw_run(result)}


# -- words ------------------------------------------------------------------------------


def text(result: Result) -> str:
    """Say where the arm started, went and ended, in a few lines."""
    run, built = result.run, result.built
    shares = {k: 100.0 * n / len(run.t) for k, n in run.status_counts().items()}
    told = {
        "believed": believed(built.scenario),
        "law": _law(result),
        "joints": f"{_numbers(run.q[0])} -> {_numbers(run.q[-1])}",
        "start": _value(run.x[0], result),
        "target": _value(run.target, result),
        "end": f"{_value(run.x[-1], result)} after {run.t[-1]:g} s",
        "error": _error(result),
        **_images(result),
        "settled": _settled(result),
        "torque": _torque(result),
        "status": ", ".join(f"{s.name} {share:.3g} %" for s, share in shares.items()),
    }
    lines = [repr(built.plant.robot), *(f"{name:<11} {line}" for name, line in told.items())]
    lines += [*_limits(result), *_moved_target(result)]
    verdict = "converged" if result.converged else f"not converged: {result.reason}"
    return "\n".join([*lines, f"verdict     {verdict}"])


def believed(scenario: Scenario) -> str:
    """Say what a controller believes that is wrong."""
    true, belief, camera = scenario.true, scenario.believed, scenario.believed.camera
    wrong = []
    if camera.roll != 0.0:
        wrong.append(f"camera rolled by {math.degrees(camera.roll):.3g}°")
    if any(camera.rotation):
        turned = math.degrees(float(np.linalg.norm(camera.rotation)))
        wrong.append(f"camera turned by {turned:.3g}°")
    if any(camera.shift):
        wrong.append(f"camera {1e3 * float(np.linalg.norm(camera.shift)):.3g} mm off")
    if camera.focal_factor != 1.0:
        wrong.append(f"focal length × {camera.focal_factor:g}")
    if camera.depth_factor != 1.0:
        wrong.append(f"depth × {camera.depth_factor:g}")
    pinhole = scenario.task.kind == "image" and true.camera.kind == "pinhole"
    if pinhole and any(true.camera.distortion):
        wrong.append("no distortion")
    if belief.object.length != true.object.length:
        lengths = belief.object.length, true.object.length
        wrong.append("object {:g} m long instead of {:g} m".format(*lengths))
    if belief.object.mass != true.object.mass:
        masses = belief.object.mass, true.object.mass
        wrong.append("object of {:g} kg instead of {:g} kg".format(*masses))
    shifts, rotations = (
        {k: v for part in (true, belief) for k, v in getattr(part, name).items() if any(v)}
        for name in ("shifts", "rotations")
    )
    wrong += [f"origin of {joint} off" for joint in shifts]
    wrong += [f"axis of {joint} off" for joint in rotations]
    return ", ".join(wrong) or "what is true"


def _law(result: Result) -> str:
    law = result.built.law
    number = "28" if law.adaptation is not None else "6" if law.velocity is None else "5"
    return f"({number}) with {law.gains!r}"


def _value(x: Array, result: Result) -> str:
    if not isinstance(result, ImageResult):
        return f"x = {_numbers(x)}"
    images = x.reshape(len(result.sensor.points), -1)[:, :2]
    return " ".join(f"({u:.1f}, {v:.1f})" for u, v in images) + " px"


def _error(result: Result) -> str:
    if isinstance(result, ImageResult):
        return (
            f"{_numbers(result.errors[0], 3)} -> {_numbers(result.errors[-1], 3)} px; at the end "
            f"up to {result.final_error:.2g} px RMS, tolerance {result.tolerance:g}"
        )
    scales = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "deg")}
    shown = [
        [(value, *scales.get(unit, (1.0, unit))) for unit, value in result.errors_at(k).items()]
        for k in (0, -1)
    ]
    return " -> ".join(
        " and ".join(f"{factor * value:.3g} {unit}" for value, factor, unit in errors)
        for errors in shown
    )


def _settled(result: Result) -> str:
    if math.isnan(result.settling_time):
        return "not"
    if isinstance(result, ImageResult):
        within = f"within three tolerances ({3.0 * result.tolerance:g} px)"
        return f"{within} after {result.settling_time:.3g} s"
    units = " and ".join(dict.fromkeys(result.run.task_units))
    return f"to {result.tolerance:g} {units} after {result.settling_time:.3g} s"


def _torque(result: Result) -> str:
    ratio = result.peak_torque_ratio
    if math.isnan(ratio):
        return "no limit known"
    return f"{'asks for up to' if result.tally is None else 'up to'} {ratio:.2f} of the limits"


def _images(result: Result) -> dict[str, str]:
    """What became of the images, where there are some."""
    if not isinstance(result, ImageResult):
        return {}
    lost, waiting, braked = result.unseen, result.waiting.mean(), result.braked.mean()
    rate = result.built.scenario.sensor.rate
    often = "at each step" if rate is None else f"at {rate:g} Hz"
    return {
        "in view": "always" if not lost.any() else f"not for {100.0 * lost.mean():.3g} %",
        "images": (
            f"new {often} {100.0 * (1.0 - waiting - braked):.3g} % of the time, "
            f"last one held longer {100.0 * waiting:.3g} %, too old, so that the arm brakes, "
            f"{100.0 * braked:.3g} %"
        ),
    }


def _limits(result: Result) -> list[str]:
    """Return what limits did in all steps, and which joint was beyond its limits."""
    lines, tally, chosen = [], result.tally, result.built.scenario.controller
    if tally is not None:
        shares = ", ".join(f"{s.name} {100.0 * n:.3g} %" for s, n in tally.shares().items())
        slack, speed = tally.largest_slack, result.peak_speed_ratio
        known = "slack not known" if math.isnan(slack) else f"slack up to {slack:.3g} W"
        fast = (
            "no speed limit known" if math.isnan(speed) else f"speeds up to {speed:.3g} of theirs"
        )
        urdf = chosen.limits == "urdf"
        which = "the URDF's effort limits" if urdf else f"{chosen.limits} of the effort limits"
        lines += [
            f"limited     {which}: {shares}",
            f"            {known}; torques at most {tally.torque_violation:.1g} N m beyond their "
            f"limits, {fast}",
        ]
    if result.joint_limit_excess > 0.0:
        cure = ", which --limits urdf keeps" if tally is None else ""
        lines.append(f"limits      {farthest_beyond(result.built.plant.robot, result.run.q)}{cure}")
    return lines


def _moved_target(result: Result) -> list[str]:
    """What to say of a target that was moved while a run was shown; nothing if it was not."""
    run = result.run
    if not isinstance(result.built.target, np.ndarray) or (run.x_d == run.x_d[0]).all():
        return []
    return ["shown       the target was moved while it ran: errors are to the target then"]


def _numbers(values: Array, digits: int = 4) -> str:
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:.{digits}g}" for value in values) + "]"


# -- pictures ---------------------------------------------------------------------------


def _title(result: Result, width: int) -> str:
    """What was run and is believed, in lines of so many letters."""
    words = believed(result.built.scenario).replace(" ", "\N{NO-BREAK SPACE}")
    words = words.replace(",\N{NO-BREAK SPACE}", ", ")
    return textwrap.fill(f"{result.run.robot_name}. The controller believes: {words}", width)


def _draw_run(result: Result) -> Figure:
    """Error, torque against limits, the path in three planes; with a limiter slack and speeds."""
    run, built = result.run, result.built
    limited = result.tally is not None
    figure, axes = new_figure(4 if limited else 3, 2, title=_title(result, 120))
    error, size, torque, *paths = [ax for i, ax in enumerate(axes) if not limited or i % 4 < 3]
    if limited:
        plot_slack(run, axes[3])
        _plot_speed(result, axes[7])
    plot_error(run, error)
    with style():
        size.semilogy(run.t, run.error_norm, color=SERIES[0])
        size.axhline(result.tolerance, color=COLORS["neutral"], linewidth=1.0, linestyle="--")
        label = f"‖x − x_d‖ [{run.task_unit}]"
        size.set(
            xlabel="time [s]", ylabel=label, title="Size of the task error (dashed: tolerance)"
        )
    asked = "Torque of each joint" + ("" if limited else ", asked for")
    plot_torque(run, torque, limits=built.motor_limits, title=asked)
    # a target that does not fix all three axes has no place in the world
    target = run.target[:3] if run.task_labels[:3] == ("x", "y", "z") else None
    belief = built.law.task.robot
    for ax, plane in zip(paths, ("xz", "xy", "yz"), strict=True):
        plot_path(run, built.plant.robot, plane=plane, ax=ax, believed=belief, target=target)
    return figure


def _plot_speed(result: Result, ax: Axes) -> None:
    """Draw the speed of each joint as a share of its limit; those without one are left out."""
    run, limits = result.run, result.speed_limits
    with styled(ax):
        for i, joint in enumerate(run.joint_names):
            if math.isfinite(limits[i]):
                color = SERIES[i % len(SERIES)]
                ax.plot(run.t, run.v[:, i] / limits[i], color=color, label=joint)
        for side, name in ((1.0, "limit"), (-1.0, None)):
            ax.axhline(side, color=COLORS["neutral"], linewidth=1.0, linestyle="--", label=name)
        ax.set(xlabel="time [s]", ylabel="q̇ / limit [–]", title="Speed of each joint")


def _draw_image_run(result: ImageResult) -> Figure:
    """Errors of the points, torques against limits, and what became of the images."""
    run = result.run
    figure, (error, torque, images) = new_figure(3, size=(12.9, 5.0), title=_title(result, 110))
    _plot_errors(result, error)
    plot_torque(run, torque, limits=result.built.plant.robot.effort_limits)
    lanes: dict[str, Any] = {
        "new images": ~result.waiting & ~result.braked,
        "last one held": result.waiting,
        "too old: brakes": result.braked,
        "out of view": result.unseen,
    }
    words = {Status.NEAR_SINGULAR: "near singular", Status.TORQUE_SATURATED: "torque saturated"}
    lanes |= {words[s]: run.status == s for s in run.status_counts() if s in words}
    colors = {words[Status.TORQUE_SATURATED]: COLORS["saturated"]}
    plot_lanes(run.t, lanes, images, colors=colors, title="What the controller goes by, and when")
    return figure


def _plot_errors(result: ImageResult, ax: Axes) -> None:
    with styled(ax):
        for i, error in enumerate(result.errors.T):
            ax.semilogy(result.run.t, error, color=POINTS[i], label=f"point {i + 1}")
        ax.axhline(result.tolerance, color=COLORS["neutral"], linestyle="--", label="tolerance")
        ax.set_ylim(bottom=0.05 * result.tolerance)  # what is smaller is noise
        ax.set(
            xlabel="time [s]",
            ylabel="distance to the target [px]",
            title="True distance of each point to its target",
        )


def _draw_image(result: ImageResult) -> Figure:
    """The paths of the points through the image."""
    title = _title(result, 60)
    figure, (ax,) = new_figure(size=(6.4, 5.6 + 0.25 * title.count("\n")), title=title)
    named = "Paths of the points in the true camera's image"
    plot_image(result.run, result.sensor.camera, ax, title=named)
    return figure


def _draw_views(result: ImageResult) -> Figure:
    """What the true camera sees at start and end, and what the controller believes that it sees."""
    run, task = result.run, result.built.law.task
    wrong: Any = task.task if isinstance(task, CombinedTask) else task
    figure, axes = new_figure(2, size=(11.5, 6.0), title=_title(result, 100))
    for ax, k, when in ((axes[0], 0, "at the start"), (axes[1], -1, f"after {run.t[-1]:g} s")):
        plot_camera_view(
            result.sensor, run.q[k], ax, believed=wrong, target=run.target,
            title=f"What the camera sees {when}, and what is believed",
        )  # fmt: skip
    return figure
