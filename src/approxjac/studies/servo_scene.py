"""What a camera sees: where it stands, what it watches, and what is believed of both."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.studies.servo_settings import ServoSettings
from approxjac.tasks import FrameKinematics, ImageTask, PinholeCamera
from approxjac.validation import Array, as_array, as_number

_FRONT = np.array([0.75, -0.6, 0.3])  # of the arm, to its right and above
_AWAY = 1.0  # distance of the camera from what it looks at, in reaches of the arm
_MIDDLE = np.array([0.5, 0.0, 0.5])  # of where the arm reaches, in reaches
_WORKING_DEPTH = 0.35  # of the points of the world before a camera in hand [m]
_MARGIN = 0.1  # of the image at each edge, where no target is put


class ServoScene(NamedTuple):
    """The true sensor and the believed task of a visual servoing run.

    Attributes:
        sensor: Task of the true robot and the true camera.
        task: Task of the believed robot and the believed camera.
    """

    sensor: ImageTask
    task: ImageTask


def watched_scene(truth: Robot, belief: Robot, settings: ServoSettings) -> ServoScene:
    """A camera in the world that watches points of the object that the arm holds."""
    view = settings.camera_target
    reach = arm_reach(truth)
    middle = _MIDDLE * reach if view is None else as_array("camera_target", view, (3,), "m")
    stand = settings.camera_position
    position = (
        middle + _AWAY * reach * _FRONT / np.linalg.norm(_FRONT)
        if stand is None
        else as_array("camera_position", stand, (3,), "m")
    )
    camera = PinholeCamera.looking_at(
        middle, position, settings.focal_length, settings.image_size,
        distortion=settings.distortion,
    )  # fmt: skip
    depth = float(np.linalg.norm(middle - position))
    believed = _believed(camera, settings, (settings.depth_factor - 1.0) * depth)
    points = point_pattern(settings.points, settings.spread)
    chosen = settings.depth or "believed"
    measured = "measured" if chosen == "measured" else "believed"
    constant = settings.depth_factor * depth
    return ServoScene(
        ImageTask(truth, camera, points=points, depth=measured),
        ImageTask(
            belief, believed, points=points, depth=constant if chosen == "constant" else chosen
        ),
    )


def carried_scene(
    truth: Robot, belief: Robot, mount: str, q_goal: Array, settings: ServoSettings
) -> ServoScene:
    """A camera on the arm that watches points of the world, before it at the goal.

    Args:
        truth: The true robot.
        belief: The believed robot.
        mount: Frame of both that carries the camera.
        q_goal: Posture at the goal, shape (nq,).
        settings: What was asked for.
    """
    view = _axis(truth.outward_axis())
    right = np.cross(view, np.roll(np.abs(view), 1))
    R = np.column_stack([np.cross(right, view), right, view])
    position = settings.camera_position or tuple((-0.05 * R[:, 1]).tolist())
    camera = PinholeCamera(
        settings.focal_length, settings.image_size, position, R, distortion=settings.distortion,
        mount=mount,
    )  # fmt: skip
    back = (settings.depth_factor - 1.0) * _WORKING_DEPTH
    chosen = settings.depth or "constant"
    # a constant depth is wrong by itself, and nothing else then needs to know where points are
    believed = _believed(camera, settings, 0.0 if chosen == "constant" else back)
    R_goal, p_goal = FrameKinematics(truth, mount).placement(q_goal)
    R_eye, p_eye = camera.placement()
    # a little out of the plane across the view, where three points tell least of a tilt
    pattern = point_pattern(settings.points, settings.spread)[:, [1, 2, 0]]
    pattern = pattern - pattern.mean(axis=0) + np.array([0.0, 0.0, _WORKING_DEPTH])
    points = (pattern @ R_eye.T + p_eye) @ R_goal.T + p_goal
    measured = "measured" if chosen == "measured" else "believed"
    sensor = ImageTask(truth, camera, points=points, depth=measured)
    constant = settings.depth_factor * sensor.depths(q_goal)
    return ServoScene(
        sensor,
        ImageTask(
            belief, believed, points=points, depth=constant if chosen == "constant" else chosen
        ),
    )


def well_within(sensor: ImageTask, q: Array) -> bool:
    """Whether the points are seen, and not near the edges of the image."""
    x = sensor.value(q).reshape(len(sensor.points), -1)[:, :2]
    size = np.array(_pinhole(sensor).size)
    low, high = _MARGIN * size, (1.0 - _MARGIN) * size
    return bool(((x > low) & (x < high)).all())  # NaN is not


def point_pattern(count: int, spread: float) -> Array:
    """Points of an object: its tip, one beside it, and one off their line; shape (count, 3)."""
    spread = as_number("spread", spread, unit="m", above=0.0)
    if not (isinstance(count, int) and 1 <= count <= 3):
        raise InvalidInputError(f"points must be 1, 2 or 3, got {count!r}", given=count)
    corner = math.sqrt(0.75)
    return spread * np.array([[0, 0, 0], [0, 1, 0], [0.7, 0.5, corner]], dtype=float)[:count]


def arm_reach(robot: Robot) -> float:
    """How far from the world's origin the tip gets, over seeded random postures [m]."""
    rng, kinematics = np.random.default_rng(0), FrameKinematics(robot, robot.tip_or(None))
    tips = [kinematics.position(robot.random_configuration(rng)) for _ in range(200)]
    return float(np.max(np.linalg.norm(tips, axis=1)))


def _believed(camera: PinholeCamera, settings: ServoSettings, back: float) -> PinholeCamera:
    """What is believed of a camera: no distortion, and the errors of the settings."""
    shift = as_array("camera_shift", settings.camera_shift, (3,), "m") - [0.0, 0.0, back]
    roll = as_number("roll", settings.roll, unit="rad")
    tilt = pin.exp3(np.array(as_array("camera_rotation", settings.camera_rotation, (3,), "rad")))
    wrong = camera.with_error(
        shift=shift,
        rotation=pin.log3(pin.exp3(np.array([0.0, 0.0, roll])) @ tilt),
        focal_factor=as_number("focal_factor", settings.focal_factor, above=0.0),
    )
    return PinholeCamera(
        wrong.focal_length, wrong.size, wrong.position, wrong.rotation, center=wrong.center,
        mount=wrong.mount,
    )  # fmt: skip


def _axis(name: str) -> Array:
    """Unit vector of an axis such as "-x"."""
    sign = -1.0 if name.startswith("-") else 1.0
    return np.asarray(sign * np.eye(3)["xyz".index(name[-1])])


def _pinhole(sensor: ImageTask) -> PinholeCamera:
    assert isinstance(sensor.camera, PinholeCamera)  # the scenes above have no other
    return sensor.camera
