"""Visual servoing with a camera that nobody calibrated: settings → run → verdict."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pinocchio as pin

from approxjac.controllers import (
    DifferentiatedVelocity,
    Gains,
    Gravity,
    HeldMeasurement,
    SetpointController,
    VelocityServo,
    default_gains,
)
from approxjac.errors import InvalidInputError
from approxjac.interface import Controller
from approxjac.robots import Dynamics, Robot, load_robot
from approxjac.simulation import Plant, SampledLoop, Sensing
from approxjac.simulation.ready_configuration import holdable
from approxjac.studies.limiting import limited, limits_named
from approxjac.studies.postures import REGULAR, is_regular, posture_from
from approxjac.studies.reach import given_or, gravity_from, sampled
from approxjac.studies.servo_checks import require_effect
from approxjac.studies.servo_result import Servo, ServoResult
from approxjac.studies.servo_scene import ServoScene, carried_scene, watched_scene, well_within
from approxjac.studies.servo_settings import ServoSettings
from approxjac.tasks import CombinedTask, ImageTask, Task
from approxjac.tasks.analysis import seen_configurations, with_error
from approxjac.validation import Array, as_array

__all__ = ["Servo", "ServoResult", "ServoSettings", "prepare", "run"]

_SAMPLES = 50  # postures by which it is judged what is usual
_TRIES = 20000
_STARTS = 20  # tries to find a start to a goal
_AROUND = 0.5  # how far a camera in hand starts from its goal in each joint [rad]
_SINGULAR = 1e-6  # σ_min/σ_max of J below which an arm is singular in a posture
_SETTLED = 4.0  # time constants until 2 % are left


def prepare(robot: str, settings: ServoSettings) -> Servo:
    """Build the truth, the belief, the cameras and what stands between them.

    Raises:
        ApproxJacError: Settings that are out of range or do not fit the robot.
    """
    require_effect(settings)
    arm = load_robot(robot, tip=settings.tip, base=settings.base)
    if 2 * settings.points > arm.nv:
        raise InvalidInputError(
            f"points must be at most half as many as joints, as each has two image coordinates: "
            f"{arm.nv // 2} for {arm.name}, got {settings.points}",
            given=settings.points,
        )
    axis = settings.object_axis
    truth = arm.with_object(settings.object_length, settings.object_mass, axis=axis)
    believe = partial(arm.with_object, mass=settings.believed_mass, axis=axis)
    belief = believe(settings.believed_length)
    rng = np.random.default_rng(settings.seed)
    if settings.eye == "to-hand":
        scene, q0, q_goal = _watched(truth, belief, settings, rng)
    else:
        scene, q0, q_goal = _carried(truth, belief, arm.tip_or(None), settings, rng)
        _require_in_view(scene)
    target = scene.sensor.value(q_goal)
    if settings.target is not None:
        images = as_array("target", settings.target, (scene.sensor.m,), "px")
        target = with_error(scene.sensor, target, scene.sensor._origin, images)
        target = scene.sensor.target(target)
    gravity = gravity_from(truth, belief, settings.gravity)
    task: Task = scene.task
    if settings.points > 1 and settings.law != "5":
        task = CombinedTask.balanced(task, target)
    controller = _controller(task, gravity, settings)
    dt, motors = 1.0 / settings.rate, truth.effort_limits
    inner: Controller = controller
    if settings.torque_limits is not None:
        limits = limits_named(settings.torque_limits, belief)
        motors = np.asarray(limits.effort)
        inner = limited(controller, limits, "qp", dt)
    plant = Plant(truth, scene.sensor, sensing=_sensing(settings), torque_limits=motors)
    held = HeldMeasurement(inner, settings.unseen)
    return Servo(robot, settings, plant, controller, held, q0, q_goal, target, believe)


def run(
    servo: Servo,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[SampledLoop], None] | None = None,
) -> ServoResult:
    """Simulate a visual servoing run and judge it; as `simulate`'s are `progress` and `observer`.

    Raises:
        SimulationError: The closed loop diverged.
    """
    plant, settings = servo.plant, servo.settings
    record = sampled(plant, servo.held, servo.target, servo.q0, settings, progress, observer)
    return ServoResult(servo, record)


def _watched(
    truth: Robot, belief: Robot, settings: ServoSettings, rng: np.random.Generator
) -> tuple[ServoScene, Array, Array]:
    """Scene, start and goal for a camera in the world."""
    scene = watched_scene(truth, belief, settings)
    sensor, q0 = scene.sensor, None
    if settings.start is not None:
        q0 = posture_from(truth, settings.start)
        _require_seen(sensor, q0)
    _require_in_view(scene)
    ratio = _usual_ratio([(sensor, q) for q in seen_configurations(sensor, _SAMPLES)])

    def draw() -> Array:
        for _ in range(_TRIES):
            q = truth.random_configuration(rng)
            if _is_usable(scene, q, ratio):
                return q
        raise _none_found(sensor)

    q0 = draw() if q0 is None else q0
    return scene, q0, draw()


def _carried(
    truth: Robot, belief: Robot, mount: str, settings: ServoSettings, rng: np.random.Generator
) -> tuple[ServoScene, Array, Array]:
    """Scene, start and goal for a camera on the arm: points are put before it at the goal."""
    usual = []
    for _ in range(_SAMPLES):
        q = truth.random_configuration(rng)
        usual.append((carried_scene(truth, belief, mount, q, settings).sensor, q))
    ratio = _usual_ratio(usual)
    for _ in range(_TRIES):
        q_goal = truth.random_configuration(rng)
        scene = carried_scene(truth, belief, mount, q_goal, settings)
        if not _is_usable(scene, q_goal, ratio):
            continue
        if settings.start is not None:
            q0 = posture_from(truth, settings.start)
            _require_seen(scene.sensor, q0)
            return scene, q0, q_goal
        for _ in range(_STARTS):
            motion = rng.uniform(-_AROUND, _AROUND, truth.nv)
            q0 = pin.integrate(truth.model, q_goal, motion)
            if _is_usable(scene, q0, ratio):
                return scene, q0, q_goal
    raise _none_found(scene.sensor)


def _usual_ratio(usual: list[tuple[ImageTask, Array]]) -> float:
    """σ_min/σ_max of J above which a posture is not near singular.

    Of several points it is small in every posture: what counts is how small it usually is.
    """
    ratios = []
    for sensor, q in usual:
        values = np.linalg.svd(sensor.jacobian(q, sensor.value(q)), compute_uv=False)
        ratios.append(values[-1] / values[0])
    if not np.median(ratios) > _SINGULAR:
        sensor = usual[0][0]
        raise InvalidInputError(
            f"points must be such that {sensor.robot.name} can move each of their "
            f"{sensor.m} image coordinates by itself, and no posture was found in which it can: "
            f"give fewer points, or another camera; got {sensor!r}",
            given=sensor,
        )
    return min(REGULAR, 0.5 * float(np.median(ratios)))


def _is_usable(scene: ServoScene, q: Array, ratio: float) -> bool:
    """Whether a posture can be a start or a goal."""
    low, high = scene.sensor.robot.position_limits
    motion = pin.difference(scene.sensor.robot.model, scene.sensor.robot.neutral(), q)
    return (
        bool(((motion >= low) & (motion <= high)).all())
        and well_within(scene.sensor, q)
        and holdable(Dynamics(scene.sensor.robot), q, scene.sensor.robot.effort_limits)
        and is_regular(*scene, q, ratio)
    )


def _require_seen(sensor: ImageTask, q0: Array) -> None:
    images = sensor.value(q0).reshape(len(sensor.points), -1)[:, :2]
    for i, (image, Z) in enumerate(zip(images, sensor.depths(q0), strict=True), start=1):
        if not np.isfinite(sensor.camera.seen(image)).all():
            behind = f"{-Z:.3g} m behind it"
            near = f"{Z:.3g} m before it, which is too near or too far aside"
            shown = f"at ({image[0]:.0f}, {image[1]:.0f}) px, outside its image"
            where = behind if Z <= 0.0 else shown if np.isfinite(image).all() else near
            raise InvalidInputError(
                f"start must be a posture in which the camera sees all points, and point {i} is "
                f"{where}: give another start, or none for one of the seed, or move the camera; "
                f"got {q0.tolist()} for {sensor.camera!r}",
                given=q0,
            )


def _require_in_view(scene: ServoScene) -> None:
    for which, task in (("true", scene.sensor), ("believed", scene.task)):
        try:
            seen_configurations(task, 1)
        except InvalidInputError as error:
            raise InvalidInputError(
                f"the {which} camera must see the points in some posture: give another "
                "camera_position or camera_target, or smaller errors of the believed camera; "
                f"got {task!r}",
                given=task,
            ) from error


def _none_found(sensor: ImageTask) -> InvalidInputError:
    return InvalidInputError(
        f"no posture of {sensor.robot.name} was found in which the camera sees all points well "
        "within its image, that the motors can hold and where the Jacobian is not near singular: "
        f"move or turn the camera, or give fewer points; got {sensor!r}",
        given=sensor,
    )


def _controller(
    task: Task, gravity: Gravity, settings: ServoSettings
) -> SetpointController | VelocityServo:
    if settings.law == "ibvs":
        return VelocityServo(task, _SETTLED / settings.settling_time, gravity=gravity)
    # damping acts as late as q̇ is known; that of law (5) as late as the image tells Ẋ
    lag = 1.0 / settings.rate + (settings.velocity_filter or 0.0)
    velocity = None
    if settings.law == "5":
        velocity = DifferentiatedVelocity(settings.differentiator)
        lag += settings.differentiator + settings.latency + 0.5 / settings.frame_rate
    gains = default_gains(task, settings.settling_time, bandwidth=1.0 / lag)
    gains = Gains(
        kp=given_or(settings.kp, gains.kp),
        kv=given_or(settings.kv, gains.kv),
        damping=given_or(settings.damping, gains.damping),
    )
    return SetpointController(task, gains, gravity=gravity, velocity=velocity)


def _sensing(settings: ServoSettings) -> Sensing:
    lost = settings.lost
    parts = range(settings.points)
    if settings.lost_point is not None:
        if lost is None or not 1 <= settings.lost_point <= settings.points:
            raise InvalidInputError(
                f"lost_point must be one of the points, 1 to {settings.points}, with a time in "
                f"lost, got {settings.lost_point} with lost = {lost}",
                given=settings.lost_point,
            )
        parts = range(settings.lost_point - 1, settings.lost_point)
    return Sensing(
        x_noise=settings.noise,
        x_quantum=settings.quantum,
        x_delay=settings.latency,
        x_dropout=settings.dropout,
        x_rate=settings.frame_rate,
        x_lost=() if lost is None else tuple((*lost, part) for part in parts),
        x_frozen=() if settings.frozen is None else (settings.frozen,),
        velocity_filter=settings.velocity_filter,
    )
