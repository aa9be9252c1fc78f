"""A scenario made into what runs: plant, controller, target and start."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.controllers import Limits
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import TargetPath
from approxjac.paths import Circle, Line, Waypoints
from approxjac.robots import Robot, load_robot
from approxjac.robots.urdf_edit import OBJECT_RADIUS
from approxjac.scenario.image_setup import image_scene
from approxjac.scenario.laws import controller_of, limits_of
from approxjac.scenario.records import Goal, Numbers, Object, Sensor, Tracker, Vectors
from approxjac.scenario.refusals import require_effect
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.starts import (
    configuration_of,
    doubts,
    numbers,
    regular_configuration,
    straight_ahead,
)
from approxjac.simulation import (
    Friction,
    MujocoPlant,
    Plant,
    Sensing,
    VelocityServo,
)
from approxjac.tasks import (
    CombinedTask,
    ImageTask,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.tasks.analysis import with_error
from approxjac.validation import Array

_PLANAR_FOCAL_LENGTH = 0.05  # [m]


@dataclass(frozen=True, eq=False)
class BuiltScenario:
    """The truth, the controller with its belief, start and target, ready to run."""

    scenario: Scenario  # that it was built from
    plant: Plant  # the truth; its torque limits are those of the motors
    controller: Controller  # the law, within limits and with a held measurement where they are
    law: Controller
    q0: Array  # start, shape (nq,)
    target: Array | TargetPath  # x_d, shape (n_x,), or its path
    limits: Limits | None  # that the controller keeps, an entry for each joint
    believe: Callable[[float], Robot]  # from the believed length of the object [m]

    @functools.cached_property
    def warning(self) -> str:
        """Reason why the gains, the believed or the true arm may miss the target; or ""."""
        tuning = self.law.tuning
        if tuning is not None and not tuning.stable:
            return tuning.reasons[0]
        if self.scenario.true.tracker != Tracker():
            return ""  # in whose axes nobody knows where the arm is
        run, goal = self.scenario.run, self.scenario.run.target
        doubt = doubts(self.law.task, self.target, self.q0, run.duration)
        if not doubt and goal != Goal() and goal.configuration is None:  # or it was there itself
            doubt = doubts(self.plant.sensor, self.target, self.q0, run.duration, "true")
        return doubt

    @property
    def gains(self) -> dict[str, Any]:
        """The gains of the law by their names."""
        return self.law.gain_values

    @property
    def learning(self) -> Controller | None:
        """Return the controller that learns kinematics; None if they are not learnt."""
        return self.controller if self.scenario.controller.unknown else None


def loaded_arm(scenario: Scenario) -> Robot:
    """Return the arm of a scenario without an object."""
    return load_robot(scenario.robot, tip=scenario.tip, base=scenario.base, free=scenario.free)


def build_scenario(scenario: Scenario, arm: Robot | None = None) -> BuiltScenario:
    """Return the plant, the controller, the target and the start that a scenario describes.

    Args:
        scenario: The scenario.
        arm: Its arm without an object, where that is loaded already.

    Raises:
        ApproxJacError: Values that do not fit the robot, or each other.
    """
    arm = loaded_arm(scenario) if arm is None else arm
    require_effect(scenario)
    true, believed = scenario.true, scenario.believed
    truth = holding(arm, true.object, true.shifts, true.rotations)

    def believe(length: float) -> Robot:
        held = replace(believed.object.like(true.object), length=length)
        return holding(arm, held, believed.shifts, believed.rotations)

    belief = believe(believed.object.length)
    limits = limits_of(scenario, belief)
    motors = truth.effort_limits if limits is None else np.asarray(limits.effort)
    rng = np.random.default_rng(scenario.run.seed)
    task: Task
    sensor: Task
    if scenario.task.kind == "image" and scenario.true.camera.kind == "pinhole":
        (sensor, task), q0, q_goal = image_scene(truth, belief, arm.tip_or(None), scenario, rng)
        target = _target(sensor, q0, scenario, lambda: q_goal)
        alike = scenario.controller.differentiator is None and not scenario.controller.unknown
        if scenario.task.points > 1 and alike:
            x_d = target if isinstance(target, np.ndarray) else target.at(0.0).x
            task = CombinedTask.balanced(task, x_d)
        plant = _plant(truth, sensor, motors, scenario, belief)
    else:
        sensor, task = _tasks(truth, belief, scenario)
        plant = _plant(truth, sensor, motors, scenario, belief)
        draw = functools.partial(regular_configuration, sensor, task, rng, motors)
        if isinstance(start := scenario.run.start, tuple):
            q0 = configuration_of(truth, "run.start", start)
        else:
            q0 = plant.ready_configuration() if start is None else draw()
        goal = draw if start == "random" else functools.partial(straight_ahead, sensor, q0, draw)
        target = _target(sensor, q0, scenario, goal)
    law, controller = controller_of(scenario, task, truth, q0, limits)
    return BuiltScenario(scenario, plant, controller, law, q0, target, limits, believe)


def holding(arm: Robot, held: Object, shifts: Vectors, rotations: Vectors) -> Robot:
    """Return an arm that holds an object, with errors of its joint origins and axes."""
    radius = OBJECT_RADIUS if held.radius is None else held.radius
    robot = arm.with_object(held.length, held.mass, radius, axis=held.axis)
    return robot.with_kinematic_error(shifts, rotations) if shifts or rotations else robot


# -- tasks ------------------------------------------------------------------------------


def _tasks(truth: Robot, belief: Robot, scenario: Scenario) -> tuple[Task, Task]:
    """Return the sensor of the true robot and the believed task, without a pinhole camera."""
    chosen, given, wrong = scenario.task, scenario.true.camera, scenario.believed.camera
    if chosen.kind == "image":
        f, z, roll = given.focal_length or _PLANAR_FOCAL_LENGTH, given.distance, given.roll
        believed = PlanarCamera(f * wrong.focal_factor, z * wrong.depth_factor, roll + wrong.roll)
        return ImageTask(truth, PlanarCamera(f, z, roll)), ImageTask(belief, believed)
    task: Task
    if chosen.kind == "pose":
        task = PoseTask(belief)
    elif chosen.kind == "stacked":
        task = StackedTask(*(PositionTask(belief, each, chosen.axes) for each in chosen.frames))
    else:
        task = PositionTask(belief, axes=chosen.axes)
    tracker = scenario.true.tracker
    if tracker != Tracker():
        kind: type[PoseTrackerTask] | type[TrackerTask]
        kind = PoseTrackerTask if chosen.kind == "pose" else TrackerTask
        return kind(truth, tracker.rotation, tracker.offset), task
    return task.on(truth), task


# -- target -----------------------------------------------------------------------------


def _target(
    sensor: Task, q0: Array, scenario: Scenario, draw: Callable[[], Array]
) -> Array | TargetPath:
    goal, start = scenario.run.target, sensor.value(q0)
    line, circle, waypoints = goal.line, goal.circle, goal.waypoints
    ways = {"line": line.offset, "circle": circle.radius, "waypoints": waypoints.points}
    way = [name for name, value in ways.items() if value is not None]
    if way and len(start) != sensor.m:
        raise InvalidInputError(
            f"run.target.{way[0]} is a path of a task whose error is x - x_d, got {sensor!r}",
            given=goal,
        )

    def coordinates(name: str, values: Numbers, count: int = sensor.m) -> Array:
        return numbers(f"run.target.{name}", values, count, joined(sensor.units))

    if line.offset is not None:
        return Line(start, start + coordinates("line.offset", line.offset), line.duration)
    if circle.radius is not None:
        center: Any = circle.center
        if center is None:
            center = 2.0 * start - Circle(start, circle.radius, circle.period).at(0.0).x
        return Circle(center, circle.radius, circle.period)
    if waypoints.points is not None:
        count = -(-len(waypoints.points) // sensor.m) * sensor.m
        points = coordinates("waypoints.points", waypoints.points, count).reshape(-1, sensor.m)
        return Waypoints(np.vstack([start, points]), waypoints.speed, waypoints.acceleration)
    if goal.offset is not None:
        return sensor.displaced(start, coordinates("offset", goal.offset))
    if goal.configuration is not None:
        name = "run.target.configuration"
        return sensor.value(configuration_of(sensor.robot, name, goal.configuration))
    if goal.at is None:
        return sensor.value(draw())
    if isinstance(sensor, ImageTask) and "px" in sensor.units:  # a target has no depths
        images = numbers("run.target.at", goal.at, sensor.m, "px")
        return sensor.target(with_error(sensor, sensor.value(draw()), sensor._origin, images))
    return sensor.target(goal.at)


# -- the plant --------------------------------------------------------------------------


def _plant(truth: Robot, sensor: Task, motors: Array, scenario: Scenario, belief: Robot) -> Plant:
    true = scenario.true
    friction = Friction(true.friction, true.coulomb)
    options: dict[str, Any] = {
        "sensing": sensing_of(scenario.sensor),
        "actuator_delay": scenario.loop.actuator_delay,
        "torque_limits": motors if np.isfinite(motors).any() else None,
    }
    if scenario.controller.command == "velocity":
        options["servo"] = VelocityServo(**vars(true.servo))
        options["torque_limits"], options["actuator_delay"] = None, 0.0
    if scenario.controller.gravity == "learn_residual":
        options["adds_gravity"] = belief
    if true.engine == "mujoco":
        options |= {"floor": true.floor, "balance_inertia": true.inertias == "balanced"}
        return MujocoPlant(truth, sensor, friction, **options)
    return Plant(truth, sensor, friction, **options)


def sensing_of(given: Sensor) -> Sensing | None:
    """Return the errors of measurements; None if there are none."""
    if given == Sensor():
        return None
    of_x = {f"x_{name}": getattr(given, name) for name in ("noise", "quantum", "delay", "dropout")}
    of_q = {name: getattr(given, name) for name in ("q_noise", "q_quantum", "velocity_filter")}
    part = () if given.lost_part is None else (given.lost_part - 1,)
    lost: Any = () if given.lost is None else ((*given.lost, *part),)
    frozen = () if given.frozen is None else (given.frozen,)
    return Sensing(**of_x, **of_q, x_rate=given.rate, x_lost=lost, x_frozen=frozen)
