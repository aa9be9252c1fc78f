"""The kinematic regressor: positions that are linear in the translations of joint origins."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots.robot import Robot, all_frame_id
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, Immutable, as_array, as_vector, read_only, require

_IN_WORLD = pin.LOCAL_WORLD_ALIGNED
_JACOBIAN_DOT = pin.getFrameJacobianTimeVariation


class PointMotion(NamedTuple):
    """Positions and their derivatives, with θ̂ moving at θ'.

    Attributes:
        p: Positions Y(q)θ + offset, shape (3k,) [m].
        J: ∂p/∂q, shape (3k, n_v).
        J_dot: Its time derivative along q̇ and θ', shape (3k, n_v).
        drift: Y(q)θ', the velocity that θ' adds, shape (3k,) [m/s].
    """

    p: Array
    J: Array
    J_dot: Array
    drift: Array


class KinematicRegressor(Immutable):
    """p(q) = Y(q) θ + offset(q), with θ the translations of joint origins and of the tool.

    For joints 1…n with Rᵢ the rotation of link i and tᵢ the origin of joint i on link i − 1,
    p = Σ Rᵢ₋₁ tᵢ + Rₙ t_tool: Y holds the link rotations, which need correct joint axes. Fixed
    joints before a moving one are part of its origin, those after the last part of the tool.

    Owns scratch memory: one instance a thread; returned arrays are copies.

    Args:
        robot: The robot, true or believed.
        frame: Frame name, or several; the robot's `tip` by default.
        points: Points in the axes of a single frame, shape (k, 3) [m]; by default its origin.

    Attributes:
        k: Number of points.
        movers: Names of the joints that move the points, whose origins come first.
        names: Names of the parameters, such as "panda_joint4.x" or "tool.x"; with several
            frames, the frame's name replaces "tool".
        theta: Their values for `robot`, shape (p,) [m].
        points: Frame of each point, and its position in that frame's axes, shape (3,) [m].
        has_offset: True if `offset` can differ from 0.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Points with several frames, or a frame that no joint moves.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str | Sequence[str] | None = None,
        points: Sequence[Sequence[float]] | Array | None = None,
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        frames = [robot.tip_or(frame)] if frame is None or isinstance(frame, str) else list(frame)
        self.frames = tuple(robot.tip_or(name) for name in frames)
        if points is not None and len(frames) > 1:
            message = f"points must be those of one frame, got frames {self.frames}"
            raise InvalidInputError(message, given=points)
        known = np.zeros((len(frames), 3))
        if points is not None:
            known = as_array("points", points, ("k", 3), "m")
        self.k = len(known)
        of_frame = np.arange(len(frames)) if points is None else np.zeros(self.k, dtype=int)

        # with all joints on their own: Pinocchio's indices of mimic joints are their leaders'
        self._model = model = robot.mimic_joints.model
        placed = [model.frames[all_frame_id(robot, name)] for name in self.frames]
        for name, each in zip(self.frames, placed, strict=True):
            if each.parentJoint == 0:
                message = f"frame must be one that a joint moves, got {name!r} of {robot.name}"
                raise InvalidInputError(message, given=frame)
        paths = [list(model.supports[each.parentJoint])[1:] for each in placed]
        joints = sorted({joint for path in paths for joint in path})
        self._n = n = len(joints)
        self.movers: tuple[str, ...] = tuple(model.names[joint] for joint in joints)
        slides = any(model.joints[each].shortname().startswith("JointModelP") for each in joints)
        self.points = tuple((int(f), point) for f, point in zip(of_frame, known, strict=True))
        rotations = [placed[f].placement.rotation for f in of_frame]
        origins = [model.jointPlacements[joint].translation for joint in joints]
        origins += [each.placement.translation for each in placed]
        self.theta = read_only(np.concatenate(origins))
        self._nothing = np.zeros(self.p)
        self.has_offset = slides or bool(known.any())
        ends = ("tool",) if len(placed) == 1 else self.frames
        self.names = tuple(f"{part}.{axis}" for part in (*self.movers, *ends) for axis in "xyz")

        # A translation is a joint, too, of three axes that slide: then θ are numbers of q, Y and
        # J are columns of one Jacobian, and Pinocchio has the rates of both.
        self._freed, links = pin.Model(), {0: 0}

        def freed(link: int, what: str) -> int:
            kind, here = pin.JointModelTranslation(), pin.SE3.Identity()
            return int(self._freed.addJoint(links[link], kind, here, f"origin of {what}"))

        shifts = []
        for joint, name in zip(joints, self.movers, strict=True):
            shifts.append(freed(model.parents[joint], f"joint {name}"))
            turned = pin.SE3(model.jointPlacements[joint].rotation, np.zeros(3))
            links[joint] = self._freed.addJoint(shifts[-1], model.joints[joint], turned, name)
        ends_at = [
            freed(each.parentJoint, f"frame {name}")
            for name, each in zip(self.frames, placed, strict=True)
        ]
        self._points = [
            self._freed.addFrame(
                pin.Frame(f"point {i}", ends_at[f], pin.SE3(R, R @ point), pin.FrameType.OP_FRAME)
            )
            for i, (f, R, point) in enumerate(zip(of_frame, rotations, known, strict=True))
        ]
        added = [self._freed.joints[i] for i in (*map(links.get, joints), *shifts, *ends_at)]
        places = np.array([each.idx_v + i for each in added for i in range(each.nv)])
        self._of_joints, self._of_theta = np.split(places, [n])
        # where the numbers of that model are in (q, θ) and (q̇, θ') of all joints
        own = [model.joints[joint] for joint in joints]
        at_q = [each.idx_q + i for each in own for i in range(each.nq)]
        at_v = [each.idx_v for each in own]
        order = np.argsort([each.idx_q + i for each in added for i in range(each.nq)])
        self._from_q = np.append(at_q, model.nq + np.arange(self.p))[order]
        self._from_v = np.append(at_v, model.nv + np.arange(self.p))[np.argsort(places)]
        self._columns = robot.mimic_joints.columns(np.eye(model.nv))[at_v]
        self._plain = np.array_equal(self._columns, np.eye(n))

    def __repr__(self) -> str:
        where = self.frames[0] if len(self.frames) == 1 else list(self.frames)
        return f"KinematicRegressor({self.robot.name!r}, {where!r}: {self.p} parameters)"

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.theta)

    def Y(self, q: Array) -> Array:
        """Return Y(q), shape (3k, p)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.points(self).Y())
        pin.computeJointJacobians(self._freed, self._data, self._all(q, self._nothing))
        return self._jacobians(pin.getFrameJacobian).take(self._of_theta, 1)

    def offset(self, q: Array) -> Array:
        """Return p − Y(q)θ, shape (3k,) [m]: prismatic travel and points off the frame's origin."""
        if not self.has_offset:
            return np.zeros(3 * self.k)
        return self.position(q, self._nothing)

    def position(self, q: Array, theta: Array) -> Array:
        """Return p = Y(q)θ + offset(q), shape (3k,) [m], of parameters θ (p,)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.points(self).motion(None, theta, None).p)
        pin.forwardKinematics(self._freed, self._data, self._all(q, theta))
        return self._positions()

    def motion(self, q: Array, v: Array, theta: Array, theta_dot: Array) -> PointMotion:
        """Return positions and derivatives at q (nq,), q̇ (n_v,), θ (p,) [m] and θ' (p,) [m/s]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return arm.points(self).motion(v, theta, theta_dot)
        speeds = self.robot.mimic_joints.v(as_vector("v", v, self.robot.nv))
        rates = np.concatenate([speeds, theta_dot]).take(self._from_v)
        pin.computeJointJacobiansTimeVariation(self._freed, self._data, self._all(q, theta), rates)
        p = self._positions()
        J, J_dot = self._jacobians(pin.getFrameJacobian), self._jacobians(_JACOBIAN_DOT)
        drift = J.take(self._of_theta, 1).dot(theta_dot)
        return PointMotion(p, self._along_joints(J), self._along_joints(J_dot), drift)

    def robot_with(self, theta: Array, turn: Array | None = None) -> Robot:
        """Return the robot with other translations θ (p,) [m] and its tool rotated by `turn`.

        A tool on a fixed joint of its own is moved. If the frame is a moving link, that gets an
        object without mass, whose end is the new `tip`. The turn is a rotation vector of the tool
        in its own axes, shape (3,) [rad].
        """
        theta = as_array("theta", theta, (self.p,), "m")
        change = (theta - self.theta).reshape(-1, 3)
        above = {joint.child: joint for joint in self.robot.tree.joints.values()}
        wanted: dict[str, Array] = dict(zip(self.movers, change[: self._n], strict=True))
        held: dict[str, Array] = {}
        links = [self.robot.tree.link_of(frame) for frame in self.frames]
        for link, tool in zip(links, change[self._n :], strict=True):
            if above[link].type == "fixed":
                wanted[above[link].name] = tool
            elif tool.any() or turn is not None:
                held[link] = tool
        moved: dict[str, Array] = {}  # in the axes of the link that moves
        shifts: dict[str, list[float]] = {}
        # those that carry others first
        for joint in sorted(wanted, key=partial(all_frame_id, self.robot)):
            parent = link = self.robot.tree.joints[joint].parent
            moved[joint] = wanted[joint]
            while link in above and above[link].type == "fixed":  # what carries it was moved, too
                moved[joint] = moved[joint] - moved.get(above[link].name, 0.0)
                link = above[link].parent
            if moved[joint].any():
                placed = self._model.frames[all_frame_id(self.robot, parent)].placement
                shifts[joint] = list(placed.rotation.T @ moved[joint])
        robot = self.robot.with_kinematic_error(shifts) if shifts else self.robot
        for link, tool in held.items():
            name = "tool" if len(held) == 1 else f"{link}_tool"
            length = float(np.linalg.norm(tool))
            axis = list(tool) if length > 0.0 else "x"
            robot = robot.with_object(length, parent=link, axis=axis, name=name)
        if turn is None:
            return robot
        joint = "tool_tip_joint" if held else above[links[0]].name
        return robot.with_kinematic_error(None, {joint: turn.tolist()})

    @cached_property
    def _data(self) -> pin.Data:
        return self._freed.createData()

    def _all(self, q: Array, theta: Array) -> Array:
        """Return q and θ as the model with translations as joints has them."""
        q = self.robot.mimic_joints.q(self.robot.configuration(q))
        return np.concatenate([q, theta]).take(self._from_q)

    def _positions(self) -> Array:
        update, (model, data) = pin.updateFramePlacement, (self._freed, self._data)
        return np.concatenate([update(model, data, point).translation for point in self._points])

    def _jacobians(self, of_point: Callable[..., Array]) -> Array:
        """Return a Jacobian of all points in the world's axes, (3k, n + p)."""
        model, data = self._freed, self._data
        each = [of_point(model, data, point, _IN_WORLD)[:3] for point in self._points]
        return each[0] if len(each) == 1 else np.concatenate(each)

    def _along_joints(self, J: Array) -> Array:
        J = J.take(self._of_joints, 1)
        return J if self._plain else np.asarray(J.dot(self._columns))
