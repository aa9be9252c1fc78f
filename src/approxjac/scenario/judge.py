"""The stability of a scenario's loop, before anything moves."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np

from approxjac.cameras import Camera
from approxjac.controllers import Limits, SetpointController, TorqueLimited
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import Robot
from approxjac.scenario.build import BuiltScenario, build_scenario, holding, loaded_arm, sensing_of
from approxjac.scenario.laws import latency_of, limits_of
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.starts import configuration_of
from approxjac.scenario.study_records import Analysis
from approxjac.simulation import Plant, Trajectory
from approxjac.stability import (
    Damping,
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
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.rollout.rollout_map import PLACES, is_drawn
from approxjac.stability.search.map import PARAMETERS, labels, own_values
from approxjac.stability.search.suggestion import damping_that_certifies, part_that_certifies
from approxjac.stability.search.tolerance import Test
from approxjac.tasks import CombinedTask, FrameKinematics, ImageTask, Task
from approxjac.tasks.analysis import features, fine_error
from approxjac.validation import Array

Progress = Callable[[str, float], None]
_MAP_RUNS = {"tests": 2, "rollouts": 100}
_DRAWN = 200  # configurations that tell how far the tip gets


@dataclass(frozen=True, eq=False)
class StabilityResult:
    """The tests of a loop, and what follows; None of what was not needed, or not found."""

    scenario: Scenario
    report: StabilityReport
    tolerances: dict[Test, Tolerance] = field(default_factory=dict)  # scales of the errors
    damping: Damping | None = None  # with which all errors are certified
    certified_part: Uncertainty | None = None  # the errors, scaled down, certified as it is
    map: StabilityMap | None = None


def uncertainty_of(loop: ClosedLoop) -> Uncertainty | None:
    """Return the set of true robots of a loop, if anything is uncertain."""
    return loop.truth if isinstance(loop.truth, Uncertainty) and loop.truth.d > 0 else None


def prepare(scenario: Scenario) -> ClosedLoop:
    """Return a scenario's controller with the errors that it may meet, and the region."""
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
    law = replace(choice, gravity=gravity, limits="none", torque_rate=None)
    built = build_scenario(replace(scenario, controller=law), arm)
    truth = _truth(arm, built, analysis)
    assert isinstance(built.law, SetpointController)
    region = _region(built.law, truth, analysis)
    loop = ClosedLoop(built.law, truth, region, analysis.target)
    uncertainty = uncertainty_of(loop) if analysis.map_by == "rollouts" else None
    known = PARAMETERS if uncertainty is None else labels(uncertainty)
    for name in analysis.map:
        if name not in known:
            raise UnknownNameError("parameter", name, "the map", known)
    if uncertainty is not None:
        is_drawn(analysis.map, uncertainty)  # refuses one of each
    return loop


def analyse(
    scenario: Scenario,
    loop: ClosedLoop,
    executor: Executor | None = None,
    progress: Progress | None = None,
    found: Callable[[StabilityReport], None] = lambda report: None,
) -> StabilityResult:
    """Return the tests of a loop that `prepare` made, the errors that they tolerate, and the map.

    The executor shares the rollouts; `progress` gets the name of a part of the work and the share
    of it that is done, `found` the report of the tests, long before the rest is known.
    """
    analysis, tell = scenario.stability, progress or (lambda what, share: None)
    controller, uncertainty = loop.controller, uncertainty_of(loop)
    where: Any = {"region": loop.region, "target": loop.target, "seed": scenario.run.seed}
    drawn: Any = {
        **where, "configurations": analysis.configurations, "latency": latency_of(scenario)
    }  # fmt: skip
    runs = analysis.runs if isinstance(loop.truth, Uncertainty) else 0
    as_it_runs = rollout_options(scenario, controller)
    more = {"executor": executor, "runs": runs, **as_it_runs} if runs else {}
    report = tested(scenario, loop, progress=tell, **more)
    found(report)
    if uncertainty is None:
        return StabilityResult(scenario, report)

    tolerances: dict[Test, Tolerance] = {}
    if report.gravity_is_exact:  # as is assumed by all tests but rollouts
        tell_it = partial(tell, "tolerance")
        tolerances = tolerance(controller, uncertainty, progress=tell_it, **where)
    damping = part = map_ = None
    # whatever damping and errors are, nothing certifies where Ĵ loses rank or gravity is wrong
    if not report.passed and report.gravity_is_exact and report.singular_q is None:
        damping = damping_that_certifies(
            controller, uncertainty, progress=partial(tell, "other damping"), **drawn
        )
        part = part_that_certifies(
            controller, uncertainty, largest=min(1.0, tolerances["matrix"].scale),
            progress=partial(tell, "smaller errors"), **drawn,
        )  # fmt: skip
    if analysis.map_points and (report.gravity_is_exact or analysis.map_by == "rollouts"):
        given = analysis.map_runs
        runs = _MAP_RUNS[analysis.map_by] if given is None else given
        x, y = (_values(name, loop, uncertainty, analysis.map_points) for name in analysis.map)
        map_ = stability_map(
            controller, uncertainty, names=analysis.map, x=x, y=y, by=analysis.map_by,
            runs=runs, executor=executor, progress=partial(tell, "map"), **where, **as_it_runs,
        )  # fmt: skip
        if analysis.map_by == "tests":
            map_ = _as_reported(map_, report)
    return StabilityResult(scenario, report, tolerances, damping, part, map_)


def tested(scenario: Scenario, loop: ClosedLoop, **options: Any) -> StabilityReport:
    """Return the tests of a loop that `prepare` made; options are those of `stability_report`."""
    controller, analysis = loop.controller, scenario.stability
    limits = limits_of(scenario, controller.task.robot)
    limited: SetpointController | TorqueLimited = controller
    if limits is not None:  # a report looks at efforts alone
        limited = TorqueLimited(controller, Limits(effort=limits.effort))
    return stability_report(
        limited, loop.truth, loop.region, target=loop.target, latency=latency_of(scenario),
        configurations=analysis.configurations, seed=scenario.run.seed, **options,
    )  # fmt: skip


def rollout_options(scenario: Scenario, controller: Controller) -> dict[str, Any]:
    """Return options of `rollouts` that make them as a run of a scenario is."""
    run, dt = scenario.run, latency_of(scenario).period
    return {
        "dt": dt,
        "duration": max(1, round(run.duration / dt)) * dt,
        "tolerance": run.tolerance or fine_error(controller.task.units, scenario.sensor.noise),
        "sensing": sensing_of(scenario.sensor),
        "actuator_delay": scenario.loop.actuator_delay,
    }


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
    return (
        region if region is None or least is None else RegularPart(region, controller.task, least)
    )


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


def _as_reported(found: StabilityMap, report: StabilityReport) -> StabilityMap:
    """Return a map that says of the report's own point what the report does, which looked closer.

    It draws fewer configurations, and looks for the worst of them less closely.
    """
    own = own_values(report.loop.controller)
    decay_rate, theorem1, matrix = (
        each.copy() for each in (found.decay_rate, found.theorem1, found.matrix)
    )
    first, second = (own[name] for name in found.names)
    here = np.ix_(found.y == second, found.x == first)
    decay_rate[here] = np.minimum(decay_rate[here], report.local.decay_rates.min())
    theorem1[here] = max(-1.0, report.theorem1.margin)
    best = max(report.matrix.values(), key=lambda test: (test.certified, test.margin))
    margin = best.margin if best.certified else min(best.margin, 0.0)
    matrix[np.ix_(found.coarse_y == second, found.coarse_x == first)] = max(-1.0, margin)
    return replace(found, decay_rate=decay_rate, theorem1=theorem1, matrix=matrix)
