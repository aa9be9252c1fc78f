"""What a pinhole camera of a scenario sees: where it stands, what it watches, and from where to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, Robot
from approxjac.scenario.configurations import REGULAR, configuration_of, is_regular
from approxjac.scenario.records import Camera, CameraError
from approxjac.scenario.scenario import Scenario
from approxjac.simulation.plant import holdable
from approxjac.tasks import FrameKinematics, ImageTask, PinholeCamera
from approxjac.tasks.analysis import seen_configurations
from approxjac.validation import Array, as_array

_FOCAL_LENGTH = 600.0  # [px]
_FRONT = np.array([0.75, -0.6, 0.3])  # of the arm, to its right and above
_AWAY = 1.0  # distance of the camera from what it looks at, in reaches of the arm
_MIDDLE = np.array([0.5, 0.0, 0.5])  # of where the arm reaches, in reaches
_WORKING_DEPTH = 0.35  # of the points of the world before a camera in hand [m]
_MARGIN = 0.1  # of the image at each edge, where no target is put
_SAMPLES = 50  # configurations by which it is judged what is usual
_TRIES = 20000
_STARTS = 20  # tries to find a start to a goal
_AROUND = 0.5  # how far a camera in hand starts from its goal in each joint [rad]
_SINGULAR = 1e-6  # σ_min/σ_max of J below which an arm is singular in a configuration


class ImageScene(NamedTuple):
    """The true sensor and the believed task of an image scenario.

    Attributes:
        sensor: Task of the true robot and the true camera.
        task: Task of the believed robot and the believed camera.
    """

    sensor: ImageTask
    task: ImageTask


def image_scene(
    truth: Robot, belief: Robot, mount: str, scenario: Scenario, rng: np.random.Generator
) -> tuple[ImageScene, Array, Array]:
    """Return what a pinhole camera sees, the start, and a goal, shape (nq,) each.

    Args:
        truth: The true robot.
        belief: The believed robot.
        mount: Frame of both that "tip" means for a camera in hand.
        scenario: What was asked for.
        rng: Draws the goal, and the start where it is not given.

    Raises:
        InvalidInputError: A camera that does not see the points, or too many of them.
    """
    points = scenario.task.points
    if not 1 <= points <= 3:
        raise InvalidInputError(f"task.points must be 1, 2 or 3, got {points!r}", given=points)
    if 2 * points > truth.nv:
        raise InvalidInputError(
            "task.points must be at most half as many as joints, as each has two image "
            f"coordinates: {truth.nv // 2} for {truth.name}, got {points}",
            given=points,
        )
    camera = scenario.true.camera
    if camera.mount is None:
        return _watched(truth, belief, scenario, rng)
    mount = mount if camera.mount == "tip" else camera.mount
    scene, q0, q_goal = _carried(truth, belief, mount, scenario, rng)
    _require_in_view(scene)
    return scene, q0, q_goal


def _watched(
    truth: Robot, belief: Robot, scenario: Scenario, rng: np.random.Generator
) -> tuple[ImageScene, Array, Array]:
    """Scene, start and goal for a camera in the world."""
    scene = _scene_in_world(truth, belief, scenario)
    sensor, q0 = scene.sensor, None
    if isinstance(scenario.run.start, tuple):
        q0 = configuration_of(truth, "run.start", scenario.run.start)
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
    truth: Robot, belief: Robot, mount: str, scenario: Scenario, rng: np.random.Generator
) -> tuple[ImageScene, Array, Array]:
    """Scene, start and goal for a camera on the arm: points are put before it at the goal."""
    usual = []
    for _ in range(_SAMPLES):
        q = truth.random_configuration(rng)
        usual.append((_scene_in_hand(truth, belief, mount, q, scenario).sensor, q))
    ratio = _usual_ratio(usual)
    for _ in range(_TRIES):
        q_goal = truth.random_configuration(rng)
        scene = _scene_in_hand(truth, belief, mount, q_goal, scenario)
        if not _is_usable(scene, q_goal, ratio):
            continue
        if isinstance(scenario.run.start, tuple):
            q0 = configuration_of(truth, "run.start", scenario.run.start)
            _require_seen(scene.sensor, q0)
            return scene, q0, q_goal
        for _ in range(_STARTS):
            motion = rng.uniform(-_AROUND, _AROUND, truth.nv)
            q0 = pin.integrate(truth.model, q_goal, motion)
            if _is_usable(scene, q0, ratio):
                return scene, q0, q_goal
    raise _none_found(scene.sensor)


def _scene_in_world(truth: Robot, belief: Robot, scenario: Scenario) -> ImageScene:
    """A camera in the world that watches points of the object that the arm holds."""
    given, wrong, task = scenario.true.camera, scenario.believed.camera, scenario.task
    reach = _reach(truth)
    middle = _MIDDLE * reach if given.looking_at is None else np.array(given.looking_at)
    position = middle + _AWAY * reach * _FRONT / np.linalg.norm(_FRONT)
    position = position if given.position is None else np.array(given.position)
    camera = PinholeCamera.looking_at(
        middle, position, given.focal_length or _FOCAL_LENGTH, given.size,
        distortion=given.distortion,
    )  # fmt: skip
    depth = float(np.linalg.norm(middle - position))
    believed = _believed(camera, wrong, (wrong.depth_factor - 1.0) * depth)
    points = _point_pattern(task.points, task.spread)
    chosen = task.depth or "believed"
    constant = wrong.depth_factor * depth
    return _image_tasks(truth, belief, camera, believed, points, chosen, constant)


def _scene_in_hand(
    truth: Robot, belief: Robot, mount: str, q_goal: Array, scenario: Scenario
) -> ImageScene:
    """A camera on the arm that watches points of the world, before it at the goal."""
    given, wrong, task = scenario.true.camera, scenario.believed.camera, scenario.task
    camera = _camera_in_hand(truth, mount, given)
    chosen = task.depth or "constant"
    # a constant depth is wrong by itself, and nothing else then needs to know where points are
    back = 0.0 if chosen == "constant" else (wrong.depth_factor - 1.0) * _WORKING_DEPTH
    believed = _believed(camera, wrong, back)
    R_goal, p_goal = FrameKinematics(truth, mount).placement(q_goal)
    R_eye, p_eye = camera.placement()
    # a little out of the plane across the view, where three points tell least of a tilt
    pattern = _point_pattern(task.points, task.spread)[:, [1, 2, 0]]
    pattern = pattern - pattern.mean(axis=0) + np.array([0.0, 0.0, _WORKING_DEPTH])
    points = (pattern @ R_eye.T + p_eye) @ R_goal.T + p_goal
    constant = wrong.depth_factor * ImageTask(truth, camera, points=points).depths(q_goal)
    return _image_tasks(truth, belief, camera, believed, points, chosen, constant)


def _camera_in_hand(truth: Robot, mount: str, given: Camera) -> PinholeCamera:
    """A camera that looks along the axis that leads on from the arm, a little above it."""
    axis = truth.outward_axis()
    view = np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
    right = np.cross(view, np.roll(np.abs(view), 1))
    R = np.column_stack([np.cross(right, view), right, view])
    position = given.position or tuple((-0.05 * R[:, 1]).tolist())
    return PinholeCamera(
        given.focal_length or _FOCAL_LENGTH, given.size, position, R, distortion=given.distortion,
        mount=mount,
    )  # fmt: skip


def _image_tasks(
    truth: Robot,
    belief: Robot,
    camera: PinholeCamera,
    believed: PinholeCamera,
    points: Array,
    depth: str,
    constant: float | Array,
) -> ImageScene:
    measured = "measured" if depth == "measured" else "believed"
    return ImageScene(
        ImageTask(truth, camera, points=points, depth=measured),
        ImageTask(
            belief, believed, points=points, depth=constant if depth == "constant" else depth
        ),
    )


def _believed(camera: PinholeCamera, wrong: CameraError, back: float) -> PinholeCamera:
    """What is believed of a camera: no distortion, and the errors of the scenario."""
    tilt = pin.exp3(np.array(wrong.rotation))
    off = camera.with_error(
        shift=as_array("shift", wrong.shift, (3,), "m") - [0.0, 0.0, back],
        rotation=pin.log3(pin.exp3(np.array([0.0, 0.0, wrong.roll])) @ tilt),
        focal_factor=wrong.focal_factor,
    )
    return PinholeCamera(
        off.focal_length, off.size, off.position, off.rotation, center=off.center, mount=off.mount
    )


def _point_pattern(count: int, spread: float) -> Array:
    """Points of an object: its tip, one beside it, and one off their line; shape (count, 3)."""
    corner = math.sqrt(0.75)
    return spread * np.array([[0, 0, 0], [0, 1, 0], [0.7, 0.5, corner]], dtype=float)[:count]


def _reach(robot: Robot) -> float:
    """How far from the world's origin the tip gets, over seeded random configurations [m]."""
    rng, kinematics = np.random.default_rng(0), FrameKinematics(robot, robot.tip_or(None))
    tips = [kinematics.position(robot.random_configuration(rng)) for _ in range(200)]
    return float(np.max(np.linalg.norm(tips, axis=1)))


def _usual_ratio(usual: list[tuple[ImageTask, Array]]) -> float:
    """σ_min/σ_max of J above which a configuration is not near singular.

    Of several points it is small everywhere: what counts is how small it usually is.
    """
    ratios = []
    for sensor, q in usual:
        values = np.linalg.svd(sensor.jacobian(q, sensor.value(q)), compute_uv=False)
        ratios.append(values[-1] / values[0])
    if not np.median(ratios) > _SINGULAR:
        sensor = usual[0][0]
        raise InvalidInputError(
            f"task.points must be such that {sensor.robot.name} can move each of their "
            f"{sensor.m} image coordinates by itself, and no configuration was found in which it "
            f"can: give fewer points, or another camera; got {sensor!r}",
            given=sensor,
        )
    return min(REGULAR, 0.5 * float(np.median(ratios)))


def _is_usable(scene: ImageScene, q: Array, ratio: float) -> bool:
    """Whether a configuration can be a start or a goal."""
    robot = scene.sensor.robot
    low, high = robot.position_limits
    motion = pin.difference(robot.model, robot.neutral(), q)
    return (
        bool(((motion >= low) & (motion <= high)).all())
        and _well_within(scene.sensor, q)
        and holdable(Dynamics(robot), q, robot.effort_limits)
        and is_regular(*scene, q, ratio)
    )


def _well_within(sensor: ImageTask, q: Array) -> bool:
    """Whether the points are seen, and not near the edges of the image."""
    assert isinstance(sensor.camera, PinholeCamera)  # the scenes above have no other
    x = sensor.value(q).reshape(len(sensor.points), -1)[:, :2]
    size = np.array(sensor.camera.size)
    low, high = _MARGIN * size, (1.0 - _MARGIN) * size
    return bool(((x > low) & (x < high)).all())  # NaN is not


def _require_seen(sensor: ImageTask, q0: Array) -> None:
    images = sensor.value(q0).reshape(len(sensor.points), -1)[:, :2]
    for i, (image, Z) in enumerate(zip(images, sensor.depths(q0), strict=True), start=1):
        if not np.isfinite(sensor.camera.seen(image)).all():
            behind = f"{-Z:.3g} m behind it"
            near = f"{Z:.3g} m before it, which is too near or too far aside"
            shown = f"at ({image[0]:.0f}, {image[1]:.0f}) px, outside its image"
            where = behind if Z <= 0.0 else shown if np.isfinite(image).all() else near
            raise InvalidInputError(
                "run.start must be a configuration in which the camera sees all points, and point "
                f"{i} is {where}: give another start, or none for one of the seed, or move the "
                f"camera; got {q0.tolist()} for {sensor.camera!r}",
                given=q0,
            )


def _require_in_view(scene: ImageScene) -> None:
    for which, task in (("true", scene.sensor), ("believed", scene.task)):
        try:
            seen_configurations(task, 1)
        except InvalidInputError as error:
            raise InvalidInputError(
                f"the {which} camera must see the points in some configuration: give another "
                "position or looking_at of true.camera, or smaller errors of believed.camera; "
                f"got {task!r}",
                given=task,
            ) from error


def _none_found(sensor: ImageTask) -> InvalidInputError:
    return InvalidInputError(
        f"no configuration of {sensor.robot.name} was found in which the camera sees all points "
        "well within its image, that the motors can hold and where the Jacobian is not near "
        f"singular: move or turn the camera, or give fewer points; got {sensor!r}",
        given=sensor,
    )
