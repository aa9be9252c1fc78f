"""Kinematics of a robot's frame, and tasks of its position or pose, also in a tracker's axes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Self

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.robots import Robot
from approxjac.robots.robot import all_frame_id
from approxjac.robots.traced import arm_of
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array, Immutable, as_array, as_vector, axis_rows, require

_LWA = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
# a @ _CROSS is [a]ₓ, row by row
_CROSS = np.array([
    [0, 0, 0, 0, 0, -1, 0, 1, 0],
    [0, 0, 1, 0, 0, 0, -1, 0, 0],
    [0, -1, 0, 1, 0, 0, 0, 0, 0],
], dtype=float)  # fmt: skip


class FrameKinematics(Immutable):
    """Forward kinematics of one frame.

    Owns scratch memory: one instance per thread; returned arrays are copies except `motion`'s.

    Args:
        robot: The robot, true or believed.
        frame: Frame name; an UnknownNameError if there is none.
    """

    def __init__(self, robot: Robot, frame: str) -> None:
        self.robot = robot
        self.frame = frame
        self._id = robot.frame_id(frame)
        self._model = robot.model
        # Pinocchio's J̇ is wrong with mimic joints: it is computed with all joints on their own
        self._all = robot.mimic_joints.model

    # Scratch memory is made when it is first needed: of truths that are drawn, many never need it.

    @cached_property
    def _data(self) -> pin.Data:
        return self._model.createData()

    @cached_property
    def _placed(self) -> tuple[Array, Array]:
        # live views, as to read them costs as much as to compute them
        placement = self._data.oMf[self._id]
        return placement.rotation, placement.translation

    @cached_property
    def _all_data(self) -> pin.Data:
        return self._data if self._all is self._model else self._all.createData()

    def position(self, q: Array) -> Array:
        """Return the position of the frame's origin in the world, shape (3,) [m]."""
        if type(q) is not np.ndarray:  # it may be of symbols
            return self.placement(q)[1]
        self._placement(q)
        return self._placed[1].copy()

    def placement(self, q: Array) -> tuple[Array, Array]:
        """Return the rotation (3, 3) of the frame's axes in the world's, and `position`."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return arm.frame(self.frame)
        M = self._placement(q)
        return np.array(M.rotation), np.array(M.translation)

    def pose(self, q: Array) -> Array:
        """Return position [m] and unit quaternion (x, y, z, w) in the world, shape (7,)."""
        if type(q) is not np.ndarray and arm_of(self.robot, q) is not None:
            R, p = self.placement(q)
            return np.concatenate([p, law.quaternion(R)])
        return np.array(pin.SE3ToXYZQUAT(self._placement(q)))

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian of (velocity, angular velocity), LOCAL_WORLD_ALIGNED, (6, n_v)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.jacobian(self.frame))
        q = self.robot.configuration(q)
        J: Array = pin.computeFrameJacobian(self._model, self._data, q, self._id, _LWA)
        return J if J.ndim == 2 else J.reshape(6, 1)  # of one joint it is flat

    def motion(self, q: Array) -> tuple[Array, Array, Array]:
        """Return `jacobian`, and the frame's rotation (3, 3) and position (3,) at the same q.

        Rotation and position are scratch memory: use them before the next call, do not keep them.
        """
        if type(q) is not np.ndarray and arm_of(self.robot, q) is not None:
            return self.jacobian(q), *self.placement(q)
        J = self.jacobian(q)  # places the frame, too
        return J, *self._placed

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """Return the time derivative of `jacobian` along q̇, shape (6, n_v)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.jacobian_dot(self.frame, v))
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        mimic_joints, frame = self.robot.mimic_joints, all_frame_id(self.robot, self.frame)
        pin.computeJointJacobiansTimeVariation(
            self._all, self._all_data, mimic_joints.q(q), mimic_joints.v(v)
        )
        pin.updateFramePlacement(self._all, self._all_data, frame)
        J_dot: Array = pin.getFrameJacobianTimeVariation(self._all, self._all_data, frame, _LWA)
        return mimic_joints.columns(J_dot.reshape(6, -1))

    def _placement(self, q: Array) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, self.robot.configuration(q))
        return pin.updateFramePlacement(self._model, self._data, self._id)


class PointKinematics:
    """Points (k, 3) [m] of one frame as seen from another one, the mount; None is the world.

    Owns scratch memory: one instance per thread.
    """

    def __init__(self, robot: Robot, points: Array, frame: str | None, mount: str | None) -> None:
        self.robot, self.points = robot, points
        self.frame, self.mount = frame, mount
        self._frame = None if frame is None else FrameKinematics(robot, frame)
        self._mount = None if mount is None else FrameKinematics(robot, mount)
        self._at_origin = len(points) == 1 and not points.any()

    def positions(self, q: Array) -> Array:
        """Return the positions of the points, shape (k, 3) [m]."""
        p = self.points
        if self._frame is not None:
            R, o = self._frame.placement(q)
            p = p @ R.T + o
        if self._mount is not None:
            R, o = self._mount.placement(q)
            p = (p - o) @ R
        return p

    def jacobians(self, q: Array, at: Array | None = None) -> tuple[Array, Array]:
        """Return positions r (k, 3), `at` where that is finite, and ∂r/∂q there (k, 3, n_v)."""
        p, moved = self._in_world(q)
        if self._mount is None:
            return _chosen(p, at), moved
        J, R, o = self._mount.motion(q)
        r = _chosen((p - o) @ R, at)
        return r, R.T @ (moved - J[:3]) + _skews(r) @ (R.T @ J[3:])

    def _in_world(self, q: Array) -> tuple[Array, Array]:
        """Return positions (k, 3) of the points in the world, and their Jacobians (k, 3, n_v)."""
        if self._frame is None:
            return self.points, np.zeros((len(self.points), 3, self.robot.nv))
        J, R, o = self._frame.motion(q)
        if self._at_origin:
            return o[np.newaxis].copy(), J[np.newaxis, :3]
        arms = self.points @ R.T
        return arms + o, J[:3] - _skews(arms) @ J[3:]


def _chosen(r: Array, at: Array | None) -> Array:
    return r if at is None else np.where(np.isfinite(at), at, r)


def _skews(vectors: Array) -> Array:
    """Return the matrices [a]ₓ with [a]ₓ b = a × b for each row a, shape (k, 3, 3)."""
    return np.asanyarray((vectors @ _CROSS).reshape(-1, 3, 3))


_STILL = 1e-4  # share of the fastest axis below which nothing moves along it (URDFs are rounded)
_NOWHERE = (0.0, 0.0, 0.0)


class _FrameTask(Task):
    """A task of the origin of a frame, or of its pose."""

    def __init__(
        self,
        robot: Robot,
        frame: str | None = None,
        labels: Sequence[str] = ("x", "y", "z"),
        units: Sequence[str] = ("m", "m", "m"),
        n_x: int | None = None,
    ) -> None:
        super().__init__(robot, labels, units, n_x)
        self.frame = robot.tip_or(frame)
        self._frame = FrameKinematics(robot, self.frame)
        self.features = (Feature(slice(0, self.n_x), self.frame, "".join(labels[:3])),)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._of_error(self._frame.jacobian(q))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return self._of_error(self._frame.jacobian_dot(q, v))

    def _of_error(self, J: Array) -> Array:
        return J


class PositionTask(_FrameTask):
    """X = position of a frame's origin along world axes [m].

    Args:
        robot: The robot, true or believed.
        frame: Frame name; the robot's `tip` by default.
        axes: World axes in the order of X, such as "xyz" or "xz"; by default all three, or for a
            planar arm or one with fewer joints those of `best_axes`.

    Raises:
        UnknownNameError: No such frame, or an axis that is not x, y or z.
        InvalidInputError: No or repeated axes, or more of them than joints.
    """

    _kind = "position"

    def __init__(self, robot: Robot, frame: str | None = None, axes: str | None = None) -> None:
        require("robot", robot, Robot, "a Robot")
        self.axes = best_axes(robot, frame) if axes is None else axes
        rows = axis_rows("axes", self.axes)
        # at equal distances as a slice, which NumPy takes without a copy
        evenly = slice(rows[0], rows[-1] + 1, max(1, (rows[-1] - rows[0]) // max(1, len(rows) - 1)))
        self._rows = evenly if list(range(3))[evenly] == rows else rows
        super().__init__(robot, frame, tuple(self.axes), ("m",) * len(self.axes))

    def value(self, q: Array) -> Array:
        return self._frame.position(q)[self._rows]

    def _of_error(self, J: Array) -> Array:
        return J[self._rows]

    def on(self, robot: Robot) -> PositionTask:
        return PositionTask(robot, self.frame, self.axes)

    def __repr__(self) -> str:
        return f"PositionTask({self.robot.name!r}, {self.frame!r}, {self.axes!r})"


def best_axes(robot: Robot, frame: str | None = None) -> str:
    """Return the world axes along which an arm can move a frame (its `tip` by default).

    "xyz" without axes along which no joint moves the frame; for an arm with fewer joints, those
    along which the frame moves fastest, in the mean over seeded configurations.
    """
    kinematics = FrameKinematics(robot, robot.tip_or(frame))
    jacobians = np.array([kinematics.jacobian(q)[:3] for q in robot.configurations(20)])
    speeds = np.linalg.norm(jacobians, axis=2).sum(axis=0)
    moving = int((speeds > _STILL * speeds.max()).sum()) or 3
    return "".join("xyz"[i] for i in sorted(np.argsort(-speeds)[: min(moving, robot.nv)]))


class PoseTask(_FrameTask):
    """X = position [m] and orientation of a frame in the world; m = 6.

    A value is (x, y, z) and a quaternion (x, y, z, w), shape (7,), as from `pin.SE3ToXYZQUAT`;
    the quaternion's length and sign do not matter. The error is (p − p_d, φ), with the rotation
    vector φ = log(R R_dᵀ) in world axes [rad], below 180°.

    The Jacobian is the geometric one, for which d/dt ½‖φ‖² = φᵀω: the stability proof holds if
    the three rotational gains are equal and s(φ) = φ.

    Args:
        robot: The robot, true or believed.
        frame: Frame name; the robot's `tip` by default.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Fewer than six joints.
    """

    _kind = "pose"

    def __init__(self, robot: Robot, frame: str | None = None) -> None:
        labels = ("x", "y", "z", "rx", "ry", "rz")
        super().__init__(robot, frame, labels, ("m",) * 3 + ("rad",) * 3, 7)
        vars(self).update(origin=np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))  # no rotation

    def value(self, q: Array) -> Array:
        return self._frame.pose(q)

    def error(self, x: Array, x_d: Array) -> Array:
        px, py, pz, *quaternion = x.tolist()
        dx, dy, dz, *target = x_d.tolist()
        turn = law.rotation_between(quaternion, target)
        return np.asanyarray(law.array([px - dx, py - dy, pz - dz, *turn]))

    def displaced(self, x: Array, e: Array) -> Array:
        turned = law.turned(x[3:].tolist(), e[3:].tolist())
        return np.concatenate([x[:3] + e[:3], law.array(turned)])

    def on(self, robot: Robot) -> PoseTask:
        return PoseTask(robot, self.frame)

    def error_jacobian(self, e: Array, J: Array) -> Array:
        rates = pin.Jlog3(pin.exp3(e[3:])).T  # φ̇ = rates ω, as ω is in world axes
        return np.concatenate([J[:3], rates @ J[3:]])

    def __repr__(self) -> str:
        return f"PoseTask({self.robot.name!r}, {self.frame!r})"


class _Tracked(_FrameTask):
    """A task of a frame in the axes of a tracker, R p + b of a position p in the world."""

    def __init__(
        self,
        robot: Robot,
        rotation: Sequence[float] | Array = _NOWHERE,
        offset: Sequence[float] | Array = _NOWHERE,
        frame: str | None = None,
    ) -> None:
        super().__init__(robot, frame)
        self.rotation = as_array("rotation", rotation, (3,), "rad")
        self.offset = as_array("offset", offset, (3,), "m")
        self._R: Array = pin.exp3(self.rotation)
        (feature,) = self.features
        vars(self).update(features=(feature._replace(placed=(self._R, self.offset)),))

    def value(self, q: Array) -> Array:
        return self._R @ self._frame.position(q) + self.offset

    def _of_error(self, J: Array) -> Array:
        return np.concatenate([self._R @ J[k : k + 3] for k in range(0, self.m, 3)])

    def on(self, robot: Robot) -> Self:
        return type(self)(robot, self.rotation, self.offset, self.frame)

    def __repr__(self) -> str:
        rotation, offset = self.rotation.tolist(), self.offset.tolist()
        return f"{type(self).__name__}({self.robot.name!r}, {self.frame!r}, {rotation}, {offset})"


class TrackerTask(_Tracked):
    """X = R p + b: position p of a frame's origin in the axes of a tracker [m].

    Targets are in its axes, too. A controller that does not know the tracker's pose uses a
    `PositionTask` in its place.

    Args:
        robot: The robot, true or believed.
        rotation: R, from the axes of the world to those of the tracker, as a rotation vector,
            shape (3,) [rad].
        offset: b, the origin of the world in the axes of the tracker, shape (3,) [m].
        frame: Frame name; the robot's `tip` by default.
    """

    _kind = "tracker"


class PoseTrackerTask(_Tracked, PoseTask):
    """X = (R p + b, R R_f): the pose of a frame in the axes of a tracker; m = 6.

    Otherwise a `PoseTask`, which a controller that does not know the tracker's pose uses in its
    place. Arguments and errors are those of `TrackerTask`; fewer than six joints are an error.
    """

    _kind = "pose tracker"

    def value(self, q: Array) -> Array:
        R, p = self._frame.placement(q)
        return np.concatenate([self._R @ p + self.offset, law.quaternion(self._R @ R)])
