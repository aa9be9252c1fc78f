"""`AdaptiveKinematics`: tool, joint origins and camera, learnt from the measured x."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers.arguments import chosen_deviations, chosen_kinds, is_rotation
from approxjac.controllers.learning.estimator import (
    Estimator,
    Expectation,
    Sight,
    motion_of_points,
)
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.law import PredictedError, rotation
from approxjac.law.factors import inverse, product, solved
from approxjac.robots import KinematicBelief, KinematicRegressor, Robot
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.tasks import (
    ImageTask,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.validation import Array, as_number, require

_KINDS = ("tool", "origins", "axes", "camera", "offset", "delay")
_USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "orientation": 1.0, "origins": 0.02, "axes": 3e-3, "encoders": 0.015,
    "camera": 1.0, "offset": 0.2, "delay": 0.02,
}  # fmt: skip
_USUAL_IN_IMAGE = {"tool": 0.5, "origins": 0.5}  # as wrong as the magnification
_NOISE = 2e-3  # usual one [m]
_NOISY = 0.3  # of the arm's reach, or of a metre, above which noise is in millimetres
_FORGETTING = 1.0 / 30.0  # λ [1/s]
_MEMORY = 15.0  # of χ² [s]
_CHANGED = 3e-3, 9.0  # averaged residual [m], and in its sd: another sensor or tool
_UNLIKE = 16.0  # χ² that counts as noise, at most
_WORST = 4.0  # χ² above which no more is passed over
_BELIEVED = 5.0  # of frames after which what was learnt is a belief when learning begins anew [s]
_NO_TIME = 1e-12  # of an average's share
_SELDOM = 3e-3  # share of what is learnt that is forgotten at once
_ODDS = 2.0  # of another rotation against the one at hand, as a logarithm, before it is taken
_JUMPS = 0.95  # of tr(AᵀA') from frame to frame: about 20°, by which no rotation is refined
_SAME = 0.8  # of tr(AᵀA'): about 45°, nearer than which rotations are one to Newton's method


class AdaptiveKinematics(Estimator):
    """x̂ = R̂ p(q; θ̂) + b̂, learnt from the measured x while the arm moves.

    It learns, as chosen, the translations of the tool and of all joint origins, tilts of joint axes
    and offsets of encoders, the rotation and offset of a camera or tracker, and the delay of x. The
    law controls the *predicted* x̂, rotated into the base frame, so that no estimate of the camera
    makes Ĵ singular. With a known rotation, x̂ → x for any motion, without excitation (Theorem A in
    docs/theory.md). An unknown rotation is estimated from all frames together. An integral offset
    absorbs what the parameters do not explain.

    Frames are paired with the configuration at which they were taken. A jump of the sensor is
    ignored; if it persists, as after the sensor moved or the tool slipped, learning restarts unless
    `restarts` is False.

    For a pose it also learns the orientation R̂_x = R̂ R_f(q) T̂, with the rotation T̂ of the tool.
    For a `PlanarCamera` images cannot distinguish a wrong magnification from lengths that are wrong
    by the same factor, so the error is learnt as lengths.

    Args:
        task: A `PositionTask` or `TrackerTask` of the believed robot, or a `StackedTask` of them;
            a `PoseTask` or `PoseTrackerTask`; an `ImageTask` of a frame's origin in a
            `PlanarCamera`; or the robot, for the position of its tip. A camera of unknown rotation
            needs two or three axes, the same for every point; two rotate in their plane.
        unknown: Parameters that may be wrong: "tool" and "origins" are translations, for a pose
            "tool" includes its orientation; "axes" are tilts of joint axes and offsets of encoders;
            "camera" is rotation and offset, "offset" the latter; "delay" is by how much x is older
            than it is stamped.
        sd: Plausible errors: "tool", "origins" and "offset" [m], "axes", "encoders", "orientation"
            of the tool and "camera" [rad], "delay" [s]; by default 0.2, 0.02, 0.2, 0.003, 0.015,
            1.0, 1.0 and 0.02, in a `PlanarCamera` 0.5 of "tool" and "origins". All lengths are in
            the arm's plane there.
        noise: Standard deviation of x [m], in a `PlanarCamera` on its sensor; by default 2 mm,
            there 0.2 mm times the magnification.
        delay: Age of x where `Measurement.t_x` is None [s]. Frames older than 0.25 s, or twice the
            delay if that is more, are ignored.
        dt: Sampling time of control [s].
        angle_noise: Standard deviation of the orientation of a pose [rad].
        prior: A calibration to begin with, of the arm as drawn or as calibrated: its numbers are
            unknown, too, by its covariance, but for kinds in `sd`: with "tool" it is another tool.
        restarts: True to begin anew, about what was learnt and as unsure as at first, where x
            contradicts it; False to go on: the integral offset absorbs the change, the parameters
            follow slowly, and `Controller.relearnt` begins anew.

    Attributes:
        regressor: p(q, θ) of the points.
        names: Names of the learnt numbers, such as "panda_joint4.x", "panda_joint4.tilt1",
            "panda_joint4.encoder", "tool.x", "offset.y", "camera.rz", or "camera.turn" from the
            first axis to the second; for a pose "tool.rx", in the axes of the believed tool.

    Raises:
        InvalidInputError: Another task, an empty or invalid `unknown`, an sd of a known parameter,
            or numbers out of range, such as times in milliseconds.
        UnknownNameError: An sd of an unknown kind.
    """

    def __init__(
        self,
        task: Task | Robot,
        unknown: Sequence[str] = ("tool", "origins", "camera"),
        sd: Mapping[str, float] | None = None,
        noise: float | None = None,
        delay: float = 0.0,
        dt: float = 1e-3,
        angle_noise: float = 5e-3,
        prior: KinematicBelief | None = None,
        restarts: bool = True,
    ) -> None:
        self._restarts = restarts
        self.task = task = PositionTask(task) if isinstance(task, Robot) else task
        require("prior", prior, KinematicBelief | None, "a Calibration, or None")
        kinds = (*chosen_kinds(unknown, _KINDS), *(prior.kinds if prior else ()))
        self.unknown = kinds = tuple(dict.fromkeys(kinds))
        self._is_pose, self._turns = isinstance(task, PoseTask), "camera" in kinds
        used = {*kinds, *(("offset",) if self._turns else ())}
        self._learns_T = self._is_pose and "tool" in kinds
        used |= {"orientation"} if self._learns_T else set()
        used |= {"encoders"} if "axes" in kinds else set()
        in_image = isinstance(task, ImageTask)
        sds = chosen_deviations(sd, {**_USUAL_SD, **(_USUAL_IN_IMAGE if in_image else {})}, used)
        points, sensor = _seen(task)
        axes = _axes(task, points, self._turns or sensor is not None)
        self._d = d = len(axes)
        self._size, R, b = sensor or (1.0, np.eye(d), np.zeros(d))
        self._R, self._is_turned = R, self._turns or not np.array_equal(R, np.eye(d))

        frames = list(dict.fromkeys(frame for frame, _ in points))
        largest = _NOISY * max(1.0, *(task.robot.reach_bound(frame)[1] for frame in frames))
        usual = 0.1 * _NOISE * self._size if in_image else _NOISE
        noise = usual if noise is None else noise
        most = largest * self._size
        self.noise = as_number("noise", noise, unit="m", above=0.0, most=most) / self._size
        angle_noise = as_number("angle_noise", angle_noise, unit="rad", above=0.0, most=1.0)

        # u: p = o(q) + H(q)u, and of a pose the nine numbers of the tool's rotation
        self.regressor = KinematicRegressor(task.robot, frames, axes="axes" in kinds)
        self._moved = moved = Unknowns(self.regressor, kinds, sds, prior, set(sd or ()))
        entries = [(frames.index(frame), axis) for frame, each in points for axis in each]
        rows = [3 * frame + "xyz".index(axis) for frame, axis in entries]
        self._is_all = rows == list(range(3 * self.regressor.k))
        self._rows: slice | Array = slice(None) if self._is_all else np.array(rows)
        self._n_p, self._n_theta = len(rows), len(moved.u)
        # What the last encoder is off by turns the tool only: learnt beside one, it would be taken
        # as seen, as H is about a tool that is not known at first. So the tool is learnt as turned.
        self._turned_tool: int | None = None
        last, is_new = self.regressor.movers[-1], prior is None and len(frames) == 1
        if is_new and "tool" in kinds and f"{last}.encoder" in moved.names:
            self._turned_tool = moved.names.index(f"{last}.encoder")
        units, Theta = dict(zip(moved.names, moved.units, strict=True)), [moved.u]
        deviations = [moved.sd]
        # The axes of R_x = R R_f(q) T are points ℓ R_x e_k, linear in nine numbers, to which T is
        # the nearest rotation. Of a rotation vector φ, Σ‖ℓ[φ]ₓ e_k‖² = 2ℓ²‖φ‖²: with ℓ = L/√2, and
        # L what a radian counts as [m], both weigh as their noise says.
        self._length = self.noise / angle_noise
        self._l = self._length / math.sqrt(2.0)
        if self._learns_T:
            units |= {f"tool.r{axis}": "rad" for axis in "xyz"}
            Theta.append(np.eye(3).ravel())
            # √2, as one turn changes two of three numbers of an axis
            deviations.append(np.full(9, math.sqrt(2.0) * sds["orientation"]))
        self._learns_late = "delay" in kinds
        if self._learns_late:
            units |= {"delay": "s"}
            Theta.append(np.zeros(1))
            deviations.append(np.array([sds["delay"]]))
        self._n_u = sum(map(len, Theta))

        # c = Rᵀb: the offset, learnt or known
        c, each = R.T.dot(b), np.eye(d)[[axes.index(axis) for _, axis in entries]]
        self._along, self._offsets, self._constant = each, np.zeros((len(rows), 0)), each.dot(c)
        if self._turns or "offset" in kinds:
            self._offsets, self._constant = each, np.zeros(len(rows))
            units |= {f"offset.{axis}": "m" for axis in axes}
            Theta.append(c)
            deviations.append(np.full(d, sds["offset"]))
        kind = _UnknownRotation if self._turns else _KnownRotation
        self._Theta, sd_Theta = np.concatenate(Theta), np.concatenate(deviations)
        P = np.diag(sd_Theta**2)
        P[: self._n_theta, : self._n_theta] = moved.P
        self._estimator = kind(self._Theta, R, P, sds["camera"], self._n_u, self.noise, moved)
        spin = len(rotation.generators(d)) if self._turns else 0
        if self._turns:
            turns = [f"camera.r{axis}" for axis in axes] if d == 3 else ["camera.turn"]
            units |= dict.fromkeys(turns, "rad")
        self.names, self.units = tuple(units), tuple(units.values())
        self._believed = self._in_order(self._Theta, R)
        variances = np.append(P.diagonal(), np.full(spin, sds["camera"] ** 2))
        self._sd = np.sqrt(self._merged(np.diag(variances), self._Theta).diagonal())
        n, n_p, n_T = self._n_u, self._n_p, 9 if self._is_pose else 0
        sizes = {
            "sums": self._estimator.size, "chi": 2, "placed": task.n_x,
            "R": d * d if self._turns else 0, "R_spin": spin, "T": n_T, "T_spin": n_T // 3,
            "u": n, "b": n_p, "u_dot": n, "b_dot": n_p,
        }  # fmt: skip
        self._lay_out(sizes, delay, dt, len(self._points(np.zeros(task.n_x))))

    def __repr__(self) -> str:
        return f"AdaptiveKinematics({self.task!r}, unknown={self.unknown})"

    # -- what is measured, linear about Θ = (u, c): x = R(o(q) + H(q)Θ) ----------------------

    def _own(self, measurement: Measurement) -> Measurement:
        if self._size == 1.0:
            return measurement
        return measurement._replace(x=measurement.x / self._size)

    def _points(self, x: Array) -> Array:
        # of a pose position and axes; what may be turned tells nothing where it is seen in part
        if self._is_pose:
            R, is_some = rotation.rotation_of(x[3:])
            x = np.concatenate([x[:3], np.where(is_some, self._l * R.T.ravel(), math.nan)])
        if self._is_turned:
            lost = np.isnan(x.reshape(-1, self._d).sum(axis=1))
            x = np.where(np.repeat(lost, self._d), math.nan, x)
        return x

    def _late(self, state: Array) -> Any:
        return state[self._at["sums"]][self._estimator.late] if self._learns_late else 0.0

    def _positions(self, q: Array, u: Array) -> tuple[Array, Array]:
        """Return H(q) of positions, (n_p, n_u), and o(q), in the base's axes without the offset.

        About u, of which the first n_θ are the regressor's.
        """
        H, known = self._moved.at(q, u[: self._n_theta])
        H, known = H[self._rows], known[self._rows] + self._constant
        if self._turned_tool is not None:
            H[:, self._turned_tool] = 0.0
        others = np.zeros((len(H), self._n_u - self._n_theta))
        return np.concatenate([H, others], axis=1) if others.size else H, known

    def _regression(self, q: Array, v: Array, u: Array, late_by: Any) -> tuple[Array, Array]:
        """Return H and o of all that is learnt from, about u, in the base's axes.

        At q and q̇ of a time `late_by` [s] before x was taken.
        """
        H, known = self._positions(q, u)
        H = np.concatenate([H, self._offsets], axis=1)
        at, none, n = self._n_theta, np.zeros((3, 3)), H.shape[1]
        late = self._n_u - 1
        if self._learns_late:
            nothing = 0.0 * u[:at]
            H[:, late] = -self._moved.motion(q, v, u[:at], nothing).J[self._rows].dot(v)
            known = known - H[:, late] * late_by
        if not self._is_pose:
            return H, known
        turn = self._moved.turn(q, u[:at])
        R = self._l * turn.R
        rows = [[R, none, none], [none, R, none], [none, none, R]]
        axes = np.concatenate([np.concatenate(row, axis=1) for row in rows])
        T = u[at : at + 9] if self._learns_T else np.eye(3).ravel()
        of_axes, known_axes = np.zeros_like(axes, shape=(9, n)), axes.dot(T)
        if self._moved.is_angle.any():  # axes turn about those of tilted joints
            shown = known_axes.reshape(3, 3)
            of_axes[:, :at] = np.cross(turn.A.T[:, np.newaxis], shown).reshape(at, 9).T
            if self._turned_tool is not None:
                of_axes[:, self._turned_tool] = 0.0
            known_axes = known_axes - of_axes[:, :at].dot(u[:at])
        if self._learns_late:
            shown = axes.dot(T).reshape(3, 3)
            of_axes[:, late] = -np.cross(turn.J.dot(v), shown).ravel()
            known_axes = known_axes - of_axes[:, late] * late_by
        if self._learns_T:
            of_axes[:, at : at + 9], known_axes = axes, known_axes - axes.dot(T)
        return np.concatenate([H, of_axes]), np.concatenate([known, known_axes])

    def _reach(self, q_0: Array, q: Array) -> Array:
        # half as far again as the believed arm, and four standard deviations of what may be wrong
        before, after = self._moved.at(q_0), self._moved.at(q)
        known, unsure = motion_of_points(before, after, self._moved.u, self._moved.sd)
        reach = np.repeat(1.5 * known + 4.0 * unsure, 3)[self._rows]
        if self._is_pose:
            ends = (self._moved.turn(each, self._moved.u).R for each in (q, q_0))
            turned = law.length(np.subtract(*ends).ravel())
            reach = np.concatenate([reach, np.repeat(1.5 * (self._l / math.sqrt(2.0)) * turned, 9)])
        return np.asanyarray(reach)

    def _in_order(self, Theta: Array, R: Array) -> Array:
        n, c = self._n_theta, Theta[self._n_u :]
        parts = [Theta[:n]]
        if self._learns_T:
            parts.append(law.rotation_log(_rotation_of(Theta[n : n + 9])))
        if self._learns_late:
            parts.append(Theta[self._n_u - 1 : self._n_u])
        parts.append(R.dot(c) if len(c) else c)
        if self._turns:
            parts.append(law.rotation_log(R))
        return np.concatenate(parts)

    def _merged(self, P: Array, Theta: Array) -> Array:
        """Return a covariance of what is estimated as that of `names`: nine numbers are a turn."""
        M, start = np.eye(len(P)), self._n_theta
        if (encoder := self._turned_tool) is not None:
            axis, tool = self.regressor.across[-1][2], np.flatnonzero(self._moved.is_tool)
            M[tool, encoder] = -np.cross(axis, Theta[tool])
        if not self._learns_T:
            return np.asarray(M.dot(P).dot(M.T))
        end = start + 9
        tangents = rotation.tangents(_rotation_of(Theta[start:end])).reshape(3, 3, 3)
        # the rotation vector that small changes of the nine turn T by
        M[start : start + 3, start:end] = 0.5 * tangents.transpose(1, 0, 2).reshape(9, 3).T
        M = np.delete(M, slice(start + 3, end), axis=0)
        return np.asarray(M.dot(P).dot(M.T))

    def _begin(self, state: Array) -> None:
        at, n = self._at, self._n_u
        state[at["sums"]] = self._estimator.initial()
        state[at["learnt"]], state[at["u"]] = self._believed, self._Theta[:n]
        state[at["chi"]] = 1.0, 0.0
        if self._turns:
            state[at["R"]] = self._R.ravel()
        state[at["b"]] = self._turned(self._R, self._offsets.dot(self._Theta[n:]))
        if self._is_pose:
            state[at["T"]] = np.eye(3).ravel()

    def _has_begun(self, state: Array) -> Any:
        return law.all_of(state[self._at["placed"]] > 0.0)

    def _place(self, state: Array, frame: Measurement) -> None:
        at, x, q, n_p = self._at, frame.x, frame.q, self._n_p
        R = self._rotation(state)
        first = np.isfinite(x) & ~(state[at["placed"]] > 0.0)
        if self._is_pose:
            R_x, is_seen = rotation.rotation_of(x[3:])
            T = self._turn(q, state[at["u"]]).R.T.dot(R.T).dot(R_x)
            first[3:] = first[3:] & is_seen
            state[at["T"]] = np.where(law.all_of(first[3:]), T.ravel(), state[at["T"]])
        H, known = self._positions(q, state[at["u"]])
        x_hat = self._turned(R, known + H.dot(state[at["u"]]))
        state[at["b"]] = np.where(first[:n_p], x[:n_p] - x_hat, state[at["b"]])
        state[at["placed"]] = np.where(first, 1.0, state[at["placed"]])

    def _correct(self, state: Array, frame: Measurement, since: Any, is_anew: Any) -> None:
        at, x = self._at, frame.x
        averaged, chi = state[at["averaged"]], state[at["chi"]]
        kept = -np.expm1(-since / self._window)
        # as it was said, or as seen from frame to frame
        noise = np.maximum(self.noise, np.sqrt(np.maximum(state[at["noted"]][2], 0.0)))
        usual = noise * np.sqrt(kept / (2.0 - kept))  # of what noise leaves of an average
        # what was not explained all along is no news
        unexplained = np.sqrt(np.minimum(np.maximum(chi[0], 1.0), _WORST))
        changed = unexplained * np.maximum(_CHANGED[0], _CHANGED[1] * usual)
        if self._restarts:
            law.alter(is_anew | (np.abs(averaged).max() > changed), state, self._renew)
        u = self._estimator.estimate(state[at["sums"]])[0]
        H, known = self._regression(frame.q, frame.v, u, frame.t_x)
        # what is lost has no part in the sums
        seen = np.isfinite(x)
        z, o = np.where(seen, x, 0.0), np.where(seen, known, 0.0)
        H_seen = np.where(seen[:, np.newaxis], H, 0.0)
        share = -np.expm1(-_FORGETTING * since)
        R_before = self._estimator.estimate(state[at["sums"]])[1].copy()
        state[at["sums"]] = sums = self._estimator.learn(state[at["sums"]], H_seen, o, z, share)
        Theta, R = self._estimator.estimate(sums)
        state[at["learnt"]] = self._in_order(Theta, R)
        if self._turns:  # what a rotation that is given up left of x says nothing of another
            given_up = (R_before * R).sum() <= _JUMPS * self._d
            averaged[:] = law.select(given_up, 0.0, averaged)
            chi[:] = law.select(given_up, np.array([1.0, 0.0]), chi)
        predicted = self._turned(R, known + H.dot(Theta))
        left = x[: self._n_p] - predicted[: self._n_p]
        if self._is_pose:
            left = np.concatenate([left, self._turn_left(x[3:], predicted[3:])])
        self._account(state, left, since)
        seen = np.isfinite(left)
        square = (np.where(seen, averaged, 0.0) ** 2).sum() / np.where(seen, 1.0, 0.0).sum()

        def look(chi: Array) -> None:
            """Update the average of χ² over time."""
            chi[1] += since
            chi[0] += since / np.minimum(chi[1] + 1.0, _MEMORY) * (square / usual**2 - chi[0])

        law.alter(kept > _NO_TIME, chi, look)

    def _turn_left(self, points: Array, predicted: Array) -> Array:
        """Return the rotation vector from predicted points to measured ones, in L, (3,) [m]."""
        is_seen = np.isfinite(points[0])
        R = np.where(is_seen, points, 0.0).reshape(3, 3).T / self._l
        nearest = law.nearest_rotation(predicted.reshape(3, 3))
        return np.where(is_seen, self._length * law.rotation_log(R.dot(nearest)), math.nan)

    def _renew(self, state: Array) -> None:
        at = self._at
        sums, chi = state[at["sums"]], state[at["chi"]]
        # or it was a false start, of which χ² says nothing either
        was_learnt = state[at["noted"]][0] > _BELIEVED
        initial = self._estimator.initial()
        state[at["sums"]] = np.where(was_learnt, self._estimator.renewed(sums), initial)
        chi[0], chi[1] = law.select(was_learnt, chi[0], 1.0), law.select(was_learnt, chi[1], 0.0)
        self._forget(state)

    def _aim(self, state: Array, q: Array, dt: float) -> None:
        # u and R follow, and the offset such that x̂ at q does; of a pose so does T
        at, n, n_p = self._at, self._n_u, self._n_p
        Theta, R = self._estimator.estimate(state[at["sums"]])
        u, smooth_u = Theta[:n], state[at["u"]]
        H, known = self._positions(q, smooth_u)
        smooth_p, smooth_R = known + H.dot(smooth_u), self._rotation(state)
        learnt_H, learnt_o = self._positions(q, u) if self._moved.is_angle.any() else (H, known)
        p = learnt_o + learnt_H.dot(u) + self._offsets.dot(Theta[n:])
        integral = state[at["integral"]]
        away = self._turned(R, p) + integral[:n_p]
        away = away - (self._turned(smooth_R, smooth_p) + state[at["b"]])
        turn = law.rotation_log(R.dot(smooth_R.T)) if self._turns else np.zeros(3)
        turns = [turn] if self._turns else []
        if self._is_pose:
            T, (R_f, _, _, A) = state[at["T"]].reshape(3, 3), self._turn(q, smooth_u)
            learnt = self.learnt(state)[self._n_theta : self._n_theta + 3]
            T_goal = law.rotation_exp(learnt) if self._learns_T else np.eye(3)
            now, goal = smooth_R.dot(R_f), R.dot(self._turn(q, u).R).dot(T_goal)
            goal = law.rotation_exp(integral[n_p:] / self._length).dot(goal)
            turns.append(law.rotation_log(goal.dot(now.dot(T).T)))
        rate = self._smoothing_rate(dt, law.length(away), *turns)
        state[at["u_dot"]] = u_dot = rate * (u - smooth_u)
        if self._is_pose:
            spun = R_f.T.dot(A.dot(u_dot[: self._n_theta]))  # by joints whose axes are learnt
            state[at["T_spin"]] = rate * now.T.dot(turns[-1] - turn) - spun
        b_dot = rate * away - self._turned(smooth_R, H.dot(u_dot))
        if self._turns:
            state[at["R_spin"]] = spin = rate * turn
            b_dot = b_dot - self._turned(law.cross_matrix(spin).dot(smooth_R), smooth_p)
        state[at["b_dot"]] = b_dot

    def _rotation(self, state: Array) -> Array:
        return state[self._at["R"]].reshape(self._d, self._d) if self._turns else self._R

    def _turn(self, q: Array, u: Array, *moving: Array) -> Any:
        return self._moved.turn(q, u[: self._n_theta], *moving)

    def _turned(self, R: Array, p: Array) -> Array:
        return p.reshape(-1, self._d).dot(R.T).ravel() if self._is_turned else p

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error, in the base's axes, at q (nq,) and q̇ (n_v,).

        z = R̂ᵀ(x̂ − x_d), with the smoothed estimates, and the terms of its derivatives. For a
        `PlanarCamera` it is in metres on the sensor.
        """
        wanted = [np.zeros(self.task.m) if each is None else each for each in target]
        if self._size != 1.0:
            located = [each / self._size for each in wanted]
            return PredictedError(*(self._size * e for e in self._predict(state, q, v, located)))
        if not self._is_pose:
            return self._predict(state, q, v, wanted)
        place, turn = ([each[part] for each in wanted] for part in (slice(3), slice(3, None)))
        positions = self._predict(state, q, v, place)
        turns = self._predict_turn(state, q, v, turn)
        return PredictedError(*map(np.concatenate, zip(positions, turns, strict=True)))

    def _predict(self, state: Array, q: Array, v: Array, wanted: list[Array]) -> PredictedError:
        """Return the predicted error of positions x̂ = R̂p + b̂, in the base's axes."""
        at, n = self._at, self._n_theta
        motion = self._moved.motion(q, v, state[at["u"]][:n], state[at["u_dot"]][:n])
        p, J, J_dot, drift = motion if self._is_all else (part[self._rows] for part in motion)
        p = p + self._constant
        x_d, x_d_dot, x_d_ddot = wanted
        away, b_dot, spin = state[at["b"]] - x_d, state[at["b_dot"]], state[at["R_spin"]]
        if self._is_turned:
            # rows are vectors: x R is Rᵀx. With R' = [ω]ₓR, Rᵀx changes by Rᵀ(x' + [ω]ₓᵀx)
            vectors = np.array([away, x_d_dot, b_dot, x_d_ddot]).reshape(-1, self._d)
            if len(spin):
                half = len(vectors) // 2
                vectors[half:] += vectors[:half].dot(law.cross_matrix(spin))
            back = vectors.dot(self._rotation(state))
            away, x_d_dot, b_dot, x_d_ddot = back.reshape(4, -1)
        return PredictedError(p + away, J, J_dot, x_d_dot, x_d_ddot, drift + b_dot)

    def _predict_turn(self, state: Array, q: Array, v: Array, turn: list[Array]) -> PredictedError:
        """Return z = log(R_f T (RᵀR_d)ᵀ) in the base's axes; T' = [T_spin]ₓT and R' = [spin]ₓR."""
        at, (x_d, x_d_dot, x_d_ddot) = self._at, turn
        T, R = state[at["T"]].reshape(3, 3), self._rotation(state)
        spin = state[at["R_spin"]] if self._turns else np.zeros(3)
        R_d, is_some = rotation.rotation_of(x_d)
        u_dot = state[at["u_dot"]][: self._n_theta]
        R_f, J, J_dot, A = self._turn(q, state[at["u"]], v, u_dot)
        drift = R_f.dot(state[at["T_spin"]]) + A.dot(u_dot)
        D = R.T.dot(law.select(is_some, R_d, np.eye(3)))
        E = R_f.dot(T).dot(D.T)
        x_d_ddot = R.T.dot(x_d_ddot - law.cross_matrix(spin).dot(x_d_dot))
        x_d_dot = R.T.dot(x_d_dot)
        speed, of_target = J.dot(v), x_d_dot - R.T.dot(spin)
        # of E' = [ω]ₓE, ω = speed + drift − E of_target; ż is no ω, but for small z
        drift = rotation.log_rate(E, speed + drift - E.dot(of_target)) - speed + x_d_dot
        return PredictedError(law.rotation_log(E), J, J_dot, x_d_dot, x_d_ddot, drift)

    def motion_sd(self, state: Array, q_0: Array) -> Callable[[Array], Array]:
        """Return q → standard deviation (m,) of the predicted motion of x from q_0.

        x = R(o + Hu) + b moves by RΔp, Δp = Δo + ΔHu, and by R ΔH δu + [φ]ₓRΔp more where u and R
        are off by δu and φ; an orientation by W = RΔR_fRᵀ, and by φ − Wφ more, whatever the tool's.
        """
        P, u = self.report(state).covariance, self.learnt(state)[: self._n_theta].copy()
        R = self._estimator.estimate(state[self._at["sums"]])[1]
        (H_0, o_0), n_p = self._moved.at(q_0, u), self._n_p
        spin = len(state[self._at["R_spin"]])

        def sd(q: Array) -> Array:
            H, o = self._moved.at(q, u)
            both = np.column_stack([H - H_0, o - o_0 + (H - H_0).dot(u)])[self._rows]
            if self._is_turned:
                both = (R @ both.reshape(-1, self._d, both.shape[1])).reshape(both.shape)
            J = np.zeros((self.task.m, len(P)))
            J[:n_p, : len(u)] = both[:, :-1]
            if spin:
                ways = both[:, -1].reshape(-1, self._d)
                moved = np.einsum("sij,kj->kis", rotation.generators(self._d), ways)
                J[:n_p, -spin:] = moved.reshape(n_p, spin)
            if self._is_pose:
                (R_f, _, _, A), (R_0, _, _, A_0) = (self._turn(each, u) for each in (q, q_0))
                W = R_f.dot(R_0.T)
                J[n_p:, : len(u)] = R.dot(A - W.dot(A_0))
                if spin:
                    J[n_p:, -spin:] = np.eye(3) - R.dot(W).dot(R.T)
            return np.asarray(self._size * np.sqrt(np.maximum((J.dot(P) * J).sum(axis=1), 0.0)))

        return sd

    @cached_property
    def _whole(self) -> tuple[KinematicRegressor, Array]:
        """A regressor with axes, and the plausible errors of those that are not learnt."""
        if self.regressor.turners:
            return self.regressor, np.zeros(0)
        whole = KinematicRegressor(self.task.robot, self.regressor.frames, axes=True)
        sds = [_USUAL_SD["encoders" if n.endswith(".encoder") else "axes"] for n in whole.names]
        return whole, np.array(sds[whole.n_lengths :])

    def expectation(self, state: Array) -> Expectation:
        at, d, n_p, n_u = self._at, self._d, self._n_p, self._n_u
        sums, R_u, (whole, angles) = state[at["sums"]], slice(self._n_theta), self._whole
        chi, (Theta, R) = max(float(state[at["chi"]][0]), 1.0), self._estimator.estimate(sums)
        usual = max(self.noise**2, float(state[at["noted"]][2]))
        P = (chi * usual / self.noise**2) * self._estimator.covariance(sums)
        if self._moved.is_angle.any():
            usual += self._moved.bent(P.diagonal()[R_u])
        theta, c = np.append(self._moved.theta(Theta[R_u]), np.zeros(len(angles))), Theta[n_u:]
        T = _rotation_of(Theta[R_u.stop : R_u.stop + 9]) if self._learns_T else np.eye(3)
        first, lengths = whole.n_lengths - 3 * len(whole.frames), whole.n_lengths
        is_whole = d > 1 and np.array_equal(self._along, np.tile(np.eye(d), (n_p // d, 1)))
        turns = rotation.generators(d) if is_whole else np.zeros((0, d, d))
        still = np.zeros(self.task.robot.nv), np.zeros(len(theta))

        def turned(M: Array) -> Array:
            if not self._is_turned:
                return M
            return (R @ M.reshape(-1, d, M.shape[1])).reshape(M.shape)

        def along(turns: Array, x: Array) -> Array:
            return np.einsum("sij,kj->kis", turns, x.reshape(-1, d)).reshape(len(x), len(turns))

        def sight(frame: Measurement) -> Sight:
            q = frame.q
            H, o = self._regression(q, frame.v, Theta[:n_u], frame.t_x)
            x_hat, H = self._turned(R, o + H.dot(Theta)), turned(H)
            if len(c):  # c = Rᵀb, and b keeps its place where R turns
                H[:, n_u:] = H[:, n_u:].dot(R.T)
            more = ((0, len(x_hat) - n_p), (0, 0))
            Y = np.pad(turned(whole.linear(q, theta)[0][self._rows]), more)
            turn, tool_turn = along(turns, x_hat), np.zeros((len(x_hat), 0))
            if self._turns:
                b = np.pad(self._along.dot(R.dot(c)), more[0])
                H = np.hstack([H, along(turns, x_hat - b)])
            if self._is_pose:
                R_f, _, _, A = whole.turn(q, still[0], theta, still[1])
                axes = (R.dot(R_f) @ rotation.generators(3) @ T).transpose(2, 1, 0).reshape(9, 3)
                tool_turn = np.concatenate([np.zeros((n_p, 3)), self._l * axes])
                Y[n_p:] = along(turns, x_hat[n_p:]).dot(R.dot(A))
            H = np.hstack([H, Y[:, lengths:] * angles]) if len(angles) else H
            left, shift = self._points(frame.x) - x_hat, np.pad(self._along, more)
            return Sight(left, H, Y[:, first:lengths], tool_turn, shift, turn)

        n = len(P)
        covariance = np.eye(n + len(angles))
        covariance[:n, :n] = P
        return Expectation(covariance, math.sqrt(usual * min(chi, _UNLIKE)), sight)

    def _is_state(self, state: Array) -> bool:
        sums = state[self._at["sums"]]
        return is_rotation(self._rotation(state)) and self._estimator.are_numbers(sums)

    def _covariance(self, state: Array) -> tuple[Array, float]:
        sums = state[self._at["sums"]]
        Theta, _ = self._estimator.estimate(sums)
        covariance = self._merged(self._estimator.covariance(sums), Theta)
        return covariance, float(state[self._at["chi"]][0])

    def robot(self, state: Array) -> Robot:
        learnt, n = self.learnt(self._required(state)), self._n_theta
        turn = learnt[n : n + 3] if self._learns_T else None
        return self.regressor.robot_with(self._moved.theta(learnt[:n]), turn)


def _seen(task: Any) -> tuple[list[tuple[str, str]], tuple[float, Array, Array] | None]:
    """Return frames and axes of the positions in x; and size, R and b of a sensor, if it has any.

    x = size (R p + b).
    """
    if isinstance(task, ImageTask) and isinstance(task.camera, PlanarCamera):
        camera, m = task.camera, task.camera.magnification
        c, s = math.cos(camera.roll), math.sin(camera.roll)
        if task.frame is not None and not task.points.any():
            R = np.array([[c, s], [-s, c]])
            return [(task.frame, camera.plane)], (m, R, np.asarray(camera.offset) / m)
    parts: tuple[Any, ...] = task.tasks if isinstance(task, StackedTask) else (task,)
    for each in parts:
        is_pose = isinstance(each, PoseTask) and each is task
        if not (is_pose or isinstance(each, PositionTask | TrackerTask)):
            raise InvalidInputError(
                "task must be a PositionTask, a TrackerTask, a StackedTask of them, a PoseTask, an "
                "ImageTask of a frame's origin in a PlanarCamera (AdaptiveCamera is for a "
                f"PinholeCamera) or a Robot, got {task!r}",
                given=task,
            )
    points = [(each.frame, getattr(each, "axes", "xyz")) for each in parts]
    is_tracked = [isinstance(each, TrackerTask | PoseTrackerTask) for each in parts]
    if not any(is_tracked):
        return points, None
    if not all(is_tracked) or len({(*each.rotation, *each.offset) for each in parts}) > 1:
        message = f"task must be of one tracker, with one rotation and offset, got {task!r}"
        raise InvalidInputError(message, given=task)
    return points, (1.0, law.rotation_exp(parts[0].rotation), parts[0].offset)


def _axes(task: Task, points: list[tuple[str, str]], turns: bool) -> str:
    each = {axes for _, axes in points}
    if not turns:
        return "".join(axis for axis in "xyz" if axis in "".join(each))
    axes = points[0][1]
    if len(each) > 1 or not (axes == "xyz" or len(axes) == 2):
        raise InvalidInputError(
            "a camera that may be turned needs the same axes of every point, xyz or two of them, "
            f"got {task!r}",
            given=task,
        )
    return axes


class _KnownRotation:
    """x = R(o + HΘ) with R known: recursive least squares with forgetting towards the prior.

    Theorem A. Its numbers: P = Λ⁻¹, as its upper triangle; the share that waits to be forgotten;
    and Θ̂ = (u, c).
    """

    def __init__(
        self, Theta: Array, R: Array, P: Array, sd_R: float, n_u: int, noise: float, moved: Unknowns
    ) -> None:
        self._first, self._R, self._d, self._n_u = Theta, R, len(R), n_u
        self._P = n = len(Theta)
        self._P_0, self._sd_R, self._noise = P, sd_R, noise
        self._is_plain = np.count_nonzero(P) == n
        plain = np.diag(np.sqrt(P.diagonal()) ** -2.0)
        self._prior: Array = plain if self._is_plain else np.asarray(np.linalg.inv(P))
        self._moved, self._bends = moved, bool(moved.is_angle.any())
        self._is_turned = not np.array_equal(R, np.eye(self._d))
        rows, columns = np.triu_indices(n)
        self._upper, self._n = rows * n + columns, len(rows)
        self._where = np.zeros((n, n), dtype=int)
        self._where[rows, columns] = self._where[columns, rows] = np.arange(self._n)
        self.size = len(self.initial())

    @property
    def late(self) -> int:
        """Place of the number of a delay."""
        return self._n + self._n_u

    def _pack(self, matrix: Array) -> Array:
        return np.asanyarray(matrix.ravel()[self._upper])

    def _unpack(self, numbers: Array) -> Array:
        return np.asanyarray(numbers[self._where])

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._first, self._R.T)

    def renewed(self, numbers: Array) -> Array:
        """Return numbers with the learnt values as new belief, as uncertain as the first one."""
        Theta, R = self.estimate(numbers)
        return self._about(Theta, R.T)

    def are_numbers(self, numbers: Array) -> bool:
        """Return True if these are possible numbers of this estimator."""
        # forgetting goes towards the prior, so nothing is ever known less well
        diagonal = self._unpack(numbers).diagonal()
        return bool(((diagonal > 0.0) & (diagonal < 1.01 * self._P_0.diagonal())).all())

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        """Return the numbers after a frame x (m,), and a share λT forgotten.

        H (m, P) and o (m,) are in the base's axes; all are 0 in rows that are lost.
        """
        if self._is_turned:
            x = x.reshape(-1, self._d).dot(self._R).ravel()
        P, share, Theta = self._unpack(numbers), numbers[self._n] + share, numbers[self._n + 1 :]
        kept, is_due = (P,), share >= _SELDOM
        known = self._prior.diagonal() if self._is_plain else self._prior
        (P,) = law.choose(is_due, lambda: (law.forgotten(*kept, known, share),), lambda: kept)
        K = law.gain(P, H, self._variance(P))
        P = P - product(K, product(P, H.T).T)
        Theta = Theta + K.dot(x - o - H.dot(Theta))
        return np.concatenate([self._pack(P), [law.select(is_due, 0.0, share)], Theta])

    def _variance(self, P: Array) -> Any:
        """Return R of a frame [m²]: noise, and what is bent at the covariance P before it."""
        if not self._bends:
            return self._noise**2
        return self._noise**2 + self._moved.bent(P.diagonal()[: len(self._moved.u)])

    def estimate(self, numbers: Array) -> tuple[Array, Array]:
        """Return Θ̂ in the base's axes, (P,), and R̂ of the base's axes in the sensor's, (d, d)."""
        return numbers[self._n + 1 :].copy(), self._R

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b), and of φ with R ← exp([φ]ₓ)R where R is learnt."""
        covariance, T = self._unpack(numbers), np.eye(self._P)
        if self._n_u < self._P:
            T[self._n_u :, self._n_u :] = self._R
        return np.asarray(T.dot(covariance).dot(T.T))

    def _about(self, Theta: Array, A: Array) -> Array:
        """Return the numbers of the prior alone, about these estimates, with A = Rᵀ."""
        return np.concatenate([self._pack(self._P_0), [0.0], Theta])


class _UnknownRotation(_KnownRotation):
    """x = R(o + Hu + c), with R any rotation: exact least squares over all frames at once.

    Theorem B. All frames are remembered in sums N, a, B and E: for a rotation A = Rᵀ, w = vec A,

        Θ(A) = N⁻¹(a + Bw), and A maximises ½(a + Bw)ᵀN⁻¹(a + Bw) + Eᵀw

    over rotations only, looked for everywhere. Forgetting is towards the prior about what is
    estimated now, which leaves the estimate where it is.
    """

    @cached_property
    def _parts(self) -> list[tuple[int, int]]:
        P, dd = self._P, self._d**2
        return list(pairwise(np.cumsum([self._n, P, P * dd, dd, P, dd]).tolist()))

    @cached_property
    def _everywhere(self) -> Array:
        return rotation.rotations_everywhere(self._d).reshape(-1, self._d**2)

    @property
    def late(self) -> int:
        return self._parts[3][0] + self._n_u - 1

    def are_numbers(self, numbers: Array) -> bool:
        diagonal = self._unpack(numbers).diagonal()
        return bool((diagonal > 0.99 * self._prior.diagonal()).all())

    def _split(self, numbers: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        a, B, E, Theta, A = (numbers[start:end] for start, end in self._parts)
        B, A = B.reshape(self._P, -1), A.reshape(self._d, self._d)
        return self._unpack(numbers), a, B, E, Theta, A

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        d = self._d
        *_, Theta, A = self._split(numbers)
        numbers = numbers + share * (self._about(Theta, A) - numbers)
        N, a, B, E, _, A = self._split(numbers)
        W = 1.0 / self._variance(inverse(N) if self._bends else N)
        HW = W * H.T
        upper = self._pack(N + HW.dot(H))
        a = a - HW.dot(o)
        seen = x.reshape(-1, d)
        each = HW.reshape(len(a), -1, d).transpose(0, 2, 1).dot(seen)  # Σ Hᵀ x
        B = B + each.reshape(len(a), -1)
        E = E + (W * o.reshape(-1, d).T.dot(seen)).ravel()
        found, M, h = _reduced(self._unpack(upper), a, B, E)
        w = self._rotation(M, h, A).ravel()
        Theta = found[:, 0] + found[:, 1:].dot(w)
        return np.concatenate([upper, a, B.ravel(), E, Theta, w])

    def estimate(self, numbers: Array) -> tuple[Array, Array]:
        *_, Theta, A = self._split(numbers)
        return Theta.copy(), A.T

    def covariance(self, numbers: Array) -> Array:
        # that of the least squares: rotation first, all else given the rotation
        N, a, B, E, Theta, A = self._split(numbers)
        found, M, h = _reduced(N, a, B, E)
        known, axes = np.linalg.eigh(rotation.derivatives(M, h, A)[1])
        # of δ, with A ← exp([δ]ₓ)A; nothing is known less well than before
        of_delta = (axes / np.maximum(known, self._sd_R**-2.0)).dot(axes.T)
        moved = np.concatenate([found[:, 1:].dot(rotation.tangents(A)), np.eye(len(of_delta))])
        joint, n, P = moved.dot(of_delta).dot(moved.T), self._n_u, self._P
        joint[:P, :P] += inverse(N)
        # b = Rc with R = Aᵀ ← R exp(−[δ]ₓ), and φ = −Rδ (−δ in the plane)
        c, R, T = Theta[n:], A.T, np.eye(len(joint))
        T[n:P, n:P] = R
        T[n:P, P:] = -R.dot((rotation.generators(self._d) @ c).T)
        T[P:, P:] = -R if self._d == 3 else -1.0
        return np.asarray(T.dot(joint).dot(T.T))

    def _rotation(self, M: Array, h: Array, A: Array) -> Array:
        near = rotation.best_rotation(M, h, A)
        start = rotation.most_explained(M, h, self._everywhere)

        def elsewhere() -> tuple[Array]:
            other = rotation.best_rotation(M, h, start.reshape(A.shape))
            better = rotation.explained(M, h, other) > rotation.explained(M, h, near) + _ODDS
            return (law.select(better, other, near),)

        is_other = start.dot(near.ravel()) <= _SAME * self._d
        return law.choose(is_other, elsewhere, lambda: (near,))[0]

    def _about(self, Theta: Array, A: Array) -> Array:
        d, n = self._d, self._n_u
        b, of_u, u = A.T.dot(Theta[n:]), self._prior[:n, :n], Theta[:n]
        a = np.append(of_u.diagonal() * u if self._is_plain else of_u.dot(u), np.zeros(d))
        B = np.eye(d)[:, :, np.newaxis] * (b * self._prior[n, n])
        E = (0.5 / self._sd_R**2) * A.ravel()
        parts = [self._pack(self._prior), a, np.zeros(n * d * d), B.ravel(), E, Theta, A.ravel()]
        return np.concatenate(parts)


def _reduced(N: Array, a: Array, B: Array, E: Array) -> tuple[Array, Array, Array]:
    """Return N⁻¹[a B], and M and h of what rotations alone have to maximise."""
    found = solved(N, np.concatenate([a[:, np.newaxis], B], axis=1))
    M = B.T.dot(found[:, 1:])
    return found, 0.5 * (M + M.T), B.T.dot(found[:, 0]) + E


def _rotation_of(numbers: Array) -> Array:
    """Return T of the nine numbers vec(Tᵀ), shape (3, 3)."""
    return law.nearest_rotation(numbers.reshape(3, 3).T)
