"""The stability of a scenario's loop, before anything moves."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import Robot
from approxjac.scenario.build import BuiltScenario, build_with, loaded_arm
from approxjac.scenario.records import Analysis
from approxjac.scenario.scenario import Scenario
from approxjac.simulation import Plant, Trajectory
from approxjac.stability import (
    JointBox,
    Region,
    RegularPart,
    StabilityMap,
    StabilityReport,
    SublevelSet,
    Tolerance,
    Tube,
    Uncertainty,
    stability_map,
    stability_report,
    tolerance,
)
from approxjac.stability.advice import damping_that_certifies, part_that_certifies
from approxjac.stability.closed_loop import ClosedLoop
from approxjac.stability.map import PARAMETERS
from approxjac.stability.tolerance import Test
from approxjac.tasks import Camera, CombinedTask, ImageTask, Task
from approxjac.validation import Array, as_array

_RANGES = (
    "object_length", "object_mass", "joint_shifts", "joint_rotations", "focal_length", "distance",
    "roll",
)  # fmt: skip

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class StabilityResult:
    """What was found.

    Attributes:
        scenario: What was looked at.
        loop: Its controller, what may be true, and where it was looked.
        report: The four tests.
        tolerances: How far the errors may be scaled for each test; nothing if none are given.
        raised_damping: The smallest damping tried, times the given one, with which a report on as
            many configurations certifies all errors; None if they are certified already, or not
            with any.
        certified_part: The errors, scaled down, that a report on as many configurations certifies
            as it is; None if they are certified as a whole, or no part tried is.
        map: The stability map, or None.
    """

    scenario: Scenario
    loop: ClosedLoop
    report: StabilityReport
    tolerances: dict[Test, Tolerance]
    raised_damping: float | None
    certified_part: Uncertainty | None
    map: StabilityMap | None

    @property
    def uncertainty(self) -> Uncertainty | None:
        """The set of true robots, if anything is uncertain."""
        return uncertainty_of(self.loop)


def uncertainty_of(loop: ClosedLoop) -> Uncertainty | None:
    """Return the set of true robots of a loop, if anything is uncertain."""
    return loop.truth if isinstance(loop.truth, Uncertainty) and loop.truth.d > 0 else None


def prepare(scenario: Scenario) -> ClosedLoop:
    """Return a scenario's controller with the errors that it may meet, and the region.

    Raises:
        ApproxJacError: Values that do not fit the robot, or each other.
    """
    analysis = scenario.stability
    if analysis.map_points == 1:
        raise InvalidInputError("stability.map_points must be 0 or >= 2, got 1", given=1)
    for name in analysis.map:
        if name not in PARAMETERS:
            raise UnknownNameError("parameter", name, "the map", PARAMETERS)
    arm, gravity = loaded_arm(scenario), scenario.controller.gravity
    if gravity == "exact":  # eq. (9): what is compensated exactly is not felt
        arm, gravity = arm.with_gravity((0.0, 0.0, 0.0)), "none"
    # a report is of eq. (1), and of whatever target
    plain = replace(
        scenario,
        controller=replace(scenario.controller, gravity=gravity, limits=None),
    )
    built = build_with(arm, plain)
    truth = _truth(arm, built, analysis)
    region = _region(built.law, truth, analysis)
    return ClosedLoop(built.law, truth, region, analysis.target)


def analyse(
    scenario: Scenario,
    loop: ClosedLoop,
    executor: Executor | None = None,
    progress: Progress | None = None,
    found: Callable[[StabilityReport], None] = lambda report: None,
) -> StabilityResult:
    """Make the tests, find what they tolerate, and what the map shows.

    Args:
        scenario: What to look at.
        loop: What `prepare` makes of it.
        executor: What shares the rollouts; this process by default.
        progress: Called with what is being done and the share of it that is.
        found: Called with the report of the tests, long before the rest is known.

    Raises:
        ApproxJacError: An empty region, or a target out of reach.
    """
    analysis, tell = scenario.stability, progress or (lambda what, share: None)
    where: Any = {"region": loop.region, "target": loop.target, "seed": scenario.run.seed}
    drawn: Any = {**where, "configurations": analysis.configurations}
    controller, uncertainty = loop.controller, uncertainty_of(loop)
    runs = analysis.runs if isinstance(loop.truth, Uncertainty) else 0
    report = stability_report(
        controller, loop.truth, executor=executor, progress=tell, runs=runs, **drawn
    )
    found(report)
    if uncertainty is None:
        return StabilityResult(scenario, loop, report, {}, None, None, None)

    def telling(what: str) -> Callable[[float], None]:
        return lambda share: tell(what, share)

    tolerances = tolerance(controller, uncertainty, progress=telling("tolerance"), **where)
    raised = part = map_ = None
    if report.certified_by is None:
        raised = damping_that_certifies(
            controller, uncertainty, progress=telling("more damping"), **drawn
        )
        part = part_that_certifies(
            controller, uncertainty, largest=min(1.0, tolerances["matrix"].scale),
            progress=telling("smaller errors"), **drawn,
        )  # fmt: skip
    if analysis.map_points:
        x, y = (_values(name, controller, uncertainty, analysis) for name in analysis.map)
        map_ = stability_map(
            controller, uncertainty, names=analysis.map, x=x, y=y, runs=analysis.map_runs,
            executor=executor, progress=telling("map"), **where,
        )  # fmt: skip
    return StabilityResult(scenario, loop, report, tolerances, raised, part, map_)


def _truth(arm: Robot, built: BuiltScenario, analysis: Analysis) -> Uncertainty | Plant:
    """Return what may be true: the ranges of errors, or the true robot where none are given."""
    given = {name: getattr(analysis, name) for name in _RANGES}
    friction, believed = built.scenario.true.friction, built.scenario.believed
    if not any(given.values()):
        return Plant(built.plant.robot, built.plant.sensor, friction)
    if believed.shifts or believed.rotations:
        arm = arm.with_kinematic_error(believed.shifts, believed.rotations)
    sensor, task = built.plant.sensor, built.law.task
    camera: Camera | None = None
    make: Callable[..., Task] = functools.partial(_task_of, task)
    if isinstance(sensor, ImageTask):
        image = task.task if isinstance(task, CombinedTask) else task
        assert isinstance(image, ImageTask)  # as its sensor is one
        camera = image.camera
        make = functools.partial(ImageTask, points=sensor.points, depth=sensor.depth)
    return Uncertainty(
        arm,
        make,
        believed_length=believed.object.length,
        believed_mass=believed.object.mass,
        object_axis=believed.object.axis or built.scenario.true.object.axis,
        camera=camera,
        friction=friction,
        **given,
    )


def _task_of(task: Task, robot: Robot) -> Task:
    return task.on(robot)


def _region(
    controller: SetpointController, truth: Uncertainty | Plant, analysis: Analysis
) -> Region | None:
    """Return where to look, or None for the usual region."""
    names = ("around", "run", "reach_from")
    given = [name for name in names if getattr(analysis, name) is not None]
    if len(given) > 1:
        raise InvalidInputError(f"one region must be given, got {' and '.join(given)}", given=given)
    belief, radius = controller.task.robot, analysis.radius
    region: Region
    if analysis.around is not None:
        around = _configuration(belief, "stability.around", analysis.around)
        region = JointBox.around(belief, around, radius)
    elif analysis.run is not None:
        region = Tube(belief, Trajectory.load(analysis.run).q, radius)
    elif analysis.reach_from is not None:
        if analysis.target is None:
            raise InvalidInputError(
                "stability.reach_from needs stability.target, got none", given=None
            )
        nominal = truth.plant(truth.believed) if isinstance(truth, Uncertainty) else truth
        start = _configuration(belief, "stability.reach_from", analysis.reach_from)
        region = SublevelSet(nominal, controller, analysis.target, start)
    elif analysis.sigma_min is None:
        return None
    else:
        region = JointBox(belief)
    if analysis.sigma_min is None:
        return region
    return RegularPart(region, controller.task, analysis.sigma_min)


def _configuration(robot: Robot, name: str, joints: tuple[float, ...]) -> Array:
    """Configuration from one number a joint, also beyond the joint limits."""
    motion = as_array(name, joints, (robot.nv,), "rad or m")
    point = JointBox(robot, motion, motion)
    return np.array(point.sample(1, np.random.default_rng(0))[0])


def _values(
    name: str, controller: SetpointController, uncertainty: Uncertainty, analysis: Analysis
) -> Array:
    """Values of a parameter of the map."""
    shares = np.linspace(0.0, 1.0, analysis.map_points)
    if name == "error":
        return uncertainty.largest_scale(3.0) * shares
    kp, kv, _ = controller.diagonals
    middle = float(np.mean(kp / kv)) if name == "a" else 1.0
    values: Array = middle * 10.0 ** (2.0 * shares - 1.0)
    return values
