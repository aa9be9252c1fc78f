"""A scenario made into what runs: plant, controller, target and start."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.controllers import (
    AdaptiveGravity,
    DifferentiatedVelocity,
    Gains,
    Gravity,
    HeldMeasurement,
    Limits,
    ModelGravity,
    NoGravity,
    Posture,
    RegressorGravity,
    SetpointController,
    TorqueLimited,
    default_gains,
)
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import Controller, TargetPath
from approxjac.law import Linear, Sine
from approxjac.paths import Circle, Line
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.scenario.configurations import configuration_of, regular_configuration
from approxjac.scenario.images import image_scene
from approxjac.scenario.records import Belief, Sensor, Truth
from approxjac.scenario.refusals import require_effect
from approxjac.scenario.scenario import Scenario
from approxjac.simulation import MujocoPlant, Plant, SampledLoop, Sensing
from approxjac.tasks import (
    CombinedTask,
    ImageTask,
    PlanarCamera,
    PoseTask,
    PositionTask,
    StackedTask,
    Task,
)
from approxjac.tasks.analysis import with_error
from approxjac.validation import Array, as_array

if TYPE_CHECKING:
    from approxjac.scenario.result import Result

_PLANAR_FOCAL_LENGTH = 0.05  # [m]
_RADIUS = 0.01  # of an object [m]


@dataclass(frozen=True, eq=False)
class BuiltScenario:
    """What runs: the truth, the controller with its belief, start and target.

    Attributes:
        scenario: What it was built from.
        plant: The truth; its torque limits are those of the motors.
        controller: What runs: the law, within its limits and with a held measurement where the
            scenario has them.
        law: The law itself.
        q0: Start, shape (nq,).
        target: x_d, shape (n_x,), or its path.
        limits: What the controller keeps, with an entry for each joint; None if it knows none.
        believe: Makes the believed robot from the length that is believed of the object [m].
    """

    scenario: Scenario
    plant: Plant
    controller: Controller
    law: SetpointController
    q0: Array
    target: Array | TargetPath
    limits: Limits | None
    believe: Callable[[float], Robot]

    @property
    def motor_limits(self) -> Array:
        """What the true motors deliver, shape (n_v,) [N m or N]."""
        limits = self.plant.torque_limits
        return self.plant.robot.effort_limits if limits is None else limits

    def run(
        self,
        progress: Callable[[float], None] | None = None,
        observer: Callable[[SampledLoop], None] | None = None,
    ) -> Result:
        """Simulate for the scenario's duration and judge it.

        Args:
            progress: As for `simulate`.
            observer: As for `simulate`.

        Raises:
            SimulationError: The closed loop diverged.
        """
        from approxjac.scenario.runs import result_of

        return result_of(self, progress, observer)


def build(scenario: Scenario) -> BuiltScenario:
    """Build the truth, the belief and what stands between them, as `Scenario.build` does."""
    return build_with(loaded_arm(scenario), scenario)


def loaded_arm(scenario: Scenario) -> Robot:
    """Return the arm of a scenario without an object."""
    return load_robot(scenario.robot, tip=scenario.tip, base=scenario.base, free=scenario.free)


def build_with(arm: Robot, scenario: Scenario) -> BuiltScenario:
    """Build a scenario whose arm, without an object, is loaded already."""
    require_effect(scenario)
    truth = true_robot(arm, scenario)
    believe = functools.partial(believed_robot, arm, scenario)
    belief = believe(scenario.believed.object.length)
    limits = _limits(scenario, belief)
    motors = truth.effort_limits if limits is None else np.asarray(limits.effort)
    rng = np.random.default_rng(scenario.run.seed)
    task: Task
    sensor: Task
    if scenario.task.kind == "image" and scenario.true.camera.kind == "pinhole":
        (sensor, task), q0, q_goal = image_scene(truth, belief, arm.tip_or(None), scenario, rng)
        target: Array | TargetPath = _value(sensor, q0, scenario, lambda: q_goal)
        if scenario.task.points > 1 and scenario.controller.differentiator is None:
            task = CombinedTask.balanced(task, target)
        plant = _plant(truth, sensor, motors, scenario)
    else:
        task = _task(belief, scenario)
        sensor = _sensor(task, truth, scenario)
        plant = _plant(truth, sensor, motors, scenario)
        draw = functools.partial(regular_configuration, sensor, task, rng, motors)
        q0 = _start(plant, scenario, draw)
        target = _target(sensor, q0, scenario, draw)
    law = _law(task, gravity_from(truth, belief, scenario.controller.gravity), q0, scenario)
    controller: Controller = law
    if limits is not None:
        controller = TorqueLimited(law, limits, dt=sampling_time(scenario))
    if scenario.controller.unseen is not None:
        controller = HeldMeasurement(controller, scenario.controller.unseen)
    return BuiltScenario(scenario, plant, controller, law, q0, target, limits, believe)


# -- robots -----------------------------------------------------------------------------


def true_robot(arm: Robot, scenario: Scenario) -> Robot:
    """Return the arm as it is, holding what it holds."""
    true = scenario.true
    return _holding(arm, true.object.length, true.object.mass, true, scenario)


def believed_robot(arm: Robot, scenario: Scenario, length: float) -> Robot:
    """Return the arm as it is believed, with an object that is believed to have a length [m]."""
    believed = scenario.believed
    return _holding(arm, length, believed.object.mass, believed, scenario)


def _holding(
    arm: Robot, length: float, mass: float, part: Truth | Belief, scenario: Scenario
) -> Robot:
    """Return an arm that holds an object, as a part of a scenario has it."""
    mine, true = part.object, scenario.true.object
    axis = true.axis if mine.axis is None else mine.axis
    radius = true.radius if mine.radius is None else mine.radius
    robot = arm.with_object(length, mass, _RADIUS if radius is None else radius, axis=axis)
    if part.shifts or part.rotations:
        robot = robot.with_kinematic_error(part.shifts, part.rotations)
    return robot


# -- tasks ------------------------------------------------------------------------------


def _task(robot: Robot, scenario: Scenario) -> Task:
    """Return the believed task, where no pinhole camera is in it."""
    kind, axes = scenario.task.kind, scenario.task.axes
    if kind == "position":
        return PositionTask(robot, axes=axes)
    if kind == "stacked":
        frames = scenario.task.frames
        return StackedTask(*(PositionTask(robot, frame, axes) for frame in frames))
    if kind == "pose":
        return PoseTask(robot)
    wrong, true = scenario.believed.camera, _planar_camera(scenario)
    believed = PlanarCamera(
        true.focal_length * wrong.focal_factor,
        true.distance * wrong.depth_factor,
        true.roll + wrong.roll,
    )
    return ImageTask(robot, believed)


def _sensor(task: Task, truth: Robot, scenario: Scenario) -> Task:
    """Return what the true robot measures for a believed task."""
    if isinstance(task, ImageTask):
        return ImageTask(truth, _planar_camera(scenario))
    return task.on(truth)


def _planar_camera(scenario: Scenario) -> PlanarCamera:
    camera = scenario.true.camera
    focal_length = camera.focal_length or _PLANAR_FOCAL_LENGTH
    return PlanarCamera(focal_length, camera.distance, camera.roll)


# -- start and target -------------------------------------------------------------------


def _start(plant: Plant, scenario: Scenario, draw: Callable[[], Array]) -> Array:
    start = scenario.run.start
    if start is None:
        return plant.ready_configuration()
    return draw() if start == "random" else configuration_of(plant.robot, "run.start", start)


def _target(
    sensor: Task, q0: Array, scenario: Scenario, draw: Callable[[], Array]
) -> Array | TargetPath:
    goal, name = scenario.run.target, "run.target.line.offset"
    if goal.line.offset is not None:
        start = sensor.value(q0)
        way = as_array(name, goal.line.offset, (sensor.m,), joined(sensor.units))
        return Line(start, start + way, goal.line.duration)
    if goal.circle.radius is not None:
        radius, period, center = goal.circle.radius, goal.circle.period, goal.circle.center
        if center is None:
            start = sensor.value(q0)
            center = tuple((2.0 * start - Circle(start, radius, period).at(0.0).x).tolist())
        return Circle(center, radius, period)
    return _value(sensor, q0, scenario, draw)


def _value(sensor: Task, q0: Array, scenario: Scenario, draw: Callable[[], Array]) -> Array:
    goal = scenario.run.target
    if goal.offset is not None:
        offset = as_array("run.target.offset", goal.offset, (sensor.m,), joined(sensor.units))
        return sensor.displaced(sensor.value(q0), offset)
    if goal.configuration is not None:
        name = "run.target.configuration"
        return sensor.value(configuration_of(sensor.robot, name, goal.configuration))
    if goal.at is None:
        return sensor.value(draw())
    if (
        isinstance(sensor, ImageTask) and "px" in sensor.units
    ):  # the depths of an image are not what one goes to
        images = as_array("run.target", goal.at, (sensor.m,), "px")
        drawn = with_error(sensor, sensor.value(draw()), sensor._origin, images)
        return sensor.target(drawn)
    return sensor.target(goal.at)


# -- who controls -----------------------------------------------------------------------


def gravity_from(truth: Robot, belief: Robot, kind: str) -> Gravity:
    """Return where a controller has its gravity from: "learnt", "exact", "believed" or "none"."""
    if kind == "none":
        return NoGravity(belief)
    if kind == "believed":
        return ModelGravity(belief)
    if kind == "learnt":
        return AdaptiveGravity(belief)
    regressor = GravityRegressor(belief)
    return RegressorGravity(regressor, regressor.fit(truth)[0])


def _law(task: Task, gravity: Gravity, q0: Array, scenario: Scenario) -> SetpointController:
    chosen = scenario.controller
    saturation = Linear() if chosen.gamma is None else Sine(chosen.gamma)
    velocity = None
    if chosen.differentiator is not None:
        velocity = DifferentiatedVelocity(chosen.differentiator)
    stiffness = chosen.posture_stiffness
    return SetpointController(
        task,
        _gains(task, scenario),
        gravity=gravity,
        saturation=saturation,
        velocity=velocity,
        posture=Posture(q0, stiffness) if stiffness else None,
    )


def _gains(task: Task, scenario: Scenario) -> Gains:
    """Default gains that the loop's lags allow, but for those that are given."""
    chosen, sensor = scenario.controller, scenario.sensor
    lag = sampling_time(scenario) + (sensor.velocity_filter or 0.0) + scenario.loop.actuator_delay
    if chosen.differentiator is not None:  # damping of law (5) acts as late as x tells Ẋ
        lag += chosen.differentiator + sensor.delay
        lag += 0.0 if sensor.rate is None else 0.5 / sensor.rate
    bandwidth = {} if lag == 0.0 else {"bandwidth": 1.0 / lag}
    gains = default_gains(task, chosen.settling_time, **bandwidth)
    given = {"kp": chosen.kp, "kv": chosen.kv, "damping": chosen.damping}
    values = {
        name: getattr(gains, name) if value is None else value[0] if len(value) == 1 else value
        for name, value in given.items()
    }
    return Gains(**values)


def sampling_time(scenario: Scenario) -> float:
    """Return the period of control [s], 0 where it is continuous."""
    return scenario.loop.dt if isinstance(scenario.loop.dt, float) else 0.0


def _limits(scenario: Scenario, belief: Robot) -> Limits | None:
    """Return the limits that the controller keeps, with an entry for each joint."""
    share = scenario.controller.limits
    if share is None:
        return None
    if not np.isfinite(belief.effort_limits).any():
        raise InvalidInputError(
            f"controller.limits are shares of the URDF's effort limits, and that of {belief.name} "
            f"has none, got {share}",
            given=share,
        )
    limits = Limits.of(belief, share if isinstance(share, float) else 1.0)
    rate = scenario.controller.torque_rate
    return Limits(limits.effort, rate, limits.position, limits.velocity).for_joints(belief.nv)


# -- the plant --------------------------------------------------------------------------


def _plant(truth: Robot, sensor: Task, motors: Array, scenario: Scenario) -> Plant:
    true, delay = scenario.true, scenario.loop.actuator_delay
    options: dict[str, Any] = {
        "coulomb": true.coulomb,
        "sensing": _sensing(scenario),
        "actuator_delay": delay,
        "torque_limits": motors if np.isfinite(motors).any() else None,
    }
    if true.engine == "mujoco":
        return MujocoPlant(truth, sensor, true.friction, floor=true.floor, **options)
    return Plant(truth, sensor, true.friction, **options)


def _sensing(scenario: Scenario) -> Sensing | None:
    """Return how measurements differ from the truth; None if they do not."""
    given = scenario.sensor
    part = () if given.lost_part is None else (given.lost_part - 1,)
    lost: Any = () if given.lost is None else ((*given.lost, *part),)
    sensing = Sensing(
        x_noise=given.noise,
        x_quantum=given.quantum,
        x_delay=given.delay,
        x_dropout=given.dropout,
        x_rate=given.rate,
        x_lost=lost,
        x_frozen=() if given.frozen is None else (given.frozen,),
        q_noise=given.q_noise,
        q_quantum=given.q_quantum,
        velocity_filter=given.velocity_filter,
    )
    return None if given == Sensor() else sensing
