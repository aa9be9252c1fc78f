"""Start and target configurations, given or random, checks of reach, and image scenes."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin

from approxjac.cameras import PinholeCamera
from approxjac.controllers.setpoint import Reach
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, Robot
from approxjac.robots.urdf import direction
from approxjac.scenario.scenario import Scenario
from approxjac.simulation.plant import holdable
from approxjac.tasks import FrameKinematics, ImageTask, Task
from approxjac.tasks.analysis import seen_configurations
from approxjac.validation import Array, as_array

_WAYS = 100  # that are tried
REGULAR = 0.1  # starts and targets have σ_min of J and of Ĵ above this share of σ_max


def regular_configuration(
    sensor: Task,
    task: Task,
    rng: np.random.Generator,
    effort: Array | None = None,
    tries: int = 1000,
) -> Array:
    """Return a random configuration that can be a start or a target.

    Within the joint limits, neither J nor Ĵ is near singular, and holding it takes at most 70 % of
    the effort limits (n_v,) [N m or N], by default those of the URDF.
    """
    effort = sensor.robot.effort_limits if effort is None else effort
    dynamics = Dynamics(sensor.robot)
    for _ in range(tries):
        q = sensor.robot.random_configuration(rng)
        if holdable(dynamics, q, effort) and is_regular(sensor, task, q):
            return q
    raise InvalidInputError(
        f"no configuration of {sensor.robot.name} was found that its motors can hold and where the "
        "task is not near singular: give a lighter object, larger torque limits, or other axes "
        f"than those of {sensor!r}",
        given=sensor,
    )


def floor_below(robot: Robot) -> float:
    """Return the height of the lowest fixed frame [m]; -inf of an arm that begins no higher."""
    floor = min(f.placement.translation[2] for f in robot.model.frames if f.parentJoint == 0)
    stands = robot.model.jointPlacements[1].translation[2] > floor + 1e-6  # else it may hang
    return float(floor) if stands else -np.inf


def straight_ahead(sensor: Task, q0: Array, draw: Callable[[], Array], floor: float) -> Array:
    """Return a random configuration that the arm reaches on a straight way from q0 (nq,).

    The tip is above the floor [m] in it, and no joint stop blocks that way in task space, unless
    none of all that are drawn is such.
    """
    from approxjac.stability.loop.configurations import inverse_kinematics  # not for a help

    tip = FrameKinematics(sensor.robot, sensor.robot.tip_or(None))
    reached = partial(inverse_kinematics, sensor, q0=q0, within_limits=True)
    for _ in range(_WAYS):
        q = draw()
        if tip.position(q)[2] >= floor and reached(sensor.value(q)) is not None:
            break
    return q


def is_regular(sensor: Task, task: Task, q: Array, ratio: float = REGULAR) -> bool:
    """Return True if neither J nor Ĵ is near singular at a configuration."""
    x = sensor.value(q)
    values = [np.linalg.svd(each.jacobian(q, x), compute_uv=False) for each in (sensor, task)]
    return all(v[-1] > ratio * v[0] for v in values)


def numbers(key: str, values: tuple[float, ...], count: int, unit: str) -> Array:
    """Return the `count` numbers of a key as an array."""
    if len(values) != count:
        message = f"{key} must be {count} numbers [{unit}], got {len(values)}"
        raise InvalidInputError(message, given=values)
    return as_array(key, values, (count,), unit)


def configuration_of(
    robot: Robot, name: str, joints: tuple[float, ...], within_limits: bool = True
) -> Array:
    """Return the configuration (nq,) of one number a joint, continuous joints included."""
    motion = numbers(name, joints, robot.nv, "rad or m")
    if within_limits and robot.nq == robot.nv:
        robot.require_radians(name, motion)
    low, high = robot.position_limits
    for i in np.nonzero((motion < low) | (motion > high))[0] if within_limits else ():
        raise InvalidInputError(
            f"{name} must be within the joint limits, got {motion[i]:g} for {robot.joint_names[i]} "
            f"({low[i]:.4g} to {high[i]:.4g} {robot.joint_units[i]})",
            given=joints,
        )
    return np.array(robot.configuration(motion))


def too_far(task: Task, values: Array) -> str:
    """Return the reason why values (N, n_x) are beyond the stretched arm's reach; or ""."""
    reach = Reach(task)
    if reach.most == np.inf:
        return ""
    away = float(np.linalg.norm(reach.position(values), axis=1).max())
    if away <= reach.most:
        return ""
    return f"out of reach: {away:.3g} m from the first joint, where {reach.most:.3g} m is the most"


# -- scenes of a pinhole camera: cameras, points, start and goal -------------------------

_FOCAL_LENGTH = 600.0  # [px]
_FRONT = np.array([0.75, -0.6, 0.3])  # of the arm, to its right and above
_AWAY = 1.0  # distance of the camera from what it looks at, in reaches of the arm
_MIDDLE = np.array([0.5, 0.0, 0.5])  # of where the arm reaches, in reaches
_WORKING_DEPTH = 0.35  # of the points of the world before a camera in hand [m]
_MARGIN = 0.1  # of the image at each edge, where no target is put
_SAMPLES = 50  # configurations by which it is judged what is usual
_TRIES = 40000
_STARTS = 20  # tries to find a start to a goal
_AROUND = 0.5  # how far a camera in hand starts from its goal in each joint [rad]
_SINGULAR = 1e-6  # σ_min/σ_max of J below which an arm is singular in a configuration

Scene = tuple[ImageTask, ImageTask]  # of the true robot and camera, of the believed ones


def image_scene(
    truth: Robot, belief: Robot, mount: str, scenario: Scenario, rng: np.random.Generator
) -> tuple[Scene, Array, Array]:
    """Return the tasks of a pinhole camera, the start, and a goal, shape (nq,) each."""
    points, camera = scenario.task.points, scenario.true.camera
    if not 1 <= points <= 3:
        raise InvalidInputError(
            f"task.points must be 1, 2 or 3, got {points!r}; four, such as a tag's corners, are "
            "for Python: approxjac.tasks.CombinedTask.balanced",
            given=points,
        )
    if 2 * points > truth.nv:
        raise InvalidInputError(
            "task.points must be at most half as many as joints, as each has two image "
            f"coordinates: {truth.nv // 2} for {truth.name}, got {points}",
            given=points,
        )
    look: Callable[[Array], Scene]  # with a configuration at the goal
    q0: Array | None = None
    if camera.mount is None:
        scene = _scene_in_world(truth, belief, scenario)
        look, q0 = lambda q: scene, _given_start(scene[0], scenario)
        _require_in_view(scene)
        usual = seen_configurations(scene[0], _SAMPLES)
    else:
        frame = mount if camera.mount == "tip" else camera.mount
        look = partial(_scene_in_hand, truth, belief, frame, scenario)
        usual = [truth.random_configuration(rng) for _ in range(_SAMPLES)]
    ratio = _usual_ratio([(look(q)[0], q) for q in usual])
    drawn = (truth.random_configuration(rng) for _ in range(_TRIES))
    usable = (q for q in drawn if _is_usable(look(q), q, ratio))
    if camera.mount is None and q0 is None:
        q0 = next(usable, None)
    for q_goal in usable:
        scene = look(q_goal)
        if camera.mount is not None:
            around = (rng.uniform(-_AROUND, _AROUND, truth.nv) for _ in range(_STARTS))
            near = (np.array(pin.integrate(truth.model, q_goal, each)) for each in around)
            q0 = _given_start(scene[0], scenario)
            if q0 is None:
                q0 = next((q for q in near if _is_usable(scene, q, ratio)), None)
        if q0 is not None:
            _require_in_view(scene)
            return scene, q0, q_goal
    sensor = look(usual[0])[0]
    raise InvalidInputError(
        f"no configuration of {sensor.robot.name} was found in which the camera sees all points "
        "well within its image, that the motors can hold and where the Jacobian is not near "
        f"singular: move or turn the camera, or give fewer points; got {sensor!r}",
        given=sensor,
    )


def _scene_in_world(truth: Robot, belief: Robot, scenario: Scenario) -> Scene:
    """Return the tasks of a camera in the world that watches points of the object."""
    given, factor = scenario.true.camera, scenario.believed.camera.depth_factor
    kinematics = FrameKinematics(truth, truth.tip_or(None))
    tips = [*map(kinematics.position, truth.configurations(200))]
    reach = float(np.max(np.linalg.norm(tips, axis=1)))  # from the world's origin
    middle = _MIDDLE * reach if given.looking_at is None else np.array(given.looking_at)
    position = middle + _AWAY * reach * _FRONT / np.linalg.norm(_FRONT)
    position = position if given.position is None else np.array(given.position)
    camera = PinholeCamera.looking_at(
        middle, position, given.focal_length or _FOCAL_LENGTH, given.size,
        distortion=given.distortion,
    )  # fmt: skip
    depth = float(np.linalg.norm(middle - position))
    believed = _believed(camera, scenario, (factor - 1.0) * depth)
    chosen = scenario.task.depth or "believed"
    return _scene(
        ImageTask(truth, camera, points=_points(scenario)), belief, believed, chosen, factor * depth
    )


def _scene_in_hand(
    truth: Robot, belief: Robot, mount: str, scenario: Scenario, q_goal: Array
) -> Scene:
    """Return the tasks of a camera on the arm that watches points before it at the goal."""
    given, factor = scenario.true.camera, scenario.believed.camera.depth_factor
    view = direction(truth.outward_axis())
    right = np.cross(view, np.roll(np.abs(view), 1))
    R = np.column_stack([np.cross(right, view), right, view])
    camera = PinholeCamera(
        given.focal_length or _FOCAL_LENGTH, given.size,
        given.position or tuple((-0.05 * R[:, 1]).tolist()),  # a little above the axis
        R, distortion=given.distortion, mount=mount,
    )  # fmt: skip
    R_goal, p_goal = FrameKinematics(truth, mount).placement(q_goal)
    R_eye, p_eye = camera.placement()
    # a little out of the plane across the view, where three points show a tilt least
    pattern = _points(scenario)[:, [1, 2, 0]]
    pattern = pattern - pattern.mean(axis=0) + np.array([0.0, 0.0, _WORKING_DEPTH])
    sensor = ImageTask(truth, camera, points=(pattern @ R_eye.T + p_eye) @ R_goal.T + p_goal)
    chosen = scenario.task.depth or ("believed" if scenario.controller.unknown else "constant")
    # a constant depth is wrong by itself, and nothing else then needs to know where points are
    back = 0.0 if chosen == "constant" else (factor - 1.0) * _WORKING_DEPTH
    believed = _believed(camera, scenario, back)
    return _scene(sensor, belief, believed, chosen, factor * sensor.depths(q_goal))


def _scene(
    sensor: ImageTask, belief: Robot, believed: PinholeCamera, depth: str, constant: float | Array
) -> Scene:
    points = sensor.points
    if depth == "measured":
        sensor = ImageTask(sensor.robot, sensor.camera, points=points, depth=depth)
    source = constant if depth == "constant" else depth
    return sensor, ImageTask(belief, believed, points=points, depth=source)


def _believed(camera: PinholeCamera, scenario: Scenario, back: float) -> PinholeCamera:
    wrong = scenario.believed.camera
    off = camera.with_error(
        shift=np.array(wrong.shift) - [0.0, 0.0, back],
        rotation=pin.log3(
            pin.exp3(np.array([0.0, 0.0, wrong.roll])) @ pin.exp3(np.array(wrong.rotation))
        ),
        focal_factor=wrong.focal_factor,
    )
    return replace(off, distortion=())


def _points(scenario: Scenario) -> Array:
    """Return points of an object: its tip, one beside it, one off their line; shape (k, 3)."""
    pattern = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.7, 0.5, math.sqrt(0.75)]])
    return scenario.task.spread * pattern[: scenario.task.points]


def _usual_ratio(usual: list[tuple[ImageTask, Array]]) -> float:
    """Return σ_min/σ_max of J above which a configuration of such images is not near singular."""
    # of several points it is small everywhere: what counts is how small it usually is
    values = [np.linalg.svd(s.jacobian(q, s.value(q)), compute_uv=False) for s, q in usual]
    ratio = float(np.median([each[-1] / each[0] for each in values]))
    if not ratio > _SINGULAR:
        sensor = usual[0][0]
        raise InvalidInputError(
            f"task.points must be such that {sensor.robot.name} can move each of their "
            f"{sensor.m} image coordinates by itself, and no configuration was found in which it "
            f"can: give fewer points, or another camera; got {sensor!r}",
            given=sensor,
        )
    return min(REGULAR, 0.5 * ratio)


def _is_usable(scene: Scene, q: Array, ratio: float) -> bool:
    sensor, robot = scene[0], scene[0].robot
    assert isinstance(sensor.camera, PinholeCamera)  # the scenes above have no other
    images, size = sensor.features[0].images(sensor.value(q)), np.array(sensor.camera.size)
    return (
        bool((robot.beyond_limits(q[np.newaxis]) <= 0.0).all())
        and bool(((images > _MARGIN * size) & (images < (1.0 - _MARGIN) * size)).all())
        and holdable(Dynamics(robot), q, robot.effort_limits)
        and is_regular(*scene, q, ratio)
    )


def _given_start(sensor: ImageTask, scenario: Scenario) -> Array | None:
    """Return the given start, in which the camera has to see all points; None if there is none."""
    if not isinstance(scenario.run.start, tuple):
        return None
    q0 = configuration_of(sensor.robot, "run.start", scenario.run.start)
    images = sensor.features[0].images(sensor.value(q0))
    for i, (image, Z) in enumerate(zip(images, sensor.depths(q0), strict=True), 1):
        if not np.isfinite(sensor.camera.seen(image)).all():
            shown = f"at ({image[0]:.0f}, {image[1]:.0f}) px, outside its image"
            where = f"{-Z:.3g} m behind it" if Z <= 0.0 else shown
            raise InvalidInputError(
                "run.start must be a configuration in which the camera sees all points, and point "
                f"{i} is {where}: give another start, or none for one of the seed, or move the "
                f"camera; got {q0.tolist()} for {sensor.camera!r}",
                given=q0,
            )
    return q0


def _require_in_view(scene: Scene) -> None:
    for which, task in zip(("true", "believed"), scene, strict=True):
        try:
            seen_configurations(task, 1)
        except InvalidInputError as error:
            raise InvalidInputError(
                f"the {which} camera must see the points in some configuration: give another "
                "position or looking_at of true.camera, or smaller errors of believed.camera; "
                f"got {task!r}",
                given=task,
            ) from error
