"""The result of a scenario in words, pictures and files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.controllers import (
    ControllerWrapper,
    KinematicReport,
    SetpointController,
    TrackingController,
)
from approxjac.files import write_text
from approxjac.formatting import listed
from approxjac.interface import LimitStatus, Status
from approxjac.scenario.records import Belief, Object
from approxjac.scenario.result import Result
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.tables import differences, toml
from approxjac.tasks import ImageTask
from approxjac.tasks.analysis import place_of
from approxjac.view import (
    new_figure,
    plot_error,
    plot_image,
    plot_kinematics,
    plot_path,
    plot_slack,
    plot_torque,
    save_figure,
)
from approxjac.view.style import display_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from approxjac.simulation import Trajectory


def write(result: Result, out: Path) -> None:
    """Write run.png, run.svg, run.npz, summary.json and scenario.toml into a folder.

    And kinematics.txt, .png and .svg, where they were learnt.
    """
    save_figure(draw(result), out / "run")
    result.run.save(out / "run.npz")
    learning = result.built.learning
    if learning is not None:
        learnt = learning.kinematics_learnt(result.run.state[-1])
        write_text(out / "kinematics.txt", f"{learnt}\n")
        save_figure(_draw_kinematics(result.run, learning, learnt), out / "kinematics")
    result.built.scenario.save(out / "scenario.toml")
    summary = json.dumps(result.summary(), indent=2)
    write_text(out / "summary.json", summary + "\n")


def text(result: Result) -> str:
    """Return where the arm started, went and ended, and the verdict, a line each."""
    run, built, torque = result.run, result.built, result.peak_torque_ratio
    law = built.law
    told = {
        "object": toml(_held(built.scenario)),
        "believed": believed(built.scenario),
        "law": _law(law),
        "joints": f"{listed(run.q[0])} -> {listed(run.q[-1])}",
        "x": f"{listed(run.x[0])} -> {listed(run.x[-1])} after {run.t[-1]:g} s",
        "target": listed(run.target),
        **_error(result),
        "tolerance": f"{result.tolerance:.4g} {run.task_unit}",
        "settled": "not" if math.isnan(result.settling_time) else f"{result.settling_time:.3g} s",
        "torque": "no limit known"
        if math.isnan(torque)
        else f"{'asks for up to' if built.limits is None else 'up to'} {torque:.2f} of the limits",
        "status": _shares(run.status_counts()),
    }
    if isinstance(law, SetpointController) and law.adaptation is not None:
        told["learnt"] = law.adaptation.words(law.learnt(run.state[-1]), law.task)
    if built.learning is not None:
        learnt = built.learning.kinematics_learnt(run.state[-1])
        told["kinematics"] = _kinematics(learnt, isinstance(built.plant.sensor, ImageTask))
    if built.limits is not None:
        told["limits"] = _shares(run.limit_status_counts())
    if run.at_stops:
        told["stops"] = f"{run.stops_told()}; up to {result.joint_limit_excess:.2g} beyond"
    if not result.on_path and (run.x_d != run.x_d[0]).any():
        told["shown"] = "the target was moved while it ran: errors are to the target then"
    if built.warning:
        told["warning"] = built.warning
    told["verdict"] = ": ".join(filter(None, (result.verdict, result.reason)))
    lines = [f"{name:<11} {line}" for name, line in told.items()]
    return "\n".join([repr(built.plant.robot), *lines])


def _error(result: Result) -> dict[str, str]:
    """Return the error from start to end, or of a path, which begins at the arm, all along it."""
    if not result.on_path:
        return {"error": f"{_size(result.errors_at(0))} -> {_size(result.final_error)}"}
    largest, rms, last = (_size({result.run.task_unit: error}) for error in result.strayed)
    return {"strayed": f"up to {largest} from the path, {rms} RMS, {last} in the last quarter"}


def _held(scenario: Scenario) -> dict[str, Any]:
    """Return the object that the arm truly holds."""
    held = scenario.true.object
    return {"length": held.length, "mass": held.mass} | differences(held, Object())


def believed(scenario: Scenario) -> str:
    """Return what the controller believes that is wrong, as keys of [believed]."""
    true, belief = scenario.true, scenario.believed
    right = Belief(true.object, true.shifts, true.rotations)
    wrong = differences(replace(belief, object=belief.object.like(true.object)), right)
    return ", ".join(f"{key} = {toml(value)}" for key, value in wrong.items()) or "what is true"


def draw(result: Result) -> Figure:
    """Draw error, torque, the path of the tip or through the image, and what limits did."""
    run, built, sensor = result.run, result.built, result.built.plant.sensor
    limited = bool((run.limit_status > LimitStatus.FREE).any())  # or there is nothing to see
    title = f"{run.robot_name}: {result.verdict}"
    figure, axes = new_figure(*((2, 2) if limited else (3, 1)), title=title)
    plot_error(run, axes[0])
    plot_torque(run, axes[1], limits=built.plant.motor_limits)
    if isinstance(sensor, ImageTask):
        plot_image(run, sensor.camera, axes[2])
    else:
        target = None if result.on_path else place_of(sensor, run.target)
        truth, belief = built.plant.robot, built.law.task.robot
        plot_path(run, truth, plane=_plane(result), ax=axes[2], believed=belief, target=target)
    if limited:
        plot_slack(run, axes[3])
    return figure


def _plane(result: Result) -> str:
    """Return the world axes that a path spreads along most, or else "xz"."""
    run = result.run
    if not result.on_path or run.task_labels[:3] != ("x", "y", "z"):
        return "xz"
    chosen = np.argsort(-np.ptp(run.x_d[:, :3], axis=0), kind="stable")[:2]
    return "".join("xyz"[i] for i in sorted(chosen))


def _kinematics(learnt: KinematicReport, is_image: bool) -> str:
    """Return tool and camera as they were learnt, and whether that explains x."""
    tool = [row.value for row in learnt.rows if row.name.startswith("tool.")]
    told = [f"tool at {listed(np.round(tool, 3))} m"] if tool else []
    if learnt.angle:
        which, rows = ("camera", "") if is_image else ("tracker", " (camera.r in kinematics.txt)")
        told.append(f"{which} turned by {math.degrees(learnt.angle):.1f} deg{rows}")
    told.append(f"chi squared {learnt.chi_squared:.2f} a degree of freedom")
    if not learnt.is_explained:
        why = ": its center and distortion are not learnt" if learnt.unit == "px" else ""
        told.append(f"which does not explain x{why}")
    return ", ".join(told)


def _law(law: SetpointController | TrackingController) -> str:
    """Return which law it is, and its gains."""
    if isinstance(law, TrackingController):
        return f"T with alpha={law.alpha:.4g}, kappa={law.kappa:.4g}"
    number = "28" if law.adaptation is not None else "6" if law.velocity is None else "5"
    return f"({number}) with {law.gains!r}"


def _draw_kinematics(
    run: Trajectory, learning: TrackingController | ControllerWrapper, learnt: KinematicReport
) -> Figure:
    """Draw what was learnt of the tool, and of the tracker's rotation, where they were learnt."""
    names = [row.name for row in learnt.rows]
    groups = [[name for name in names if name.startswith(kind)] for kind in ("tool.", "camera.")]
    groups = [group for group in groups if group] or [names]
    figure, axes = new_figure(len(groups), title="What is learnt of the kinematics")
    for ax, group in zip(axes, groups, strict=True):
        plot_kinematics(run, learning, group, ax, title=group[0].partition(".")[0])
    return figure


def _size(errors: dict[str, float]) -> str:
    shown = [(value, *display_unit(unit)) for unit, value in errors.items()]
    return " and ".join(f"{factor * value:.3g} {unit}" for value, unit, factor in shown)


def _shares(counts: Mapping[Status, int] | Mapping[LimitStatus, int]) -> str:
    total = sum(counts.values())
    return ", ".join(f"{status.name} {100.0 * n / total:.3g} %" for status, n in counts.items())
