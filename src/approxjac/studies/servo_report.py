"""A visual servoing run in words and pictures."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from approxjac.controllers import VelocityServo
from approxjac.interface import Status
from approxjac.robots.joint_limits import farthest_beyond
from approxjac.studies.reach_report import moved_target
from approxjac.studies.servo_result import ServoResult
from approxjac.studies.servo_settings import ServoSettings
from approxjac.tasks import CombinedTask, ImageTask
from approxjac.validation import Array
from approxjac.view import (
    legend_below,
    new_figure,
    plot_camera_view,
    plot_image,
    plot_lanes,
    plot_torque,
    save_figure,
    style,
)
from approxjac.view.images import POINTS
from approxjac.view.style import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def text(result: ServoResult) -> str:
    """Where the images started, went and ended, in a few lines."""
    run, servo, settings = result.run, result.servo, result.servo.settings
    shares = {k: 100.0 * n / len(run.t) for k, n in run.status_counts().items()}
    ratio, settled = result.peak_torque_ratio, result.settling_time
    within = f"within three tolerances ({3.0 * servo.tolerance:g} px) after {settled:.3g} s"
    lost = result.unseen
    asks = "asks for up to" if settings.torque_limits is None else "up to"
    lines = [
        f"{servo.plant.robot!r}",
        f"believed    {believed(settings)}",
        f"law         {_law(result)}",
        f"joints      {_numbers(run.q[0])} -> {_numbers(run.q[-1])}",
        f"start       {_points(run.x[0], result)}",
        f"target      {_points(run.target, result)}",
        f"end         {_points(run.x[-1], result)} after {run.t[-1]:g} s",
        f"error       {_numbers(result.errors[0], 3)} -> {_numbers(result.errors[-1], 3)} px; "
        f"at the end up to {result.final_error:.2g} px RMS, tolerance {servo.tolerance:g}",
        f"in view     {'always' if not lost.any() else f'not for {100.0 * lost.mean():.3g} %'}",
        f"settled     {'not' if math.isnan(settled) else within}",
        f"torque      {'no limit known' if math.isnan(ratio) else f'{asks} {ratio:.2f} of limits'}",
        f"images      {_images(result)}",
        f"status      {', '.join(f'{s.name} {share:.3g} %' for s, share in shares.items())}",
        f"verdict     {'converged' if result.converged else 'not converged: ' + result.reason}",
    ]
    lines[-1:-1] = [*_limits(result), *moved_target(run)]
    return "\n".join(lines)


def _limits(result: ServoResult) -> list[str]:
    """What limits did, and joints beyond theirs; nothing where there is nothing to say."""
    run, told = result.run, []
    if result.servo.settings.torque_limits is not None:
        counts = run.limit_status_counts()
        shares = [f"{s.name} {100.0 * n / len(run.t):.3g} %" for s, n in counts.items()]
        told.append(f"limits      {', '.join(shares)}")
    if result.joint_limit_excess > 0.0:
        cure = ""
        if result.servo.settings.torque_limits is None:
            cure = ", which --torque-limits urdf keeps"
        told.append(f"limits      {farthest_beyond(result.servo.plant.robot, result.run.q)}{cure}")
    return told


def believed(settings: ServoSettings) -> str:
    """What a controller believes that is wrong, in words."""
    wrong = []
    if settings.roll != 0.0:
        wrong.append(f"camera rolled by {math.degrees(settings.roll):.3g}°")
    if any(settings.camera_rotation):
        turned = math.degrees(float(np.linalg.norm(settings.camera_rotation)))
        wrong.append(f"camera turned by {turned:.3g}°")
    if any(settings.camera_shift):
        moved = 1e3 * float(np.linalg.norm(settings.camera_shift))
        wrong.append(f"camera {moved:.3g} mm off")
    if settings.focal_factor != 1.0:
        wrong.append(f"focal length × {settings.focal_factor:g}")
    if settings.depth_factor != 1.0:
        wrong.append(f"depth × {settings.depth_factor:g}")
    if any(settings.distortion):
        wrong.append("no distortion")
    lengths = settings.believed_length, settings.object_length
    if lengths[0] != lengths[1]:
        wrong.append("object {:g} m long instead of {:g} m".format(*lengths))
    masses = settings.believed_mass, settings.object_mass
    if masses[0] != masses[1]:
        wrong.append("object of {:g} kg instead of {:g} kg".format(*masses))
    return ", ".join(wrong) or "what is true"


def draw_run(result: ServoResult) -> Figure:
    """Errors of the points, torques against limits, and what became of the images."""
    run = result.run
    figure, (error, torque, images) = new_figure(3, size=(12.9, 5.0), title=_title(result, 110))
    _plot_errors(result, error)
    plot_torque(run, torque, limits=result.servo.plant.robot.effort_limits)
    lanes = {
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


def draw_image(result: ServoResult) -> Figure:
    """The paths of the points through the image."""
    title = _title(result, 60)
    figure, (ax,) = new_figure(size=(6.4, 5.6 + 0.25 * title.count("\n")), title=title)
    plot_image(
        result.run,
        result.servo.sensor.camera,
        ax,
        title="Paths of the points in the true camera's image",
    )
    return figure


def draw_views(result: ServoResult) -> Figure:
    """What the true camera sees at start and end, and what the controller believes that it sees."""
    servo, run = result.servo, result.run
    task = servo.controller.task
    wrong = task.task if isinstance(task, CombinedTask) else task
    assert isinstance(wrong, ImageTask)  # as it was prepared
    figure, axes = new_figure(2, size=(11.5, 6.0), title=_title(result, 100))
    for ax, k, when in ((axes[0], 0, "at the start"), (axes[1], -1, f"after {run.t[-1]:g} s")):
        plot_camera_view(
            servo.sensor, run.q[k], ax, believed=wrong, target=run.target,
            title=f"What the camera sees {when}, and what is believed",
        )  # fmt: skip
    return figure


def write(result: ServoResult, out: Path) -> None:
    """Write run, image and views as .png and .svg, run.npz and summary.json into a folder."""
    save_figure(draw_run(result), out / "run")
    save_figure(draw_image(result), out / "image")
    save_figure(draw_views(result), out / "views")
    result.run.save(out / "run.npz")
    (out / "summary.json").write_text(
        json.dumps(result.summary(), indent=2) + "\n", encoding="utf-8"
    )


def _plot_errors(result: ServoResult, ax: Axes) -> None:
    tolerance = result.servo.tolerance
    with style():
        for i, error in enumerate(result.errors.T):
            ax.semilogy(result.run.t, error, color=POINTS[i], label=f"point {i + 1}")
        ax.axhline(tolerance, color=COLORS["neutral"], linestyle="--", label="tolerance")
        ax.set_ylim(bottom=0.05 * tolerance)  # what is smaller is noise
        ax.set(
            xlabel="time [s]",
            ylabel="distance to the target [px]",
            title="True distance of each point to its target",
        )
    legend_below(ax)


def _title(result: ServoResult, width: int) -> str:
    """What was run and is believed, in lines of so many letters."""
    settings = result.servo.settings
    eye = "camera in the world" if settings.eye == "to-hand" else "camera on the arm"
    wrong = (
        believed(settings).replace(" ", "\N{NO-BREAK SPACE}").replace(",\N{NO-BREAK SPACE}", ", ")
    )
    words = f"{result.run.robot_name}, {eye}. The controller believes: {wrong}"
    return textwrap.fill(words, width)


def _law(result: ServoResult) -> str:
    controller = result.servo.controller
    if isinstance(controller, VelocityServo):
        return f"classical visual servoing (ibvs), rate {controller.rate:.3g} 1/s"
    return f"({result.servo.settings.law}) with {controller.gains!r}"


def _images(result: ServoResult) -> str:
    waiting, braked = result.waiting.mean(), result.braked.mean()
    rate = result.servo.settings.frame_rate
    return (
        f"new at {rate:g} Hz {100.0 * (1.0 - waiting - braked):.3g} % of the time, "
        f"last one held longer {100.0 * waiting:.3g} %, too old, so that the arm brakes, "
        f"{100.0 * braked:.3g} %"
    )


def _points(x: Array, result: ServoResult) -> str:
    """Images of the points of a value, as (u, v)."""
    images = x.reshape(len(result.servo.sensor.points), -1)[:, :2]
    return " ".join(f"({u:.1f}, {v:.1f})" for u, v in images) + " px"


def _numbers(values: Array, digits: int = 4) -> str:
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:.{digits}g}" for value in values) + "]"
