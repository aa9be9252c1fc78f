"""Unknowns of a measured position: numbers that it is linear in, and a rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import chosen_deviations, chosen_kinds
from approxjac.errors import InvalidInputError
from approxjac.interface import Target
from approxjac.law import PredictedError
from approxjac.robots import KinematicRegressor, Robot
from approxjac.robots.kinematic_regressor import PointMotion
from approxjac.tasks import (
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array

KINDS = ("tool", "origins", "camera", "offset", "scale")
_USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "orientation": 1.0, "origins": 0.02, "camera": 1.0, "offset": 0.2, "scale": 0.2,
}  # fmt: skip
_NOISY = 0.3  # of the arm's reach, or of a metre, above which noise is in millimetres
_AXES = np.eye(3)
_AXES.flags.writeable = False
_TURNABLE = dict.fromkeys(("xyz", "xy", "yx", "xz", "zx", "yz", "zy"))


class Unknowns:
    """x = R(o(q) + H(q)Θ), with Θ = (u, c): translations and scale u, offset c = Rᵀb.

    Of a pose u ends with the nine numbers of the tool's rotation, and x has the axes as points. R
    (d, d) turns the base's axes into the sensor's. `names` are u, then b, then the rotation; a
    scale is the last entry of u. `length` [m] is what a radian counts as, beside positions.
    """

    def __init__(self, task: Task, unknown: Any, sd: Any, length: float) -> None:
        kinds = chosen_kinds(unknown, KINDS)
        used = {*kinds, *(("offset",) if "camera" in kinds else ())}
        used |= {"orientation"} if isinstance(task, PoseTask) and "tool" in kinds else set()
        sds = chosen_deviations(sd, _USUAL_SD, used)
        points, trackers = _points(task)
        self.turns, self.has_scale = "camera" in kinds, "scale" in kinds
        axes = self._axes(task, points)
        self.d = d = len(axes)
        self.R, b = np.eye(d), np.zeros(d)
        if trackers:
            self.R, b = law.rotation_exp(trackers[0].rotation), trackers[0].offset
        frames = list(dict.fromkeys(frame for frame, _ in points))
        self.regressor = regressor = KinematicRegressor(task.robot, frames)
        self.n_tilts = 0 if isinstance(task, PoseTask) else 2 * len(regressor.turning)
        entries = [(frames.index(frame), axis) for frame, each in points for axis in each]
        reaches = [task.robot.reach_bound(frame)[1] for frame in frames]
        self.largest_noise = _NOISY * max(1.0, *reaches)  # that could be meant
        rows = [3 * frame + "xyz".index(axis) for frame, axis in entries]
        in_order = rows == list(range(3 * regressor.k))
        self.rows: slice | Array = slice(None) if in_order else np.array(rows)

        # u: p = o(q) + Y(q)(θ + S u)
        theta = regressor.theta.copy()
        is_tool = np.arange(regressor.p) >= regressor.p - 3 * len(frames)
        self.of_theta = np.flatnonzero(np.where(is_tool, "tool" in kinds, "origins" in kinds))
        columns = list(np.eye(regressor.p)[self.of_theta])
        names = [regressor.names[i] for i in self.of_theta]
        u = theta[self.of_theta].tolist()
        deviations = [sds["tool" if is_tool[i] else "origins"] for i in self.of_theta]
        theta[self.of_theta] = 0.0
        if self.has_scale:
            self._require_known_lengths(task, kinds)
            columns, names = [*columns, theta], [*names, "scale"]
            u, deviations = [*u, 1.0], [*deviations, sds["scale"]]
            theta = np.zeros(regressor.p)
        self.theta = theta
        self.S = np.array(columns).reshape(-1, regressor.p).T
        self._is_all = np.array_equal(self.S, np.eye(len(theta)))  # which is usual
        # how far x may move from one configuration to another
        self._usual, self._spread = theta + self.S.dot(u), self.S * np.array(deviations)
        self.orientation, self.n_t = None, 0
        if isinstance(task, PoseTask):
            self.orientation = Orientation(task.robot, task.frame, length)
            self.n_t = 9 if "tool" in kinds else 0
        if self.n_t:
            names += [f"tool.r{axis}" for axis in "xyz"]
            u = [*u, *np.eye(3).ravel()]
            # √2, as one turn changes two of three numbers of an axis
            deviations = [*deviations, *[math.sqrt(2.0) * sds["orientation"]] * 9]
        self.n_u = len(u)

        # c: the offset, learnt or known
        c = self.R.T.dot(b)
        each = np.eye(self.d)[[axes.index(axis) for _, axis in entries]]
        self.offsets, self.constant = np.zeros((len(rows), 0)), np.zeros(len(rows))
        if self.turns or "offset" in kinds:
            self.offsets = each
            names += [f"offset.{axis}" for axis in axes]
            u, deviations = [*u, *c], [*deviations, *[sds["offset"]] * self.d]
        elif c.any():
            self.constant = each.dot(c)
        self._has_constant = bool(self.constant.any())
        self.Theta = np.array(u)
        self.is_turned = self.turns or not np.array_equal(self.R, np.eye(self.d))
        self.sd_Theta, self.sd_R = np.array(deviations), sds["camera"]

        if self.turns:
            names += [f"camera.r{axis}" for axis in axes] if self.d == 3 else ["camera.turn"]
            deviations = [*deviations, *[sds["camera"]] * len(law.generators(self.d))]
        self.names = tuple(names)
        self.units = tuple(_unit(name) for name in names)
        self.believed = self.in_order(self.Theta, self.R)
        self.sd = np.sqrt(self.merged(np.diag(np.square(deviations)), self.Theta).diagonal())

    def _axes(self, task: Task, points: list[tuple[str, str]]) -> str:
        """Return the axes of a point."""
        each = {axes for _, axes in points}
        if not self.turns:
            return "".join(axis for axis in "xyz" if axis in "".join(each))
        if len(each) > 1 or not each <= _TURNABLE.keys():
            raise InvalidInputError(
                f"a camera that may be turned needs the same axes of every point, one of "
                f"{', '.join(_TURNABLE)}, got {task!r}",
                given=task,
            )
        return points[0][1]

    def _require_known_lengths(self, task: Task, kinds: tuple[str, ...]) -> None:
        if isinstance(task, PoseTask):
            raise InvalidInputError(
                f"scale can be learnt of positions only, got unknown = {kinds} for {task!r}",
                given=kinds,
            )
        if "origins" in kinds or "m" in task.robot.joint_units:
            raise InvalidInputError(
                "scale can be learnt only where the origins are known and no joint slides, "
                f"got unknown = {kinds} for {task.robot.name}, where lengths and scale are one",
                given=kinds,
            )

    def translations(self, u: Array) -> Array:
        """Return all translations times the scale, of u (n_u,), shape (p,) [m]."""
        u = u[: self.n_u - self.n_t]
        return u if self._is_all else self.theta + self.S.dot(u)

    def rates(self, u_dot: Array) -> Array:
        """Return the rates of `translations`, shape (p,) [m/s]."""
        u_dot = u_dot[: self.n_u - self.n_t]
        return u_dot if self._is_all else self.S.dot(u_dot)

    def seen(self, motion: PointMotion) -> PointMotion:
        """Return the motion of what x has of the frames, with the known offset."""
        if not isinstance(self.rows, slice):
            motion = PointMotion(*(part[self.rows] for part in motion))
        return motion._replace(p=motion.p + self.constant) if self._has_constant else motion

    def points(self, x: Array) -> Array:
        """Return the part of a measured x that is linear in Θ: x, or position and axes of a pose.

        NaN where it is lost. One that may be turned tells nothing where it is seen in part.
        """
        if self.orientation is not None:
            x = np.concatenate([x[:3], self.orientation.points(x[3:])])
        if self.is_turned:
            lost = np.isnan(x.reshape(-1, self.d).sum(axis=1))
            x = np.where(np.repeat(lost, self.d), math.nan, x)
        return x

    def regression(self, q: Array) -> tuple[Array, Array]:
        """Return H(q) and o(q) of all that is linear, in the base's axes."""
        H, known = self.at(q)
        H = np.concatenate([H, self.offsets], axis=1)
        if self.orientation is None:
            return H, known
        axes, n = self.orientation.regressor(q), H.shape[1]
        if not self.n_t:
            known = np.concatenate([known, axes.dot(_AXES.ravel())])
            return np.concatenate([H, np.zeros((9, n))]), known
        none = [np.zeros((9, self.n_u - 9)), np.zeros((9, n - self.n_u))]
        axes = np.concatenate([none[0], axes, none[1]], axis=1)
        return np.concatenate([H, axes]), np.concatenate([known, np.zeros(9)])

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return H(q) of positions without the offset's columns, (m or 3, n_u), and their o(q)."""
        Y = self.regressor.Y(q)[self.rows]
        known = Y.dot(self.theta) + self.constant
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q)[self.rows]
        H = Y.dot(self.S)
        return np.concatenate([H, np.zeros((3, 9))], axis=1) if self.n_t else H, known

    def tilts(self, q: Array, u: Array) -> Array:
        """Return ∂(p times the scale)/∂(tilts of axes), shape (m, n_tilts)."""
        if not self.n_tilts:
            return np.zeros((12 if self.orientation is not None else len(self.constant), 0))
        return self.regressor.tilts(q, self.translations(u))[self.rows]

    def reach(self, q_0: Array, q: Array) -> Array:
        """Return the largest motion of each of `points` between two configurations [m].

        Half as far again as the believed arm, and four standard deviations of what may be wrong.
        """
        moved = self.regressor.Y(q) - self.regressor.Y(q_0)
        known = moved.dot(self._usual)
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q) - self.regressor.offset(q_0)
        each = np.sqrt((known.reshape(-1, 3) ** 2).sum(axis=1))
        unsure = np.sqrt((moved.dot(self._spread).reshape(len(each), -1) ** 2).sum(axis=1))
        reach = np.repeat(1.5 * each + 4.0 * unsure, 3)[self.rows]
        if self.orientation is None:
            return np.asanyarray(reach)
        return np.concatenate([reach, np.repeat(1.5 * self.orientation.reach(q_0, q), 9)])

    # -- what was learnt -------------------------------------------------------------------

    def in_order(self, Theta: Array, R: Array) -> Array:
        """Return the learnt numbers in the order of `names`."""
        u, c = Theta[: self.n_u - self.n_t], Theta[self.n_u :]
        if self.has_scale:
            u = np.append(u[:-1] / u[-1], u[-1:])
        numbers = Theta[len(u) : self.n_u]
        tool = law.rotation_log(Orientation.of(numbers)) if self.n_t else np.zeros(0)
        turn = law.rotation_log(R) if self.turns else np.zeros(0)
        return np.concatenate([u, tool, R.dot(c) if len(c) else c, turn])

    def tool(self, learnt: Array) -> Array:
        """Return the rotation of the tool from what is believed, of numbers in order, (3, 3)."""
        if not self.n_t:
            return np.eye(3)
        start = len(self.of_theta)
        return law.rotation_exp(learnt[start : start + 3])

    def left(self, x: Array, predicted: Array) -> Array:
        """Return the residual of x, of a pose as position and rotation vector, (m,) [m]."""
        if self.orientation is None:
            return x - predicted
        turn = self.orientation.left(x[3:], predicted[3:])
        return np.concatenate([x[:3] - predicted[:3], turn])

    def unscaled(self, P: Array, learnt: Array) -> Array:
        """Return a covariance, of translations that were learnt times the scale, as without it."""
        if not self.has_scale:
            return P
        n = self.n_u - 1
        T = np.eye(len(P))
        T[:n, :n] /= learnt[n]
        T[:n, n] = -learnt[:n] / learnt[n]
        return np.asarray(T.dot(P).dot(T.T))

    def merged(self, P: Array, Theta: Array) -> Array:
        """Return a covariance of what is estimated as that of `names`: nine numbers are a turn."""
        if not self.n_t:
            return P
        start, end = self.n_u - 9, self.n_u
        M = np.eye(len(P))
        M[start : start + 3, start:end] = Orientation.turn_of(Theta[start:end])
        M = np.delete(M, slice(start + 3, end), axis=0)
        return np.asarray(M.dot(P).dot(M.T))


def _points(task: Task) -> tuple[list[tuple[str, str]], list[TrackerTask | PoseTrackerTask]]:
    """Return frames and axes of the positions that a task is made of, and its trackers."""
    parts: tuple[Any, ...] = task.tasks if isinstance(task, StackedTask) else (task,)
    for each in parts:
        is_pose = isinstance(each, PoseTask) and each is task
        if not (is_pose or isinstance(each, PositionTask | TrackerTask)):
            raise InvalidInputError(
                "task must be a PositionTask, a TrackerTask, a StackedTask of them, a PoseTask or "
                f"a Robot, got {task!r}",
                given=task,
            )
    trackers = [each for each in parts if isinstance(each, TrackerTask | PoseTrackerTask)]
    seen = {(*each.rotation.tolist(), *each.offset.tolist()) for each in trackers}
    if trackers and (len(seen) > 1 or len(trackers) < len(parts)):
        raise InvalidInputError(
            f"task must be of one tracker, with one rotation and offset, got {task!r}", given=task
        )
    return [(each.frame, getattr(each, "axes", "xyz")) for each in parts], trackers


def _unit(name: str) -> str:
    if name == "scale":
        return ""
    return "rad" if name.rsplit(".", 1)[1] in ("rx", "ry", "rz", "turn") else "m"


class Orientation:
    """R_x = R R_f(q) T: R_f is that of the believed frame, T the tool's in it, R that of a tracker.

    To the estimators the three axes of x are points ℓ R_x e_k, linear in the nine numbers of T: R
    is one for them and the position, and what the sums over frames have to hold does not change.
    T is the rotation nearest to the nine: with R known, the average of R_fᵀRᵀR_x and the prior.
    Of a rotation vector φ, Σ‖ℓ[φ]ₓ e_k‖² = 2ℓ²‖φ‖²; so with ℓ = L/√2, and L the noise of
    positions over that of angles, what a radian counts as [m], both weigh as their noise says.

    Owns scratch memory: one instance a thread.
    """

    def __init__(self, robot: Robot, frame: str, length: float) -> None:
        self.length = length
        self._l = length / math.sqrt(2.0)
        self._frame = FrameKinematics(robot, frame)

    def frame_rotation(self, q: Array) -> Array:
        """Return R_f, shape (3, 3)."""
        return self._frame.placement(q)[0]

    # -- for the estimators ---------------------------------------------------------------

    def points(self, quaternion: Array) -> Array:
        """Return ℓ R_x e_k, one after the other, shape (9,), NaN where there is no rotation."""
        R, is_some = law.rotation_of(quaternion)
        return np.where(is_some, self._l * R.T.ravel(), math.nan)

    def regressor(self, q: Array) -> Array:
        """Return H of these points in the base frame, Hvec(Tᵀ), shape (9, 9)."""
        R, none = self._l * self.frame_rotation(q), np.zeros((3, 3))
        rows = [[R, none, none], [none, R, none], [none, none, R]]
        return np.concatenate([np.concatenate(row, axis=1) for row in rows])

    def reach(self, q_0: Array, q: Array) -> Any:
        """Return the motion of one of these points between two configurations [m]."""
        moved = self.frame_rotation(q) - self.frame_rotation(q_0)
        return law.length(moved.ravel()) * (self._l / math.sqrt(2.0))

    def left(self, points: Array, predicted: Array) -> Array:
        """Return the rotation vector from predicted points to measured ones, in L, (3,) [m]."""
        is_seen = np.isfinite(points[0])
        R = np.where(is_seen, points, 0.0).reshape(3, 3).T / self._l
        nearest = law.nearest_rotation(predicted.reshape(3, 3))
        return np.where(is_seen, self.length * law.rotation_log(R.dot(nearest)), math.nan)

    @staticmethod
    def of(numbers: Array) -> Array:
        """Return T of the nine numbers vec(Tᵀ), shape (3, 3)."""
        return law.nearest_rotation(numbers.reshape(3, 3).T)

    @staticmethod
    def turn_of(numbers: Array) -> Array:
        """Return the rotation vector that small changes of the nine turn T by, a map (3, 9)."""
        tangents = law.tangents(Orientation.of(numbers)).reshape(3, 3, 3)
        return 0.5 * tangents.transpose(1, 0, 2).reshape(9, 3).T

    # -- for the law ----------------------------------------------------------------------

    def first(self, q: Array, quaternion: Array, R: Array) -> tuple[Array, Any]:
        """Return the T with which the first x is as predicted, (3, 3), and whether it is seen."""
        R_x, is_seen = law.rotation_of(quaternion)
        return self.frame_rotation(q).T.dot(R.T).dot(R_x), is_seen

    def apart(
        self, q: Array, before: tuple[Array, Array], goal: tuple[Array, Array], integral: Array
    ) -> tuple[Array, Array]:
        """Return the rotation vector from one orientation to another, and to make it the tool's.

        Both are of R and T; `integral` turns the goal further, in L [m]. The vector (3,) is in the
        sensor's axes, and the rotation (3, 3) from these to those in which T turns.
        """
        R_f = self.frame_rotation(q)
        (R, T), (R_goal, T_goal) = before, goal
        now = R.dot(R_f)
        wanted = law.rotation_exp(integral / self.length).dot(R_goal.dot(R_f).dot(T_goal))
        return law.rotation_log(wanted.dot(now.dot(T).T)), now.T

    def predict(
        self, q: Array, v: Array, target: Target, T: Array, T_spin: Array, R: Array, spin: Array
    ) -> PredictedError:
        """Return z = log(R_f T (RᵀR_d)ᵀ) and its derivatives, in the base's axes.

        The target is the quaternion of R_d (4,), ω_d and its rate (3,) in the sensor's axes;
        T' = [T_spin]ₓT and R' = [spin]ₓR.
        """
        x_d, x_d_dot, x_d_ddot = target
        R_d, is_some = law.rotation_of(x_d)
        J, R_f, _ = self._frame.motion(q)
        J = J[3:].copy()
        drift = R_f.dot(T_spin)
        D = R.T.dot(law.select(is_some, R_d, _AXES))
        E = R_f.dot(T).dot(D.T)
        x_d_dot = np.zeros(3) if x_d_dot is None else x_d_dot
        x_d_ddot = np.zeros(3) if x_d_ddot is None else x_d_ddot
        x_d_ddot = R.T.dot(x_d_ddot - law.cross_matrix(spin).dot(x_d_dot))
        x_d_dot = R.T.dot(x_d_dot)
        speed, of_target = J.dot(v), x_d_dot - R.T.dot(spin)
        # of E' = [ω]ₓE, ω = speed + drift − E of_target; ż is no ω, but for small z
        z_dot = law.log_rate(E, speed + drift - E.dot(of_target))
        drift = z_dot - speed + x_d_dot
        J_dot = self._frame.jacobian_dot(q, v)[3:]
        return PredictedError(law.rotation_log(E), J, J_dot, x_d_dot, x_d_ddot, drift)
