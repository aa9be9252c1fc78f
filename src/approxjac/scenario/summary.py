"""The result of a scenario in words, pictures and files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from approxjac.controllers import KinematicReport
from approxjac.files import together, write_text
from approxjac.formatting import numbers_of, rows, shares, wrapped
from approxjac.interface import LimitStatus
from approxjac.scenario.convert import differences, typed_as
from approxjac.scenario.outcome import RunResult
from approxjac.scenario.records import Belief
from approxjac.scenario.scenario import Scenario
from approxjac.tasks import ImageTask
from approxjac.tasks.analysis import place_of
from approxjac.view import (
    new_figure,
    plot_error,
    plot_image,
    plot_parameters,
    plot_path,
    plot_slack,
    plot_torque,
    save_figure,
)
from approxjac.view.style import display_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from approxjac.simulation import Trajectory


def write(result: RunResult, out: Path) -> None:
    """Write run.png, run.svg, run.npz, summary.json and scenario.toml into a folder.

    And kinematics.txt, .png and .svg, where they were learnt.
    """
    with together(out) as folder:
        save_figure(draw(result), folder / "run")
        result.run.save(folder / "run.npz")
        learning = result.built.learning
        if learning is not None:
            learnt = learning.kinematics_learnt(result.run.state[-1])
            write_text(folder / "kinematics.txt", f"{learnt}\n")
            save_figure(_draw_kinematics(result.run, learnt), folder / "kinematics")
        result.built.scenario.save(folder / "scenario.toml")
        summary = json.dumps(result.summary(), indent=2)
        write_text(folder / "summary.json", summary + "\n")


def text(result: RunResult) -> str:
    """Return the verdict, and then what the arm did, a line each."""
    run, built, torque = result.run, result.built, result.peak_torque_ratio
    law, robot = built.law, built.plant.robot
    lines = {
        "robot": f"{robot.name}, {robot.nv} joints, {robot.mass:.3g} kg with the object",
        "object": held(built.scenario),
        "believed": believed(built.scenario),
        "law": law.describe()[0],
        "q at start": numbers_of(robot.angles(run.q[0])),
        "q at end": numbers_of(robot.angles(run.q[-1])),
        "x at start": numbers_of(run.x[0]),
        "x at end": f"{numbers_of(run.x[-1])} after {run.t[-1]:g} s",
        "target": numbers_of(run.target),
        "settled": "not" if math.isnan(result.settling_time) else f"{result.settling_time:.3g} s",
        "torque": "no limit known"
        if math.isnan(torque)
        else f"{'asks for up to' if built.limits is None else 'up to'} "
        f"{100.0 * torque:.0f} % of the limits"
        f"{'' if built.plant.adds_gravity is None else ', with the gravity that the robot adds'}",
        "law's status": shares(run.status_counts()),
    }
    if learnt := law.describe_learnt(run.state[-1]):
        lines["learnt"] = learnt
    if built.learning is not None:
        report = built.learning.kinematics_learnt(run.state[-1])
        lines["kinematics"] = _kinematics(report, isinstance(built.plant.sensor, ImageTask))
    if built.limits is not None:
        lines["limits' status"] = shares(run.limit_status_counts())
    if run.at_stops:
        lines["stops"] = f"{run.describe_stops()}; up to {result.joint_limit_excess:.2g} beyond"
    if not result.on_path and (run.x_d != run.x_d[0]).any():
        lines["shown"] = "the target was moved while it ran: errors are to the target then"
    if built.warning:
        lines["warning"] = built.warning
    verdict = wrapped(": ".join(filter(None, (result.verdict, result.reason))))
    return "\n".join([*verdict, *wrapped(_error(result)), "", *rows(lines, 2)])


def _error(result: RunResult) -> str:
    """Return the error from start to end, or of a path, which begins at the arm, all along it."""
    unit, factor = display_unit(result.run.task_unit)
    within = f"{factor * result.tolerance:.3g} {unit}"
    if not result.on_path:
        size = f"error {_size(result.errors_at(0))} -> {_size(result.final_error)}"
        if math.isnan(result.settling_time):
            return f"{size}, where {within} is wanted"
        return f"{size}, within {within} from {result.settling_time:.3g} s on"
    largest, rms, last = (_size({result.run.task_unit: error}) for error in result.strayed)
    sizes = f"up to {largest} from the path, {rms} RMS, {last} in the last quarter"
    return f"{sizes}, where {within} is wanted"


def held(scenario: Scenario) -> str:
    """Return the object that the arm truly holds."""
    given = scenario.true.object
    if not given.length and not given.mass:
        return "none"
    along = f", along {typed_as(given.axis)} of the tip" if given.axis else ""
    return f"{given.length:g} m long, {given.mass:g} kg{along}"


def believed(scenario: Scenario) -> str:
    """Return what the controller believes that is wrong, by keys of [believed]."""
    true, belief = scenario.true, scenario.believed
    right = Belief(true.object, true.shifts, true.rotations)
    wrong = differences(replace(belief, object=belief.object.like(true.object)), right)
    parts = [
        f"{name} {key} {typed_as(value)}"
        for name, values in wrong.items()
        for key, value in values.items()
    ]
    return ", ".join(parts) or "what is true"


def draw(result: RunResult) -> Figure:
    """Draw error, torque, the path of the tip or through the image, and what limits did."""
    run, built, sensor = result.run, result.built, result.built.plant.sensor
    limited = bool((run.limit_status > LimitStatus.FREE).any())  # or there is nothing to see
    title = f"{run.robot_name}: {result.verdict}"
    figure, axes = new_figure(*((2, 2) if limited else (3, 1)), title=title)
    plot_error(run, axes[0])
    asked = run if built.plant.adds_gravity is None else replace(run, tau=result.motor_torque)
    plot_torque(asked, axes[1], limits=built.plant.motor_limits)
    if isinstance(sensor, ImageTask):
        plot_image(run, sensor.camera, axes[2])
    else:
        target = None if result.on_path else place_of(sensor, run.target)
        truth, belief = built.plant.robot, built.law.task.robot
        plot_path(run, truth, plane=_plane(result), ax=axes[2], believed=belief, target=target)
    if limited:
        plot_slack(run, axes[3])
    return figure


def _plane(result: RunResult) -> str:
    """Return the world axes that a path spreads along most, or else "xz"."""
    run = result.run
    if not result.on_path or run.task_labels[:3] != ("x", "y", "z"):
        return "xz"
    chosen = np.argsort(-np.ptp(run.x_d[:, :3], axis=0), kind="stable")[:2]
    return "".join("xyz"[i] for i in sorted(chosen))


def _kinematics(learnt: KinematicReport, is_image: bool) -> str:
    """Return tool and camera as they were learnt, and whether that explains x."""
    tool = [row.value for row in learnt.rows if row.name.startswith("tool.")]
    parts = [f"tool at {numbers_of(np.round(tool, 3))} m"] if tool else []
    if learnt.angle:
        which, rows = ("camera", "") if is_image else ("tracker", " (camera.r in kinematics.txt)")
        parts.append(f"{which} turned by {math.degrees(learnt.angle):.1f} deg{rows}")
    parts.append(f"chi squared {learnt.chi_squared:.2f} a degree of freedom")
    if not learnt.is_explained:
        why = f"; it may be: {learnt.suspects}" if learnt.suspects else ""
        parts.append(f"which does not explain x{why}")
    return ", ".join(parts)


def _draw_kinematics(run: Trajectory, learnt: KinematicReport) -> Figure:
    """Draw what was learnt of the tool, and of the tracker's rotation, where they were learnt."""
    names = [row.name for row in learnt.rows]
    groups = [[name for name in names if name.startswith(kind)] for kind in ("tool.", "camera.")]
    groups = [group for group in groups if group] or [names]
    figure, axes = new_figure(len(groups), title="What is learnt of the kinematics")
    for ax, group in zip(axes, groups, strict=True):
        plot_parameters(run, group, ax, title=group[0].partition(".")[0])
    return figure


def _size(errors: dict[str, float]) -> str:
    """Return errors to three digits: of lengths in mm below a metre, and not below 1 µm."""
    parts = []
    for unit, value in errors.items():
        shown, factor = (unit, 1.0) if unit == "m" and value >= 1.0 else display_unit(unit)
        size = "< 0.001" if factor * value < 1e-3 else f"{factor * value:.3g}"
        parts.append(f"{size} {shown}")
    return " and ".join(parts)
