"""Build a scenario: plant, controller, target and start."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from approxjac import controllers, tasks
from approxjac.cameras import PlanarCamera
from approxjac.controllers import AdaptiveGravity, Controller, Gravity, Kinematics, Latency, Limits
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import TargetPath
from approxjac.law import Sine
from approxjac.paths import Circle, Line, Waypoints
from approxjac.robots import Drives, Friction, GravityRegressor, KinematicBelief, Robot, load_robot
from approxjac.robots.urdf import OBJECT_RADIUS
from approxjac.scenario import starts
from approxjac.scenario.records import Numbers, Object, Sensor, Tracker, Vectors
from approxjac.scenario.refusals import require_effect
from approxjac.scenario.scenario import Scenario
from approxjac.simulation import MujocoPlant, Plant, Sensing
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.tasks import CombinedTask, ImageTask, PositionTask, Task
from approxjac.tasks.analysis import with_error
from approxjac.validation import Array

_PLANAR_FOCAL_LENGTH = 0.05  # [m]
_INSTANTS = 200  # of a path, that are looked at before it
_LEAST_PIXELS = 0.05  # noise of an image that a scenario has without [px]
_DIFFERENCES = 1e-6  # filter of q̇ that is none [s]
_TOOL = 0.2  # sd of a tool that nothing is known of [m]
_LEAST_NOISE, _BENDS = 1e-4, 1e-3  # of x, also of gears that give way [m or rad]


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

    @cached_property
    def warning(self) -> str:
        """Reason why the gains, the believed or the true arm may miss the target; or ""."""
        tuning = self.law.tuning
        if tuning is not None and not tuning.stable:
            return tuning.reasons[0]
        if self.scenario.true.tracker != Tracker():
            return ""  # in its axes the place of the arm is unknown
        target = self.target
        if not isinstance(target, np.ndarray):
            times = np.linspace(0.0, self.scenario.run.duration, _INSTANTS)
            target = np.array([target.at(t).x for t in times])
        for whose, task in (("believed", self.law.task), ("true", self.plant.sensor)):
            if far := starts.too_far(task, np.atleast_2d(target)):
                return f"for the {whose} arm the target is {far}"
        return ""


def loaded_arm(scenario: Scenario) -> Robot:
    """Return the arm of a scenario without an object."""
    return load_robot(scenario.robot, tip=scenario.tip, base=scenario.base, free=scenario.free)


def build_scenario(
    scenario: Scenario, arm: Robot | None = None, effort_only: bool = False
) -> BuiltScenario:
    """Return the plant, the controller, the target and the start that a scenario describes.

    Args:
        scenario: The scenario.
        arm: Its arm without an object, if already loaded.
        effort_only: Leave limits of speed and position to the robot.

    Raises:
        ApproxJacError: Values that do not fit the robot, or each other.
    """
    arm = loaded_arm(scenario) if arm is None else arm
    require_effect(scenario)
    true, believed, chosen = scenario.true, scenario.believed, scenario.controller
    drawn, seed = arm, scenario.run.seed
    if true.calibration is not None:
        errors = Uncertainty(arm, covariance=KinematicBelief.load(true.calibration))
        drawn = errors.robot(errors.sample(np.random.default_rng([seed, 1])))
    truth = holding(drawn, true.object, true.shifts, true.rotations)

    def believe(length: float) -> Robot:
        held = replace(believed.object.like(true.object), length=length)
        return holding(arm, held, believed.shifts, believed.rotations)

    belief = believe(believed.object.length)
    limits = limits_of(scenario, belief)
    if effort_only and limits is not None:
        limits = Limits(effort=limits.effort).for_joints(belief.nv)
    motors = truth.effort_limits if limits is None else np.asarray(limits.effort)
    rng = np.random.default_rng(seed)
    task: Task
    sensor: Task
    if scenario.task.kind == "image" and true.camera.kind == "pinhole":
        scene, q0, q_goal = starts.image_scene(truth, belief, arm.tip_or(None), scenario, rng)
        sensor, task = scene
        target = _target(sensor, q0, scenario, lambda: q_goal)
        if scenario.task.points > 1 and chosen.differentiator is None and not chosen.unknown:
            x_d = target if isinstance(target, np.ndarray) else target.at(0.0).x
            task = CombinedTask.balanced(task, x_d)
        plant = _plant(truth, sensor, motors, scenario, belief)
    else:
        sensor, task = _tasks(truth, belief, scenario)
        plant = _plant(truth, sensor, motors, scenario, belief)
        draw = partial(starts.regular_configuration, sensor, task, rng, motors)
        if isinstance(start := scenario.run.start, tuple):
            q0 = starts.configuration_of(truth, "run.start", start)
        else:
            q0 = plant.ready_configuration() if start is None else draw()
        floor = starts.floor_below(truth) if true.floor is None else true.floor
        if start != "random":
            draw = partial(starts.straight_ahead, sensor, q0, draw, floor)
        target = _target(sensor, q0, scenario, draw)
    kinematics = _kinematics(scenario, task) if chosen.unknown else None
    law = controller = _law(scenario, task, truth, kinematics)
    if limits is not None and chosen.command == "torque":
        controller = controllers.TorqueLimited(law, limits, dt=sampling_time(scenario))
    if kinematics is not None and chosen.law != "tracking":
        controller = controllers.PredictedMeasurement(controller, kinematics)
    if chosen.unseen is not None:
        controller = controllers.HeldMeasurement(controller, chosen.unseen)
    return BuiltScenario(scenario, plant, controller, law, q0, target, limits, believe)


def holding(arm: Robot, held: Object, shifts: Vectors, rotations: Vectors) -> Robot:
    """Return an arm that holds an object, with errors of its joint origins and axes."""
    radius = OBJECT_RADIUS if held.radius is None else held.radius
    robot = arm.with_object(held.length, held.mass, radius, axis=held.axis)
    return robot.with_kinematic_error(shifts, rotations) if shifts or rotations else robot


def _tasks(truth: Robot, belief: Robot, scenario: Scenario) -> tuple[Task, Task]:
    chosen, given, wrong = scenario.task, scenario.true.camera, scenario.believed.camera
    if chosen.kind == "image":
        f, z, roll = given.focal_length or _PLANAR_FOCAL_LENGTH, given.distance, given.roll
        believed = PlanarCamera(f * wrong.focal_factor, z * wrong.depth_factor, roll + wrong.roll)
        return ImageTask(truth, PlanarCamera(f, z, roll)), ImageTask(belief, believed)
    task: Task
    if chosen.kind == "pose":
        task = tasks.PoseTask(belief)
    elif chosen.kind == "stacked":
        parts = (PositionTask(belief, each, chosen.axes) for each in chosen.frames)
        task = tasks.StackedTask(*parts)
    else:
        task = PositionTask(belief, axes=chosen.axes)
    tracker = scenario.true.tracker
    if tracker == Tracker():
        return task.on(truth), task
    kind = tasks.PoseTrackerTask if chosen.kind == "pose" else tasks.TrackerTask
    return kind(truth, tracker.rotation, tracker.offset), task


def _target(
    sensor: Task, q0: Array, scenario: Scenario, draw: Callable[[], Array]
) -> Array | TargetPath:
    goal, start = scenario.run.target, sensor.value(q0)
    line, circle, waypoints = goal.line, goal.circle, goal.waypoints
    ways = {"line": line.offset, "circle": circle.radius, "waypoints": waypoints.points}
    way = [name for name, value in ways.items() if value is not None]
    if way and len(start) != sensor.m:
        message = f"run.target.{way[0]} is a path of a task whose error is x - x_d, got {sensor!r}"
        raise InvalidInputError(message, given=goal)

    def coordinates(name: str, values: Numbers, count: int = sensor.m) -> Array:
        return starts.numbers(f"run.target.{name}", values, count, joined(sensor.units))

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
        return sensor.value(starts.configuration_of(sensor.robot, name, goal.configuration))
    if goal.at is None:
        return sensor.value(draw())
    if isinstance(sensor, ImageTask) and "px" in sensor.units:  # a target has no depths
        images = coordinates("at", goal.at)
        return sensor.target(with_error(sensor, sensor.value(draw()), sensor.origin, images))
    return sensor.target(goal.at)


def _plant(truth: Robot, sensor: Task, motors: Array, scenario: Scenario, belief: Robot) -> Plant:
    true = scenario.true
    options: dict[str, Any] = {"friction": Friction(true.friction, true.coulomb)}
    if true.drives == "usual":
        options["drives"] = Drives.usual(truth)
        if not (true.friction or true.coulomb):
            plain = {"stribeck": 1.0, "load": 0.0} if true.engine == "mujoco" else {}
            options["friction"] = replace(Friction.usual(truth), **plain)
    options["sensing"] = sensing_of(scenario.sensor)
    options["actuator_delay"] = scenario.loop.actuator_delay
    if scenario.controller.command == "velocity":
        options["servo"] = true.servo
    else:
        options["torque_limits"] = motors if np.isfinite(motors).any() else None
    if scenario.controller.gravity == "learn_residual":
        options["adds_gravity"] = belief
    if true.engine == "mujoco":
        return MujocoPlant(truth, sensor, floor=true.floor, **options)
    return Plant(truth, sensor, **options)


def sensing_of(given: Sensor) -> Sensing | None:
    """Return the sensor errors; None if there are none."""
    if given == Sensor():
        return None
    of_x = {f"x_{name}": getattr(given, name) for name in ("noise", "quantum", "delay", "dropout")}
    of_q = {name: getattr(given, name) for name in ("q_noise", "q_quantum", "velocity_filter")}
    lost = () if given.lost is None else (given.lost,)
    frozen = () if given.frozen is None else (given.frozen,)
    return Sensing(**of_x, **of_q, x_rate=given.rate, x_lost=lost, x_frozen=frozen)


def _law(scenario: Scenario, task: Task, truth: Robot, kinematics: Kinematics | None) -> Controller:
    chosen, latency = scenario.controller, latency_of(scenario)
    constant = chosen.differentiator
    drives = None if scenario.true.drives == "usual" else Drives()  # nobody knows the usual ones
    if chosen.law == "tracking":
        is_late = latency.torque_delay + latency.velocity_filter > 0.0
        known = controllers.ModelDynamics(task.robot) if chosen.gravity == "believed" else None
        return controllers.TrackingController(
            task,
            kinematics=controllers.KnownKinematics(task) if kinematics is None else kinematics,
            dynamics=known,
            dt=sampling_time(scenario),
            command=chosen.command,
            # with a lag, or joints that give way, it has to know both
            latency=latency if is_late or drives is None else None,
            drives=drives if is_late else None,
            gains=controllers.TrackingGains(
                self_motion=chosen.self_motion or controllers.TrackingGains.self_motion,
                detours=bool(chosen.detours),
            ),
        )
    is_redundant = limits_of(scenario, task.robot) is not None and task.robot.nv > task.m
    gains: controllers.Gains | None = None
    rule: dict[str, Any] = {"settling_time": chosen.settling_time, "drives": drives}
    given = {"kp": chosen.kp, "kv": chosen.kv, "damping": chosen.damping}
    said = {k: v[0] if len(v) == 1 else v for k, v in given.items() if v is not None}
    if said:  # those of the rule stand beside them
        gains = replace(controllers.tuned(task, latency, **rule).gains, **said)
    return controllers.SetpointController(
        task,
        gains,
        gravity=_gravity(truth, task.robot, chosen.gravity, chosen.integral_action),
        saturation=None if chosen.gamma is None else Sine(chosen.gamma),
        velocity=None if constant is None else controllers.DifferentiatedVelocity(constant),
        posture=controllers.AwayFromStops() if is_redundant else None,
        latency=latency,
        friction=_friction(scenario),
        **rule,
    )


def recommended(scenario: Scenario) -> Scenario:
    """Return a scenario with the default law of a simulation, and default joints if none are given.

    They are the tracking law with learnt kinematics, and detours if it can take them, and usual
    joints, where positions or poses are measured.
    """
    chosen = scenario.controller
    own = "limits", "detours", "self_motion"
    kept = {name: getattr(chosen, name) for name in own}
    usual = replace(type(chosen)(), **kept)
    learns = scenario.task.kind in ("position", "pose") and scenario.true.tracker == Tracker()
    if chosen != usual or not learns or sampling_time(scenario) == 0.0:
        return replace(scenario, controller=replace(chosen, law=chosen.law or "setpoint"))
    is_position = scenario.task.kind == "position"
    detours = is_position if chosen.detours is None else chosen.detours
    law = {"law": "tracking", "unknown": ["tool", "origins", "axes"], "detours": detours}
    joints = {"drives": scenario.true.drives or "usual"}
    return scenario.with_values({"controller": law, "true": joints})


def _friction(scenario: Scenario) -> controllers.FrictionCompensation | None:
    chosen, sensor = scenario.controller, scenario.sensor
    exact = sensor.delay == sensor.noise == 0.0 and sensor.rate is None
    is_recent = bool(chosen.unknown) or (exact and chosen.differentiator is None)
    learns = chosen.gravity in (None, "learnt", "learn_residual")
    if learns and is_recent and sampling_time(scenario) > 0.0:
        return controllers.FrictionCompensation(encoder_step=sensor.q_quantum)
    return None


def _gravity(truth: Robot, belief: Robot, kind: str | None, integral: bool | None) -> Gravity:
    if kind in (None, "learnt", "learn_residual"):
        nothing = 0.0 if integral is False else None
        theta0 = 0.0 if kind == "learn_residual" else None
        return AdaptiveGravity(belief, theta0=theta0, task_force=nothing, joint_torque=nothing)
    if kind == "exact":
        regressor = GravityRegressor(belief)
        theta = regressor.fit(truth)[0]
        if integral:
            return AdaptiveGravity(regressor, L=0.0, theta0=theta)
        return controllers.RegressorGravity(regressor, theta)
    if integral:
        return AdaptiveGravity(belief, L=0.0, theta0=0.0 if kind == "none" else None)
    return controllers.NoGravity(belief) if kind == "none" else controllers.ModelGravity(belief)


def _kinematics(scenario: Scenario, task: Task) -> Kinematics:
    unknown, noise = scenario.controller.unknown, scenario.sensor.noise
    rest: dict[str, Any] = {"delay": scenario.sensor.delay, "dt": sampling_time(scenario)}
    if not isinstance(task, ImageTask):
        noise = max(noise, _BENDS if scenario.true.drives == "usual" else _LEAST_NOISE)
        if scenario.true.calibration is not None:  # of the arm, whatever it holds
            prior = KinematicBelief.load(scenario.true.calibration)
            rest |= {"prior": prior, "sd": {"tool": _TOOL}}
        return controllers.AdaptiveKinematics(task, unknown, noise=noise, angle_noise=noise, **rest)
    if isinstance(task.camera, PlanarCamera):
        noise = max(noise, _LEAST_NOISE * task.camera.magnification)
        return controllers.AdaptiveKinematics(task, unknown, noise=noise, **rest)
    if "camera" in unknown:  # with its focal length
        unknown = tuple(dict.fromkeys((*unknown, "focal_length")))
    if task.camera.mount is not None:
        unknown = tuple("points" if kind == "tool" else kind for kind in unknown)
    return controllers.AdaptiveCamera(task, unknown, noise=max(noise, _LEAST_PIXELS), **rest)


def latency_of(scenario: Scenario) -> Latency:
    """Return the delays of a scenario's loop; for continuous control those of 1 kHz."""
    sensor = scenario.sensor
    learns = bool(scenario.controller.unknown)  # then frames are outside the loop
    filtered = sensor.velocity_filter
    return Latency(
        period=sampling_time(scenario) or Latency.period,
        torque_delay=scenario.loop.actuator_delay,
        # of differences, also without a filter
        velocity_filter=0.0 if filtered is None else max(filtered, _DIFFERENCES),
        image_period=0.0 if learns or sensor.rate is None else 1.0 / sensor.rate,
        image_age=0.0 if learns else sensor.delay,
    )


def sampling_time(scenario: Scenario) -> float:
    """Return the period of control [s], 0 where it is continuous."""
    return scenario.loop.dt if isinstance(scenario.loop.dt, float) else 0.0


def limits_of(scenario: Scenario, belief: Robot) -> Limits | None:
    """Return the limits that the controller keeps, with an entry for each joint."""
    share = scenario.controller.limits
    if share == "none" or sampling_time(scenario) == 0.0:
        return None
    if not np.isfinite(belief.effort_limits).any():
        if share != "urdf":
            raise InvalidInputError(
                "controller.limits are shares of the URDF's effort limits, and that of "
                f"{belief.name} has none, got {share}",
                given=share,
            )
        turns_on = belief.usual_range[1] < belief.position_limits[1]
        if turns_on.all() and not np.isfinite(belief.velocity_limits).any():
            return None
    return Limits.of(belief, share if isinstance(share, float) else 1.0).for_joints(belief.nv)
