"""What the page shows at each instant of a run, worked out from what the run recorded."""

from __future__ import annotations

import numpy as np

from approxjac.robots import Robot
from approxjac.robots.model import own_joints
from approxjac.simulation.scene import Scene
from approxjac.tasks import FrameKinematics
from approxjac.tasks.analysis import features
from approxjac.tasks.feature import Feature
from approxjac.tasks.point_kinematics import PointKinematics
from approxjac.validation import Array
from approxjac.view.tree import joint_positions

AT_LIMIT = 0.01
"""A joint that is within so much of its position limit is at it [rad or m]."""
DISPLAY = {"m": ("mm", 1e3), "rad": ("deg", 180.0 / np.pi)}
"""Units that errors are shown in, and how many of them one of the task's unit is."""
_LITTLE = 1e-6  # of a torque: round-off
_SINGULAR = 1e-6  # of the largest singular value: forces that hardly any torque stands for


def display_unit(unit: str) -> tuple[str, float]:
    """Unit that an error is shown in, and its factor."""
    return DISPLAY.get(unit, (unit, 1.0))


class Frames:
    """Positions, forces and images of a scene.

    Owns scratch memory: one instance a thread.

    Args:
        scene: Who takes part.
        task_units: Units of the error's coordinates, length m; those of the sensor by default.
    """

    def __init__(self, scene: Scene, task_units: tuple[str, ...] | None = None) -> None:
        self.scene = scene
        followed, believed = features(scene.sensor), features(scene.task)
        self._feature = _first(followed)
        self._true = _followed(scene.truth, self._feature)
        self._believed = None
        self._wrenched: FrameKinematics | None = None
        if scene.belief is not None:
            feature = _first(believed) or self._feature
            if feature is not None and feature.frame not in (None, *scene.belief.frame_names):
                feature = None  # of the true robot only
            self._believed = _followed(scene.belief, feature)
            assert self._believed.frame is not None  # what is followed moves with a frame
            self._wrenched = FrameKinematics(scene.belief, self._believed.frame)
        self.image = next((f for f in followed if f.camera is not None), None)
        self.believed_image = next((f for f in believed if f.camera is not None), None)
        self._seen = _seen(scene.truth, self.image)
        self._seen_believed = None
        if scene.belief is not None:
            self._seen_believed = _seen(scene.belief, self.believed_image)
        units = task_units or (() if scene.sensor is None else scene.sensor.units)
        self._scale = np.array([display_unit(unit)[1] for unit in units])
        joints = own_joints(scene.truth.model).values()
        # continuous joints have no limits; their (cos, sin) may go where it likes
        self._limited = [(joint.idx_q, joint.idx_v) for joint in joints if joint.nq == 1]

    @property
    def followed_frame(self) -> str | None:
        """Name of the true robot's frame that is followed, if it is one."""
        return self._true.frame

    def columns(
        self,
        t: Array,
        q: Array,
        x_measured: Array,
        x_d: Array,
        error: Array,
        tau: Array,
        task_torque: Array,
        V: Array,
    ) -> dict[str, Array]:
        """All that the page shows; first axis time, also where there is but one instant.

        Args:
            t: Time, shape (N,) [s].
            q: Configuration of the true robot, shape (N, nq).
            x_measured: Measured task value, NaN where it was lost, shape (N, n_x).
            x_d: Target, shape (N, n_x).
            error: Task error, shape (N, m).
            tau: Torque, shape (N, n_v).
            task_torque: Its part that acts on the task, shape (N, n_v).
            V: Lyapunov function, shape (N,) [J].

        Returns:
            t, V [J]; error in display units (N, m); torque, as a share of its limit (NaN of those
            without one) where any limit is known, else in N m or N (N, n_v); load, |τ|/limit
            (N, n_v); at_limit, 1 of joints at a position limit (N, n_v); joints, all positions
            (N, n_all); tip, believed_tip, measured and target (N, 3) [m], NaN where there is no
            such position; force at the believed tip that the task torque stands for (N, 3) [N].
            Of images: pixels, measured_pixels, believed_pixels and target_pixels (N, k, 2).
        """
        n = len(t)
        limits = self.scene.torque_limits
        share = tau / np.where(np.isfinite(limits), limits, np.nan)
        tip = np.array([self._true.positions(row)[0] for row in q]).reshape(n, 3)
        found = {
            "t": t,
            "V": V,
            "error": error * self._scale if len(self._scale) else error,
            "torque": share if np.isfinite(limits).any() else tau,
            "load": np.abs(share),
            "at_limit": self._at_limit(q),
            "joints": joint_positions(self.scene.truth, q),
            "tip": tip,
            "measured": self._position(x_measured, tip),
            "target": self._position(x_d, tip),
            "believed_tip": np.full((n, 3), np.nan),
            "force": np.full((n, 3), np.nan),
        }
        if self._believed is not None:
            for i, row in enumerate(q):
                r, J = self._believed.jacobians(row)
                found["believed_tip"][i] = r[0]
                if np.isfinite(task_torque[i]).all():
                    found["force"][i] = self._force(row, J[0], task_torque[i])
        return found | self._images(q, x_measured, x_d)

    def _force(self, q: Array, J: Array, task_torque: Array) -> Array:
        """Force at the believed tip that a torque stands for, shape (3,) [N].

        Alone, if a force does; else the force that goes with a moment, as a pose has one.
        """
        force = np.linalg.pinv(J.T, rcond=_SINGULAR) @ task_torque
        if np.linalg.norm(J.T @ force - task_torque) <= _LITTLE * np.linalg.norm(task_torque):
            return np.asarray(force)
        assert self._wrenched is not None  # as the believed tip, whose J this is
        J = self._wrenched.jacobian(q)
        return np.asarray(np.linalg.pinv(J.T, rcond=_SINGULAR) @ task_torque)[:3]

    def _position(self, x: Array, tip: Array) -> Array:
        """Positions that values x (N, n_x) tell, shape (N, 3); on other axes those of the tip."""
        feature = self._feature
        if feature is None or not feature.axes:
            return np.full(tip.shape, np.nan)
        given = x[:, feature.entries][:, : len(feature.axes)]
        found = tip.copy()
        for k, axis in enumerate(feature.axes):
            found[:, "xyz".index(axis)] = given[:, k]
        found[~np.isfinite(given).all(axis=1)] = np.nan
        return found

    def _at_limit(self, q: Array) -> Array:
        lower, upper = self.scene.truth.position_limits
        found = np.zeros((len(q), self.scene.truth.nv))
        for i, k in self._limited:
            found[:, k] = (q[:, i] <= lower[k] + AT_LIMIT) | (q[:, i] >= upper[k] - AT_LIMIT)
        return found

    def _images(self, q: Array, x_measured: Array, x_d: Array) -> dict[str, Array]:
        image, believed = self.image, self.believed_image
        if image is None:
            return {}
        n, k = len(q), len(image.points)
        stride = (image.entries.stop - image.entries.start) // k
        found = {
            "pixels": _projected(image, self._seen, q),
            "measured_pixels": x_measured[:, image.entries].reshape(n, k, stride)[:, :, :2],
            "target_pixels": x_d[:, image.entries].reshape(n, k, stride)[:, :, :2],
        }
        same = believed is not None and len(believed.points) == k
        seen = _projected(believed, self._seen_believed, q) if same else None
        found["believed_pixels"] = np.full((n, k, 2), np.nan) if seen is None else seen
        return found


def _first(followed: tuple[Feature, ...]) -> Feature | None:
    """What of a task is looked at: the first position of it, or else its first image."""
    return next((f for f in followed if f.axes), followed[0] if followed else None)


def _followed(robot: Robot, feature: Feature | None) -> PointKinematics:
    """What is followed, in the world: the first point of the feature's frame."""
    frame, point = None if feature is None else feature.frame, np.zeros((1, 3))
    if feature is not None and frame is not None:
        point = feature.points[:1]
    if frame is None:  # a camera in hand watches the world: what moves is the hand
        camera = None if feature is None else feature.camera
        last = list(robot.model.names)[-1]
        frame = robot.tip or (None if camera is None else camera.mount) or last
    return PointKinematics(robot, point, frame, None)


def _seen(robot: Robot, image: Feature | None) -> PointKinematics | None:
    """Points of an image, as its camera has them before it."""
    if image is None or image.camera is None:
        return None
    return PointKinematics(robot, image.points, image.frame, image.camera.mount)


def _projected(image: Feature | None, points: PointKinematics | None, q: Array) -> Array:
    """Images of the points, shape (N, k, 2), NaN of those that have none."""
    assert image is not None
    assert image.camera is not None
    assert points is not None
    camera = image.camera
    found = np.full((len(q), len(image.points), 2), np.nan)
    for i, row in enumerate(q):
        for k, r in enumerate(points.positions(row)):
            found[i, k] = camera.project(r)
    return found
