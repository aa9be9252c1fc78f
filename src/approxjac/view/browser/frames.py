"""`RunFrames`: the quantities that the page shows at each instant of a run."""

from itertools import pairwise
from typing import Any

import numpy as np

from approxjac.formatting import display_unit
from approxjac.robots import Robot
from approxjac.simulation import Trajectory
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import FrameKinematics, Task
from approxjac.tasks.analysis import image_feature
from approxjac.tasks.frame_tasks import PointKinematics
from approxjac.tasks.task import Feature
from approxjac.validation import Array
from approxjac.view.tree import followed, joint_positions, learnt_tips

_AT_LIMIT = 0.01  # a joint that is within so much of its position limit is at it [rad or m]
_LITTLE = 1e-6  # of a torque: round-off
_SINGULAR = 1e-6  # of the largest singular value: forces that hardly any torque stands for


class RunFrames:
    """Positions, forces and images of a scene; one instance per thread."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._feature = followed(scene.sensor)
        self._true = _followed(scene.truth, self._feature)
        self._believed: PointKinematics | None = None
        if scene.belief is not None:
            feature = followed(scene.task) or self._feature
            if feature is not None and feature.frame not in (None, *scene.belief.frame_names):
                feature = None  # of the true robot only
            self._believed = _followed(scene.belief, feature)

    def columns(self, run: Trajectory, kept: Any = None) -> dict[str, Array]:
        """Return the quantities that the page shows, first axis time.

        Args:
            run: A run of the scene.
            kept: Indices of the instants to show, shape (N,); all by default. Torques and commands
                are the largest since the instant kept before.

        Returns:
            t, V [J]; error in display units (N, m); torque, as a share of its limit (NaN without
            one) if any limit is known, else in N m or N (N, n_v); command, where it is of joint
            velocities (N, n_v) [rad/s or m/s]; load, |τ|/limit (N, n_v);
            at_limit, 1 for joints at a position limit (N, n_v); joints, all positions (N, n_all);
            tip, believed_tip (the learnt one, if it is learnt), measured and target (N, 3) [m],
            NaN where there is no such position; force at the believed tip that corresponds to
            the task torque (N, 3) [N].
            Of images: pixels, measured_pixels, believed_pixels and target_pixels (N, k, 2).
        """
        kept = np.arange(len(run.t)) if kept is None else kept
        q, x_measured, x_d = run.q[kept], run.x_measured[kept], run.x_d[kept]
        error, tau, limits = run.error[kept], _peaks(run.tau, kept), self.scene.torque_limits
        share = tau / np.where(np.isfinite(limits), limits, np.nan)
        tip = np.array([self._true.positions(row)[0] for row in q]).reshape(-1, 3)
        believed_tip, force = self._believed_tip(q, run.at("task_torque", kept))
        learnt = learnt_tips(self.scene, q, run.learnt[kept])
        columns = {
            "t": run.t[kept],
            "V": run.at("V", kept),
            "error": error * [display_unit(unit)[1] for unit in run.task_units],
            "torque": share if np.isfinite(limits).any() else tau,
            "load": np.abs(share),
            "at_limit": np.where(self.scene.truth.beyond_limits(q) >= -_AT_LIMIT, 1.0, 0.0),
            "joints": joint_positions(self.scene.truth, q),
            "tip": tip,
            "measured": self._position(x_measured, tip),
            "target": self._position(x_d, tip),
            "believed_tip": believed_tip if learnt is None else learnt,
            "force": force,
        }
        if run.command_kind != "torque":
            columns["command"] = _peaks(run.command, kept)
        return columns | self._images(q, x_measured, x_d)

    def _believed_tip(self, q: Array, task_torque: Array) -> tuple[Array, Array]:
        """Return the believed tip and the force there that equals a torque, (N, 3) each."""
        tip, force = np.full((len(q), 3), np.nan), np.full((len(q), 3), np.nan)
        if self._believed is None:
            return tip, force
        assert self._believed.frame is not None  # what is followed moves with a frame
        whole = FrameKinematics(self._believed.robot, self._believed.frame)
        for i, (row, torque) in enumerate(zip(q, task_torque, strict=True)):
            r, J = self._believed.jacobians(row)
            tip[i] = r[0]
            if np.isfinite(torque).all():
                force[i] = _wrench(J[0], torque)
                left = np.linalg.norm(J[0].T @ force[i] - torque)
                if left > _LITTLE * np.linalg.norm(torque):  # there is a moment too, as of a pose
                    force[i] = _wrench(whole.jacobian(row), torque)[:3]
        return tip, force

    def _position(self, x: Array, tip: Array) -> Array:
        """Return positions that x (N, n_x) gives, (N, 3); on other axes those of the tip."""
        feature = self._feature
        if feature is None or not feature.axes:
            return np.full(tip.shape, np.nan)
        given, place = feature.place(x), tip.copy()
        place[:, ["xyz".index(axis) for axis in feature.axes]] = given
        place[~np.isfinite(given).all(axis=1)] = np.nan
        return place

    def _images(self, q: Array, x_measured: Array, x_d: Array) -> dict[str, Array]:
        image, believed = image_feature(self.scene.sensor), image_feature(self.scene.task)
        if image is None:
            return {}
        images = {
            "pixels": image.images(_values(self.scene.sensor, q)),
            "measured_pixels": image.images(x_measured),
            "target_pixels": image.images(x_d),
        }
        images["believed_pixels"] = np.full_like(images["pixels"], np.nan)
        if believed is not None and len(believed.points) == len(image.points):
            images["believed_pixels"] = believed.images(_values(self.scene.task, q))
        return images


def _peaks(commands: Array, kept: Any) -> Array:
    """Return each joint's largest command since the instant kept before, by size, (n, n_v)."""
    peaks = commands[kept]
    for i, (first, last) in enumerate(pairwise(kept), start=1):
        part = commands[first + 1 : last + 1]
        peaks[i] = part[np.abs(part).argmax(axis=0), np.arange(commands.shape[1])]
    return np.asarray(peaks)


def _followed(robot: Robot, feature: Feature | None) -> PointKinematics:
    """Return the followed point in the world: the first point of the feature's frame."""
    if feature is not None and feature.frame is not None:
        return PointKinematics(robot, feature.points[:1], feature.frame, None)
    # a camera in hand watches the world: what moves is the hand
    mount = None if feature is None or feature.camera is None else feature.camera.mount
    frame = robot.tip or mount or list(robot.model.names)[-1]
    return PointKinematics(robot, np.zeros((1, 3)), frame, None)


def _wrench(J: Array, torque: Array) -> Array:
    """Return the force, and the moment if J has rows for it, that a torque stands for."""
    return np.asarray(np.linalg.pinv(J.T, rcond=_SINGULAR) @ torque)


def _values(task: Task | None, q: Array) -> Array:
    assert task is not None  # it has an image
    return np.array([task.value(row) for row in q]).reshape(len(q), task.n_x)
