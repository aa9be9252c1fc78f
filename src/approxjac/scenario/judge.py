"""The stability of a scenario's loop, before anything moves."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import cast

import numpy as np

from approxjac.cameras import Camera
from approxjac.controllers import Limits, SetpointController, TorqueLimited
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.scenario.build import BuiltScenario, build_scenario, holding, loaded_arm, sensing_of
from approxjac.scenario.laws import latency_of, limits_of
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.starts import configuration_of
from approxjac.scenario.study_records import Analysis
from approxjac.simulation import Plant, Trajectory
from approxjac.stability import (
    Execution,
    JointBox,
    Region,
    RegularPart,
    StabilityMap,
    StabilityReport,
    Study,
    SublevelSet,
    Tolerance,
    Tube,
    Uncertainty,
)
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.search.map import PLACES, are_drawn, own_values
from approxjac.stability.search.tolerance import Test
from approxjac.tasks import CombinedTask, FrameKinematics, ImageTask, Task
from approxjac.tasks.analysis import features, fine_error
from approxjac.validation import Array

Progress = Callable[[str, float], None]
_DRAWN = 200  # configurations that tell how far the tip gets


@dataclass(frozen=True, eq=False)
class StabilityResult:
    """The tests of a loop, and what follows; None of what was not needed."""

    scenario: Scenario
    study: Study
    report: StabilityReport
    tolerances: dict[Test, Tolerance] = field(default_factory=dict)  # scales of the errors
    map: StabilityMap | None = None


def uncertainty_of(study: Study) -> Uncertainty | None:
    """Return the set of true robots of a study, if anything is uncertain."""
    truth = study.uncertainty
    return truth if isinstance(truth, Uncertainty) and truth.d > 0 else None


def prepare(scenario: Scenario) -> Study:
    """Return the study of a scenario's controller, with the errors that it may meet."""
    analysis = scenario.stability
    if analysis.map_points == 1:
        raise InvalidInputError("stability.map_points must be 0 or >= 2, got 1", given=1)
    choice = scenario.controller
    if choice.law == "tracking" or choice.unknown:
        name, given = ("unknown", choice.unknown) if choice.unknown else ("law", choice.law)
        told = given if isinstance(given, str) else " ".join(given)
        raise InvalidInputError(
            f"controller.{name} must be left out of a report, which is about a fixed Jacobian, got "
            f"{told}",
            given=given,
        )
    for name in ("focal_length", "distance", "roll"):
        given = getattr(analysis, name)
        if given is not None and scenario.task.kind != "image":
            raise InvalidInputError(
                f"stability.{name} needs task.kind image, got {scenario.task.kind}", given=given
            )
    if choice.gravity == "learn_residual":
        raise InvalidInputError(
            "controller.gravity must be learnt, exact, believed or none in a report, which is of "
            "robots that add none, got learn_residual",
            given="learn_residual",
        )
    arm, gravity = loaded_arm(scenario), choice.gravity
    if gravity == "exact":  # eq. (9): what is compensated exactly is not felt
        arm, gravity = arm.with_gravity((0.0, 0.0, 0.0)), "none"
    # a report is of whatever target; limits come around the law that is built
    choice = replace(choice, gravity=gravity, limits="none", torque_rate=None)
    built = build_scenario(replace(scenario, controller=choice), arm)
    truth = _truth(arm, built, analysis)
    law = cast(SetpointController, built.law)  # tracking is refused above
    limits = limits_of(scenario, law.task.robot)
    run, timing = scenario.run, latency_of(scenario)
    study = Study(
        # a report looks at efforts alone
        law if limits is None else TorqueLimited(law, Limits(effort=limits.effort)),
        truth,
        _region(law, truth, analysis),
        target=analysis.target,
        latency=timing,
        sensing=sensing_of(scenario.sensor),
        duration=max(1, round(run.duration / timing.period)) * timing.period,
        accuracy=run.tolerance or fine_error(law.task.units, scenario.sensor.noise),
        seed=run.seed,
    )
    study = replace(study, region=study.loop().region)  # refuses what does not fit
    uncertainty = uncertainty_of(study)
    if uncertainty is not None:
        are_drawn(analysis.map, uncertainty)  # refuses some of each
    return study


def analyse(
    scenario: Scenario,
    study: Study,
    executor: Executor | None = None,
    progress: Progress | None = None,
    found: Callable[[StabilityReport], None] = lambda report: None,
) -> StabilityResult:
    """Return the tests of a study that `prepare` made, the errors that they tolerate, and the map.

    The executor shares the rollouts; `progress` gets the name of a part of the work and the share
    of it that is done, `found` the report of the tests, long before the rest is known.
    """
    analysis, uncertainty = scenario.stability, uncertainty_of(study)
    execution = Execution(executor=executor)
    runs = analysis.runs if isinstance(study.uncertainty, Uncertainty) else 0
    report = study.report(
        analysis.configurations, runs=runs, execution=execution, progress=progress
    )
    assert isinstance(report, StabilityReport)  # the laws of scenarios have certificates
    found(report)
    if uncertainty is None:
        return StabilityResult(scenario, study, report)

    tolerances: dict[Test, Tolerance] = {}
    if report.gravity_is_exact:  # as is assumed by all tests but rollouts
        tolerances = study.tolerance(progress=progress)
    map_ = None
    if analysis.map_points:
        points = {
            name: _values(name, report.loop, uncertainty, analysis.map_points)
            for name in analysis.map
        }
        unlimited = replace(study, controller=report.loop.controller)
        map_ = unlimited.map(points, analysis.map_runs, execution=execution, progress=progress)
    return StabilityResult(scenario, study, report, tolerances, map_)


def _truth(arm: Robot, built: BuiltScenario, analysis: Analysis) -> Uncertainty | Plant:
    """Return what may be true: the ranges of errors, or the true robot where none are given."""
    ranges = [each.name for each in fields(Uncertainty) if hasattr(analysis, each.name)]
    given = {name: getattr(analysis, name) for name in ranges}
    friction, believed = built.scenario.true.friction, built.scenario.believed
    sensor, task = built.plant.sensor, built.law.task
    C = task.C if isinstance(task, CombinedTask) else None  # errors are compared, so alike
    if not any(given.values()):
        sensor = sensor if C is None else CombinedTask(sensor, C)
        return Plant(built.plant.robot, sensor, friction)
    if believed.shifts or believed.rotations:
        arm = arm.with_kinematic_error(believed.shifts, believed.rotations)
    held = believed.object
    if not (analysis.object_length or analysis.object_mass or held.length or held.mass):
        arm = holding(arm, held.like(built.scenario.true.object), {}, {})  # whose tip the law has
    make: Callable[..., Task] = task.on
    if isinstance(sensor, ImageTask):
        make = partial(_image_task, sensor, C)
    return Uncertainty(
        arm,
        make,
        believed_length=believed.object.length,
        believed_mass=believed.object.mass,
        object_axis=believed.object.like(built.scenario.true.object).axis,
        camera=features(task)[0].camera,
        friction=friction,
        **given,
    )


def _image_task(like: ImageTask, C: Array | None, robot: Robot, camera: Camera) -> Task:
    task = ImageTask(robot, camera, points=like.points, depth=like.depth)
    return task if C is None else CombinedTask(task, C)


def _region(
    controller: SetpointController, truth: Uncertainty | Plant, analysis: Analysis
) -> Region | None:
    """Return where to look, or None for the usual region."""
    names = ("around", "run", "reach_from")
    given = [name for name in names if getattr(analysis, name) is not None]
    if len(given) > 1:
        raise InvalidInputError(f"one region must be given, got {' and '.join(given)}", given=given)
    belief, least = controller.task.robot, analysis.sigma_min
    region: Region | None = None if least is None else JointBox(belief)

    def at(name: str) -> Array:
        joints = getattr(analysis, name)
        return configuration_of(belief, f"stability.{name}", joints, within_limits=False)

    if analysis.around is not None:
        region = JointBox.around(belief, at("around"), analysis.radius)
    elif analysis.run is not None:
        region = Tube(belief, Trajectory.load(analysis.run).q, analysis.radius)
    elif analysis.reach_from is not None:
        if analysis.target is None:
            raise InvalidInputError(
                "stability.reach_from needs stability.target, got none", given=None
            )
        nominal = truth.plant(truth.believed) if isinstance(truth, Uncertainty) else truth
        region = SublevelSet(nominal, controller, analysis.target, at("reach_from"))
    if region is None or least is None:
        return region
    return RegularPart(region, controller.task, least)


def _values(name: str, loop: ClosedLoop, uncertainty: Uncertainty, count: int) -> Array:
    """Return the values of a parameter of the map."""
    shares = np.linspace(0.0, 1.0, count)
    middles = (np.arange(count) + 0.5) / count  # what is drawn is shared out into cells
    if name in uncertainty.names:
        at = uncertainty.names.index(name)
        low, high = uncertainty.low[at], uncertainty.high[at]
        return np.asarray(low + (high - low) * middles)
    if name in PLACES:
        robot = uncertainty.belief()
        tip = FrameKinematics(robot, robot.tip_or(None))
        drawn = loop.region.sample(_DRAWN, np.random.default_rng(0))
        places = np.array([tip.position(q)[PLACES.index(name)] for q in drawn])
        return np.asarray(places.min() + np.ptp(places) * middles)
    own = own_values(loop.controller)[name]
    values = own * 10.0 ** (2.0 * shares - 1.0)
    if name == "error":
        values = uncertainty.largest_scale(3.0) * shares
    if count > 2 and values[0] < own < values[-1]:  # the report's own point is one of the map
        values[1 + np.abs(values[1:-1] - own).argmin()] = own
    return np.asarray(values)
