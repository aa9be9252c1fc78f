"""The kinematic regressor: positions by joint origins, axes and encoders that may be wrong."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.files import read_arrays, refusing, replaced
from approxjac.robots.perturbation import rotations_of
from approxjac.robots.robot import MimicJoints, Robot, all_frame_id
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, Immutable, as_array, as_vector, read_only, require

_IN_WORLD, _UPRIGHT = pin.LOCAL_WORLD_ALIGNED, np.eye(3)
_ANGLES = "tilt1", "tilt2", "encoder"
_FARTHEST = {"m": 0.1, "rad": 0.3}  # that a number of a joint is from another drawing of the arm


class PointMotion(NamedTuple):
    """Positions and their derivatives, with θ̂ moving at θ'.

    Attributes:
        p: Positions, shape (3k,) [m].
        J: ∂p/∂q, shape (3k, n_v).
        J_dot: Its time derivative along q̇ and θ', shape (3k, n_v).
        drift: Yθ', the velocity that θ' adds, shape (3k,) [m/s].
    """

    p: Array
    J: Array
    J_dot: Array
    drift: Array


class TurnMotion(NamedTuple):
    """Orientation of a frame and its derivatives, with θ moving at θ'.

    Attributes:
        R: The frame's axes in the base's, shape (3, 3).
        J: Angular velocity in the base's axes by q̇, shape (3, n_v).
        J_dot: Its time derivative along q̇ and θ', shape (3, n_v).
        A: Angular velocity by θ', shape (3, p).
    """

    R: Array
    J: Array
    J_dot: Array
    A: Array


class _Freed:
    """An arm of which only the joints are known, as code on symbols takes robots."""

    def __init__(self, name: str, model: pin.Model) -> None:
        self.name, self.model, self.nv = name, model, model.nv
        self.mimic_joints, self.frame_id = MimicJoints(model), model.getFrameId


class KinematicRegressor(Immutable):
    """p(q, θ), with θ the errors of a drawing: joint origins, tool, and axes and encoders if asked.

    θ are the translations tᵢ of joint origins on the links before them and of the tool. With
    `axes` they are followed by three angles of each joint that turns: its axis is tilted by α₁
    and α₂ about two directions across it, and its encoder is off by δ. With R⁰ᵢ the rotation of
    a joint's origin,

        placement = T(tᵢ) R⁰ᵢ exp(α₁[e₁]ₓ) exp(α₂[e₂]ₓ) joint(qᵢ + δᵢ)

    Without axes p is linear in θ. Fixed joints before a moving one are part of its origin, those
    after the last part of the tool.

    Owns scratch memory: one instance per thread; returned arrays are copies.

    Args:
        robot: The robot, true or believed.
        frame: Frame name, or several; the robot's `tip` by default.
        points: Points in the axes of a single frame, shape (k, 3) [m]; by default its origin.
        axes: True for tilts and encoders as well.

    Attributes:
        k: Number of points.
        movers: Names of the joints that move the points, whose origins come first.
        turners: Those of them that turn, if their axes are among θ.
        across: e₁, e₂ and the axis of each of these, in the joint's own axes, shape (3,) each.
        rotations: R⁰ of each of these, shape (k, 3, 3).
        n_lengths: Number of translations, which come first.
        names: Names of the parameters, such as "panda_joint4.x" or "tool.x"; with several
            frames, the frame's name replaces "tool"; then "panda_joint4.tilt1", ".tilt2" and
            ".encoder".
        units: Their units, "m" or "rad".
        theta: Their values for `robot`, shape (p,).
        points: Frame of each point, and its position in that frame's axes, shape (3,) [m].

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Points with several frames, or a frame that no joint moves.
    """

    def __init__(
        self,
        robot: Robot,
        frame: str | Sequence[str] | None = None,
        points: Sequence[Sequence[float]] | Array | None = None,
        axes: bool = False,
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
        self.points = tuple((int(f), point) for f, point in zip(of_frame, known, strict=True))
        rotations = [placed[f].placement.rotation for f in of_frame]
        origins = [model.jointPlacements[joint].translation for joint in joints]
        origins += [each.placement.translation for each in placed]
        ends = ("tool",) if len(placed) == 1 else self.frames
        self.n_lengths = 3 * (n + len(placed))
        turning = [name for name in self.movers if robot.tree.joints[name].type != "prismatic"]
        self.turners: tuple[str, ...] = tuple(turning) if axes else ()
        turns = [f"{name}.{angle}" for name in self.turners for angle in _ANGLES]
        names = [f"{part}.{axis}" for part in (*self.movers, *ends) for axis in "xyz"]
        self.names = (*names, *turns)
        self.units = ("m",) * self.n_lengths + ("rad",) * len(turns)
        self.theta = read_only(np.concatenate([*origins, np.zeros(len(turns))]))
        turned = [model.jointPlacements[model.getJointId(name)] for name in self.turners]
        self.rotations = np.array([each.rotation for each in turned]).reshape(-1, 3, 3)

        # Translations are joints that slide, too, tilts and encoders ones that turn: then θ are
        # numbers of q, Y and J are columns of one Jacobian, and Pinocchio, or code on symbols, has
        # the rates of both.
        whole, links, shifts, angles = pin.Model(), {0: 0}, list[int](), list[int]()
        slides = pin.JointModelPX(), pin.JointModelPY(), pin.JointModelPZ()

        def chained(link: int, kinds: Iterable[Any], what: str, R: Array = _UPRIGHT) -> list[int]:
            """Return joints one after the other, of which the first is turned by R on a link."""
            added = [link]
            for i, kind in enumerate(kinds):
                placed = pin.SE3(_UPRIGHT if i else R, np.zeros(3))
                added.append(int(whole.addJoint(added[-1], kind, placed, f"{what} {i}")))
            return added[1:]

        self.across = [across(robot.tree.joints[name].axis) for name in self.turners]
        ways = dict(zip(self.turners, self.across, strict=True))
        for joint, name in zip(joints, self.movers, strict=True):
            shifts += chained(links[model.parents[joint]], slides, f"origin of {name}")
            kinds = *map(pin.JointModelRevoluteUnaligned, ways.get(name, ())), model.joints[joint]
            R = model.jointPlacements[joint].rotation
            *turning_by, links[joint] = chained(shifts[-1], kinds, name, R)
            angles += turning_by
        ends_at = [
            chained(links[each.parentJoint], slides, f"origin of frame {name}")
            for name, each in zip(self.frames, placed, strict=True)
        ]
        self._points = [
            whole.addFrame(
                pin.Frame(f"{i}", ends_at[f][-1], pin.SE3(R, R @ point), pin.FrameType.OP_FRAME)
            )
            for i, (f, R, point) in enumerate(zip(of_frame, rotations, known, strict=True))
        ]
        self._freed = _Freed(robot.name, whole)
        order = (*map(links.__getitem__, joints), *shifts, *chain(*ends_at), *angles)
        added = [whole.joints[i] for i in order]
        places = np.array([each.idx_v for each in added])
        self._of_joints, self._of_theta = np.split(places, [n])
        # where the numbers of that model are in (q, θ) and (q̇, θ') of all joints
        own, of_theta = [model.joints[joint] for joint in joints], np.arange(self.p)
        at_q = [each.idx_q + i for each in own for i in range(each.nq)]
        at_v = [each.idx_v for each in own]
        by_q = np.argsort([each.idx_q + i for each in added for i in range(each.nq)])
        self._from_q = np.append(at_q, model.nq + of_theta)[by_q]
        self._from_v = np.append(at_v, model.nv + of_theta)[np.argsort(places)]
        self._columns = robot.mimic_joints.columns(np.eye(model.nv))[at_v]
        self._plain = np.array_equal(self._columns, np.eye(n))

    def __repr__(self) -> str:
        where = self.frames[0] if len(self.frames) == 1 else list(self.frames)
        return f"KinematicRegressor({self.robot.name!r}, {where!r}: {self.p} parameters)"

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.theta)

    def linear(self, q: Array, theta: Array) -> tuple[Array, Array]:
        """Return Y = ∂p/∂θ, shape (3k, p), and o = p − Yθ, shape (3k,) [m], at q and θ (p,).

        Without axes neither depends on θ.
        """
        arm = self._placed(q, theta)
        p, Y = self._positions(arm), self._jacobians(arm).take(self._of_theta, 1)
        return Y, p - Y.dot(theta)

    def position(self, q: Array, theta: Array) -> Array:
        """Return p of parameters θ (p,), shape (3k,) [m]."""
        return self._positions(self._placed(q, theta))

    def motion(self, q: Array, v: Array, theta: Array, theta_dot: Array) -> PointMotion:
        """Return positions and derivatives at q (nq,), q̇ (n_v,), θ (p,) and θ' (p,) [1/s]."""
        rates = self._rates(v, theta_dot)
        arm = self._placed(q, theta, rates)
        J, J_dot = self._jacobians(arm), self._jacobians(arm, rates)
        p, drift = self._positions(arm), J.take(self._of_theta, 1).dot(theta_dot)
        return PointMotion(p, self._along_joints(J), self._along_joints(J_dot), drift)

    def turn(self, q: Array, v: Array, theta: Array, theta_dot: Array) -> TurnMotion:
        """Return the first frame's orientation and derivatives; arguments are those of `motion`."""
        rates = self._rates(v, theta_dot)
        arm = self._placed(q, theta, rates)
        J, J_dot = self._jacobian(arm, 0)[3:], self._jacobian(arm, 0, rates)[3:]
        R, A = self._frame(arm, 0)[0].copy(), J.take(self._of_theta, 1)
        return TurnMotion(R, self._along_joints(J), self._along_joints(J_dot), A)

    def robot_with(self, theta: Array, turn: Array | None = None) -> Robot:
        """Return the robot with other parameters θ (p,), and its tool rotated by `turn`.

        A tool on a fixed joint of its own is moved. If the frame is a moving link, that gets an
        object without mass, whose end is the new `tip`. The turn is a rotation vector of the tool
        in its own axes, shape (3,) [rad].
        """
        robot, (shifts, rotations, held) = self.robot, self.errors(theta)
        held = {link: tool for link, tool in held.items() if tool.any() or turn is not None}
        if shifts or rotations:
            robot = robot.with_kinematic_error(shifts, rotations)
        for link, tool in held.items():
            name = "tool" if len(held) == 1 else f"{link}_tool"
            length = float(np.linalg.norm(tool))
            axis = list(tool) if length > 0.0 else "x"
            robot = robot.with_object(length, parent=link, axis=axis, name=name)
        if turn is None:
            return robot
        link, joints = self.robot.tree.link_of(self.frames[0]), self.robot.tree.joints
        above = next(name for name, each in joints.items() if each.child == link)
        joint = "tool_tip_joint" if held else above
        return robot.with_kinematic_error(None, {joint: turn.tolist()})

    def errors(self, theta: Array) -> tuple[dict[str, Any], dict[str, Any], dict[str, Array]]:
        """Return shifts [m] and rotations [rad] of joints by θ (p,), and tools [m] without one."""
        theta = as_array("theta", theta, (self.p,), "m or rad")
        shifts, turns, held = self.origins(theta[np.newaxis])
        return (
            {joint: by[0].tolist() for joint, by in shifts.items()},
            {joint: pin.log3(by[0]).tolist() for joint, by in turns.items()},
            {link: tool[0] for link, tool in held.items()},
        )

    def origins(self, theta: Array) -> tuple[dict[str, Array], dict[str, Array], dict[str, Array]]:
        """Return `errors` of θ (N, p): (N, 3) each, but rotations as (N, 3, 3)."""
        change = (theta - self.theta)[:, : self.n_lengths].reshape(len(theta), -1, 3)
        change = np.moveaxis(change, 0, 1)
        above = {joint.child: joint for joint in self.robot.tree.joints.values()}
        wanted: dict[str, Array] = dict(zip(self.movers, change[: self._n], strict=True))
        held: dict[str, Array] = {}
        links = [self.robot.tree.link_of(frame) for frame in self.frames]
        for link, tool in zip(links, change[self._n :], strict=True):
            if above[link].type == "fixed":
                wanted[above[link].name] = tool
            else:
                held[link] = tool
        moved: dict[str, Array] = {}  # in the axes of the link that moves
        shifts: dict[str, Array] = {}
        # those that carry others first
        for joint in sorted(wanted, key=partial(all_frame_id, self.robot)):
            parent = link = self.robot.tree.joints[joint].parent
            moved[joint] = wanted[joint]
            while link in above and above[link].type == "fixed":  # what carries it was moved, too
                moved[joint] = moved[joint] - moved.get(above[link].name, 0.0)
                link = above[link].parent
            if moved[joint].any():
                placed = self._model.frames[all_frame_id(self.robot, parent)].placement
                shifts[joint] = moved[joint] @ placed.rotation
        turns, angles = {}, theta[:, self.n_lengths :].reshape(len(theta), -1, 3)
        for name, ways, by in zip(self.turners, self.across, angles.swapaxes(0, 1), strict=True):
            if by.any():  # of tilts and encoder
                each = rotations_of(by[..., np.newaxis] * np.array(ways))
                turns[name] = each[:, 0] @ each[:, 1] @ each[:, 2]
        return shifts, turns, held

    @cached_property
    def _data(self) -> pin.Data:
        return self._freed.model.createData()

    def _rates(self, v: Array, theta_dot: Array) -> Array:
        """Return q̇ and θ' as the model with translations as joints has them."""
        speeds = self.robot.mimic_joints.v(as_vector("v", v, self.robot.nv))
        return np.concatenate([speeds, theta_dot]).take(self._from_v)

    def _placed(self, q: Array, theta: Array, rates: Array | None = None) -> Any:
        """Place that model at q and θ; return it if they are symbols, else None."""
        q = self.robot.mimic_joints.q(self.robot.configuration(q))
        q = np.concatenate([q, theta]).take(self._from_q)
        if (arm := arm_of(self._freed, q)) is not None:
            return arm
        if rates is None:
            pin.computeJointJacobians(self._freed.model, self._data, q)
        else:
            pin.computeJointJacobiansTimeVariation(self._freed.model, self._data, q, rates)
        return None

    def _frame(self, arm: Any, i: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and the position (3,) of a point in the base's axes."""
        if arm is not None:
            return arm.frame(f"{i}")
        M = pin.updateFramePlacement(self._freed.model, self._data, self._points[i])
        return M.rotation, M.translation

    def _jacobian(self, arm: Any, i: int, rates: Array | None = None) -> Array:
        """Return the Jacobian of a point by q and θ in the base's axes, (6, n + p), or its rate."""
        if arm is not None:
            return arm.jacobian(f"{i}") if rates is None else arm.jacobian_dot(f"{i}", rates)
        of_frame = pin.getFrameJacobian if rates is None else pin.getFrameJacobianTimeVariation
        return of_frame(self._freed.model, self._data, self._points[i], _IN_WORLD)

    def _positions(self, arm: Any) -> Array:
        return np.concatenate([self._frame(arm, i)[1] for i in range(self.k)])

    def _jacobians(self, arm: Any, rates: Array | None = None) -> Array:
        each = [self._jacobian(arm, i, rates)[:3] for i in range(self.k)]
        return each[0] if self.k == 1 else np.concatenate(each)

    def _along_joints(self, J: Array) -> Array:
        J = J.take(self._of_joints, 1)
        return J if self._plain else np.asanyarray(J.dot(self._columns))


def across(axis: Array) -> tuple[Array, Array, Array]:
    """Return e₁, e₂ and e₁ × e₂ along an axis, (3,) each: x, y and z of an axis along z."""
    axis = axis / np.linalg.norm(axis)
    one = np.eye(3)[np.abs(axis).argmin()]
    one = one - axis * axis.dot(one)
    one = one / np.linalg.norm(one)
    return one, np.cross(axis, one), axis


@dataclass(frozen=True, eq=False, repr=False)
class KinematicBelief:
    """Numbers of an arm's kinematics as they were learnt, with their covariance.

    Attributes:
        names: Names of the numbers, such as "panda_joint4.x" or "panda_joint4.encoder".
        units: Their units, "m" or "rad".
        believed: Their values in the drawing, shape (p,).
        learnt: Their values now, shape (p,).
        covariance: Their covariance, shape (p, p).
        rotations: Rotations of the joint origins that angles count from, shape (k, 3, 3).
        frames: Names of the frame that was held or seen, in the drawing and in the learnt arm.
        kinds: Kinds of the numbers, some of "tool", "origins" and "axes".
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    believed: Array
    learnt: Array
    covariance: Array
    rotations: Array
    frames: tuple[str, ...]
    kinds: tuple[str, ...]

    def about(self, regressor: KinematicRegressor, names: Sequence[str]) -> tuple[Array, Array]:
        """Return some numbers (k,) and their covariance (k, k), as a regressor has them.

        Its robot may be the drawing or the learnt one: angles become those about its origins.
        Raises an InvalidInputError for another arm, or of the tool for another frame.
        """
        frame, theta = regressor.frames[0], dict(zip(regressor.names, regressor.theta, strict=True))
        learnt, T, rotations = self.learnt.copy(), np.eye(len(self.names)), iter(self.rotations)
        far = ["tool"] if "tool.x" in names and frame not in self.frames else []
        for i, name in enumerate(self.names):
            joint, _, kind = name.rpartition(".")
            if kind == "tilt1" and joint in regressor.turners:
                j, angles = regressor.turners.index(joint), slice(i, i + 3)
                B = np.column_stack(regressor.across[j])
                # exp(α₁[x]ₓ) exp(α₂[y]ₓ) exp(δ[z]ₓ) is the inverse of a roll, pitch and yaw
                before = pin.rpy.computeRpyJacobian(-learnt[angles], pin.WORLD)
                R = pin.rpy.rpyToMatrix(-learnt[angles]) @ B.T @ next(rotations).T
                learnt[angles] = -pin.rpy.matrixToRpy(R @ regressor.rotations[j] @ B)
                after = pin.rpy.computeRpyJacobian(-learnt[angles], pin.WORLD)
                T[angles, angles] = np.linalg.solve(after, before)
            off = abs(learnt[i] - theta.get(name, np.inf))
            far += [name] if joint != "tool" and off > _FARTHEST[self.units[i]] else []
        if far:
            message = (
                f"calibration must be of {regressor.robot.name} and its frame {frame}, got one "
            )
            message += f"of {self.frames[-1]}, whose {far[0]} differs; sd['tool'] is for a new tool"
            raise InvalidInputError(message, given=self.frames)
        at = [self.names.index(name) for name in names]
        return learnt[at], (T @ self.covariance @ T.T)[np.ix_(at, at)]

    def save(self, path: str | Path) -> Path:
        """Write what a prior or an `Uncertainty` needs into a .npz file; return its path."""
        path = Path(path).with_suffix(".npz")
        with refusing("path must be a file to write", str(path)), replaced(path) as unfinished:
            np.savez(unfinished, **{f.name: getattr(self, f.name) for f in fields(KinematicBelief)})
        return path

    @staticmethod
    def load(path: str | Path) -> "KinematicBelief":
        """Return the numbers of a file; raise an InvalidInputError if there are none."""
        wanted, anything = "calibration must be a file of Calibration.save", (Exception,)
        with refusing(wanted, str(path), anything), Path(path).open("rb") as stream:  # as NumPy
            kept = read_arrays(stream)
            each: Any = [kept[field.name] for field in fields(KinematicBelief)]
        each = [tuple(a.tolist()) if a.dtype.kind == "U" else a for a in each]
        return KinematicBelief(*each)


class Unknowns:
    """p(q, u), with u the numbers of a regressor that are learnt.

    Args:
        regressor: With axes if these are among the kinds.
        kinds: Some of "tool", "origins" and "axes", which are tilts and encoders.
        sds: Plausible errors by kind, with "encoders" beside them.
        prior: What is known better of the numbers that it has, but for `new` kinds of them.

    Attributes:
        names: Names of u, in `units`.
        u: Their believed values, shape (n_u,), and `sd` their plausible errors.
        P: Covariance of these, shape (n_u, n_u).
        is_tool, is_angle: What of u is which, shape (n_u,).
    """

    def __init__(
        self,
        regressor: KinematicRegressor,
        kinds: Collection[str],
        sds: Mapping[str, float],
        prior: KinematicBelief | None = None,
        new: Collection[str] = (),
    ) -> None:
        ends = regressor.n_lengths - 3 * len(regressor.frames)
        of = ["origins"] * ends + ["tool"] * (regressor.n_lengths - ends)
        angles = regressor.names[regressor.n_lengths :]
        of += ["encoders" if name.endswith(".encoder") else "axes" for name in angles]
        learnt = {*kinds, *(("encoders",) if "axes" in kinds else ())}
        self._chosen = np.array([i for i, each in enumerate(of) if each in learnt], dtype=int)
        self.regressor, chosen = regressor, [of[i] for i in self._chosen]
        self.is_tool = np.array([each == "tool" for each in chosen], dtype=bool)
        self.is_angle = self._chosen >= regressor.n_lengths
        self.sd = np.array([sds[each] for each in chosen])
        self.names = [regressor.names[i] for i in self._chosen]
        self.units = [regressor.units[i] for i in self._chosen]
        self.u = regressor.theta[self._chosen]
        self._S = np.eye(regressor.p)[:, self._chosen]
        self._known = regressor.theta - self._S.dot(self.u)
        self.P = np.diag(self.sd**2)
        if prior is not None:
            at = [i for i, n in enumerate(self.names) if n in prior.names and chosen[i] not in new]
            self.u[at], self.P[np.ix_(at, at)] = prior.about(regressor, [self.names[i] for i in at])
            self.sd = np.sqrt(self.P.diagonal())
        reaches = (regressor.robot.reach_bound(frame)[1] for frame in regressor.frames)
        self._reach = max(reaches) if self.is_angle.any() else 0.0

    def at(self, q: Array, u: Array | None = None) -> tuple[Array, Array]:
        """Return H(q) = ∂p/∂u, shape (3k, n_u), and o = p − Hu, (3k,), at u or what is believed."""
        theta = self.theta(self.u if u is None else u)
        Y, known = self.regressor.linear(q, theta)
        return Y[:, self._chosen], known + Y.dot(self._known)

    def theta(self, u: Array) -> Array:
        """Return all numbers of the regressor, learnt and known; (p,)."""
        return np.asanyarray(self._known + self._spread(u))

    def motion(self, q: Array, v: Array, u: Array, u_dot: Array) -> PointMotion:
        """Return the points and their derivatives at q and q̇, with u and u' (n_u,)."""
        return self.regressor.motion(q, v, self.theta(u), self._spread(u_dot))

    def turn(self, q: Array, u: Array, v: Array | None = None, u_dot: Array | None = None) -> Any:
        """Return the orientation of the frame, and its derivatives of which A is by u (3, n_u)."""
        v = np.zeros(self.regressor.robot.nv) if v is None else v
        u_dot = np.zeros(len(self.u)) if u_dot is None else u_dot
        turn = self.regressor.turn(q, v, self.theta(u), self._spread(u_dot))
        return turn._replace(A=turn.A[:, self._chosen])

    def bent(self, variances: Array) -> Any:
        """Return the variance [m²] of what is of second order in u, by the variances of u (n_u,).

        It is about tr P_angles(tr P_tool + L² tr P_angles)/3, L the arm's reach.
        """
        angles, tools = (variances[which].sum() for which in (self.is_angle, self.is_tool))
        return angles * (tools + self._reach**2 * angles) / 3.0

    def _spread(self, u: Array) -> Array:
        return u if len(u) == len(self._S) else np.asanyarray(self._S.dot(u))
