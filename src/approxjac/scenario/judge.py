"""The stability of a scenario's loop before it runs: tests, text, pictures and files."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from approxjac import stability, view
from approxjac.cameras import Camera
from approxjac.controllers import Limits, SetpointController, TorqueLimited
from approxjac.files import together, write_text
from approxjac.formatting import plain, wrapped
from approxjac.robots import KinematicBelief, Robot
from approxjac.scenario import build
from approxjac.scenario.records import Analysis, Goal
from approxjac.scenario.refusals import require_reportable
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.starts import configuration_of
from approxjac.simulation import Plant
from approxjac.stability import Region, StabilityReport, Study, Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.search.map import PARAMETERS, own_values, require_parameters
from approxjac.stability.search.tolerance import Test, Tolerance
from approxjac.stability.studied_loop import Progress
from approxjac.tasks import CombinedTask, ImageTask, Task
from approxjac.tasks.analysis import features, fine_error
from approxjac.validation import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AWAY = 0.01  # that the start of a refuting run is away from its target [rad or m]
_OF_MAP = ("names", "x", "y", "share", "intervals")  # in summary.json


@dataclass(frozen=True, eq=False)
class StabilityResult:
    """The tests of a loop, its tolerances and map; None where not needed."""

    scenario: Scenario
    study: Study
    report: StabilityReport
    tolerances: dict[Test, Tolerance] = field(default_factory=dict)  # scales of the errors
    map: stability.StabilityMap | None = None


def uncertainty_of(study: Study) -> Uncertainty | None:
    """Return the set of true robots of a study, if anything is uncertain."""
    truth = study.uncertainty
    return truth if isinstance(truth, Uncertainty) and truth.d > 0 else None


def prepare(scenario: Scenario) -> Study:
    """Return the study of a scenario's controller, with the errors that it may meet."""
    require_reportable(scenario)
    analysis, choice = scenario.stability, scenario.controller
    arm, gravity = build.loaded_arm(scenario), choice.gravity
    if gravity == "exact":  # eq. (9): what is compensated exactly is not felt
        arm, gravity = arm.with_gravity((0.0, 0.0, 0.0)), "none"
    # a report is of whatever target; limits come around the law that is built
    choice = replace(choice, gravity=gravity, limits="none")
    built = build.build_scenario(replace(scenario, controller=choice), arm)
    truth = _truth(arm, built, analysis)
    law = cast(SetpointController, built.law)  # tracking is refused
    limits = build.limits_of(scenario, law.task.robot)
    run, timing = scenario.run, build.latency_of(scenario)
    study = Study(
        # a report looks at efforts alone
        law if limits is None else TorqueLimited(law, Limits(effort=limits.effort)),
        truth,
        _region(law, analysis),
        target=analysis.target,
        latency=timing,
        sensing=build.sensing_of(scenario.sensor),
        duration=max(1, round(run.duration / timing.period)) * timing.period,
        accuracy=run.tolerance or fine_error(law.task.units, scenario.sensor.noise),
        seed=run.seed,
    )
    require_parameters(analysis.map)
    return replace(study, region=study.loop().region)  # refuses what does not fit


def analyse(
    scenario: Scenario,
    study: Study,
    executor: Executor | None = None,
    progress: Progress = None,
    show: Callable[[StabilityReport], None] = lambda report: None,
) -> StabilityResult:
    """Return the tests of a study that `prepare` made, the errors that they tolerate, and the map.

    The executor shares the rollouts; `show` gets the report long before the rest is known.
    """
    analysis, uncertainty = scenario.stability, uncertainty_of(study)
    execution = stability.Execution(executor=executor)
    runs = analysis.runs if isinstance(study.uncertainty, Uncertainty) else 0
    report = study.report(
        analysis.configurations,
        moves=analysis.moves,
        runs=runs,
        execution=execution,
        progress=progress,
    )
    assert isinstance(report, StabilityReport)  # the laws of scenarios have certificates
    show(report)
    tolerances: dict[Test, Tolerance] = {}
    if uncertainty is not None and report.gravity_is_exact:  # as all tests but rollouts assume
        tolerances = study.tolerance(progress=progress)
    map_ = None
    if uncertainty is not None and analysis.map_points:
        n = analysis.map_points
        points = {name: _values(name, report.loop, uncertainty, n) for name in analysis.map}
        unlimited = replace(study, controller=report.loop.controller)
        map_ = unlimited.map(points, analysis.map_runs, execution=execution, progress=progress)
    return StabilityResult(scenario, study, report, tolerances, map_)


def _truth(arm: Robot, built: build.BuiltScenario, analysis: Analysis) -> Uncertainty | Plant:
    ranges = [each.name for each in fields(Uncertainty) if hasattr(analysis, each.name)]
    given = {name: getattr(analysis, name) for name in ranges}
    true, believed = built.scenario.true, built.scenario.believed
    given["covariance"] = true.calibration and KinematicBelief.load(true.calibration)
    sensor, task = built.plant.sensor, built.law.task
    C = task.C if isinstance(task, CombinedTask) else None  # errors are compared, so alike
    if not any(given.values()):
        sensor = sensor if C is None else CombinedTask(sensor, C)
        return Plant(built.plant.robot, sensor, true.friction)
    if believed.shifts or believed.rotations:
        arm = arm.with_kinematic_error(believed.shifts, believed.rotations)
    held = believed.object
    if not (analysis.object_length or analysis.object_mass or held.length or held.mass):
        # whose tip the law has
        arm = build.holding(arm, held.like(true.object), {}, {})
    make: Callable[..., Task] = task.on
    if isinstance(sensor, ImageTask):
        make = partial(_image_task, sensor, C)
    return Uncertainty(
        arm,
        make,
        believed_length=believed.object.length,
        believed_mass=believed.object.mass,
        object_axis=believed.object.like(true.object).axis,
        camera=features(task)[0].camera,
        friction=true.friction,
        **given,
    )


def _image_task(like: ImageTask, C: Array | None, robot: Robot, camera: Camera) -> Task:
    task = ImageTask(robot, camera, points=like.points, depth=like.depth)
    return task if C is None else CombinedTask(task, C)


def _region(controller: SetpointController, analysis: Analysis) -> Region | None:
    belief, least = controller.task.robot, analysis.sigma_min
    region: Region | None = None if least is None else stability.JointBox(belief)
    if analysis.around is not None:
        q = configuration_of(belief, "stability.around", analysis.around, within_limits=False)
        region = stability.JointBox.around(belief, q, analysis.radius)
    if region is None or least is None:
        return region
    return stability.RegularPart(region, controller.task, least)


def _values(name: str, loop: ClosedLoop, uncertainty: Uncertainty, count: int) -> Array:
    shares, own = np.linspace(0.0, 1.0, count), own_values(loop.controller)[name]
    values = own * 10.0 ** (2.0 * shares - 1.0)
    if name == "error":
        values = uncertainty.largest_scale(3.0) * shares
    if count > 2 and values[0] < own < values[-1]:  # the report's own point is one of the map
        values[1 + np.abs(values[1:-1] - own).argmin()] = own
    return np.asarray(values)


def consequences(result: StabilityResult, out: Path) -> str:
    """Return the errors tolerated, and the outcome of the map."""
    blocks: list[list[str]] = []
    if result.tolerances:
        how = "by a search on fewer configurations; a report may find less:"
        blocks.append([*wrapped(how), *map(str, result.tolerances.values())])
    if result.map is not None:
        blocks.append([str(result.map), f"The map is {out / 'map.png'}"])
    if refutation(result) is not None:
        blocks.append(
            [f"That robot, beside that target: approxjac simulate {out / 'refuted.toml'}"]
        )
    return "\n\n".join("\n".join(block) for block in blocks)


def draw_map(result: StabilityResult) -> Figure | None:
    """Draw the share of runs that converge, between its interval's ends; None of no map."""
    grid = result.map
    if grid is None:
        return None
    controller = result.report.loop.controller
    name, runs = controller.task.robot.name, result.scenario.stability.map_runs
    title = (
        f"{name}: share of {runs} runs per point that converge, with 95 % confidence; "
        f"errors are {result.study.errors.describe_box()}"
    )
    figure, axes = view.new_figure(3, size=(14.0, 4.6), title=textwrap.fill(title, 130))
    own, (first, second) = own_values(controller), grid.names
    labels, here = (PARAMETERS[first], PARAMETERS[second]), (own[first], own[second])
    low, high = np.moveaxis(grid.intervals, -1, 0)
    shares = {"at least": low, "of the runs": grid.share, "at most": high}
    for ax, (title, share) in zip(axes, shares.items(), strict=True):
        view.plot_shares(grid.x, grid.y, share, labels=labels, own=here, ax=ax, title=title)
    return figure


def refutation(result: StabilityResult) -> Scenario | None:
    """Return a scenario with the robot and the target of which a report says that errors grow.

    None where they do not, beyond joint limits, or of errors of cameras and of joints that are
    believed elsewhere, which a scenario has no keys for.
    """
    scenario, growth, errors = result.scenario, result.report.growth, uncertainty_of(result.study)
    believed, controller = scenario.believed, scenario.controller
    if not growth.grows or errors is None or errors.camera or believed.shifts or believed.rotations:
        return None
    if (errors.arm.beyond_limits(growth.q) > _AWAY).any():
        return None
    (length, mass), shifts, rotations = errors.differences(growth.values)
    true, q = scenario.true, errors.arm.angles(growth.q)
    object_ = replace(true.object, length=length, mass=mass)
    held = replace(believed.object.like(true.object), length=errors.believed_length)
    held = replace(held, mass=errors.believed_mass)
    true = replace(true, object=object_, calibration=None)
    true = replace(true, shifts=_listed(shifts), rotations=_listed(rotations))
    low, high = errors.arm.position_limits
    q = np.clip(q, low, high)
    start = np.where(q + _AWAY <= high, q + _AWAY, q - _AWAY)
    return replace(
        scenario,
        true=true,
        believed=replace(believed, object=held),
        controller=replace(controller, law="setpoint"),
        run=replace(scenario.run, start=tuple(start), target=Goal(configuration=tuple(q))),
    )


def _listed(errors: Mapping[str, Array]) -> dict[str, Any]:
    return {joint: tuple(error.tolist()) for joint, error in errors.items() if error.any()}


def summary(result: StabilityResult) -> dict[str, Any]:
    """Return the contents of summary.json."""
    grid = result.map
    contents = {
        **result.report.summary(),
        "tolerance": {
            test: {
                "scale": each.scale,
                "fails_at": each.fails_at,
                "errors": each.uncertainty.describe_box(),
                "worst": each.worst_text,
            }
            for test, each in result.tolerances.items()
        },
        "gains": result.report.loop.controller.diagonals._asdict(),
        "map": grid and {name: getattr(grid, name) for name in _OF_MAP},
        "scenario": asdict(result.scenario),
    }
    return {name: plain(value) for name, value in contents.items()}


def write(result: StabilityResult, out: Path) -> None:
    """Write the pictures, summary.json and scenario.toml into a folder."""
    drawn = draw_map(result)
    with together(out) as folder:
        if drawn is not None:
            view.save_figure(drawn, folder / "map")
        result.scenario.save(folder / "scenario.toml")
        if (refuted := refutation(result)) is not None:
            refuted.save(folder / "refuted.toml")
        write_text(folder / "summary.json", json.dumps(summary(result), indent=2) + "\n")
        # no map of another run beside the other files, nor its robot
        old = ["map.png", "map.svg"] if drawn is None else []
        for name in [*old, "refuted.toml"] if refuted is None else old:
            (out / name).unlink(missing_ok=True)
