"""`AdaptiveKinematics`: tool, joint origins and camera, learnt from the measured x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.kinematic_estimators import KnownCamera, UnknownCamera
from approxjac.controllers.kinematic_frames import Frame, Frames, Gate
from approxjac.controllers.kinematic_report import KinematicReport, LearntNumber
from approxjac.controllers.predicted import Kinematics, Prediction
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.interface import Measurement, Target
from approxjac.robots import KinematicRegressor, Robot
from approxjac.tasks import PositionTask, StackedTask, Task
from approxjac.validation import Array, as_number, require

KINDS = ("tool", "origins", "camera", "offset", "scale")
"""What may be unknown."""
USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "origins": 0.02, "camera": 1.0, "offset": 0.2, "scale": 0.2,
}  # fmt: skip
"""Plausible errors: of each translation [m], of the camera's rotation [rad], offset [m], scale."""

_FORGETTING = 1.0 / 30.0  # λ [1/s]
_SMOOTHING = 20.0  # β [1/s]
_INTEGRAL = 1.0  # ω_b [1/s]
_EASED_SPEED = 0.5  # of x̂, by what is learnt [m/s]
_EASED_TURN = 2.0 * math.pi  # of the camera's estimate [rad/s]
_LONGEST = 0.1  # time that one frame counts for [s]
_BUSY = 7e-3  # between frames, below which they come faster than there is anything to learn [s]
_WINDOW = 0.3  # over which residuals are averaged: noise goes, what is not explained stays [s]
_MEMORY = 5.0  # of χ² [s]
_SMALLEST_SCALE = 0.1
_TURNABLE = ("xyz", "xy", "yx", "xz", "zx", "yz", "zy")


class AdaptiveKinematics(Kinematics):
    """x̂ = ŝR̂ p(q; θ̂) + b̂, learnt from the measured x while the arm moves.

    Learnt are the translations of the tool and of all joint origins, and of a camera or tracker
    rotation, offset and scale, as told. What the law controls is the *predicted* x̂, a known
    function of q, pulled back into the base frame, so that no estimate of the camera makes Ĵ
    singular.

    With the camera's rotation known it is recursive least squares with forgetting towards the
    prior (Theorem A): x̂ → x for any motion whatever, without excitation. With the rotation unknown
    it is the same over rotations: all frames, not the last one only, say which rotation is right.
    An integral offset on x̂ takes up what the parameters do not explain.

    Frames are paired with the configuration at which they were taken, so delay and frame rate are
    outside the loop. A sensor that jumps is passed over; one that was moved is learnt anew.

    Its state holds sums over frames, the estimates, smoothed ones, and a ring of configurations.

    Args:
        task: A `PositionTask` of the believed robot, or a `StackedTask` of them; or the robot, for
            the position of its tip. A camera that may be turned needs two axes or three, the same
            of every point. Two turn in their plane.
        unknown: Of `KINDS`: "tool" and "origins" are translations; "camera" is rotation and
            offset, "offset" the offset alone; "scale" only where the origins are known.
        sd: Plausible errors, as `USUAL_SD`, which has what is not given [m, rad].
        noise: Standard deviation of x [m].
        delay: Age of x where `Measurement.t_x` is None [s].
        dt: Sampling time of control [s].

    Attributes:
        regressor: p(q) of the points, linear in the translations.
        names: Names of what is learnt, such as "panda_joint4.x", "tool.x", "offset.y",
            "scale", "camera.rz", or "camera.turn" from the first axis to the second.

    Raises:
        InvalidInputError: Another task, nothing unknown or something else than `KINDS`, a scale
            beside unknown origins or joints that slide, or numbers that make no sense.
    """

    def __init__(
        self,
        task: Task | Robot,
        unknown: Sequence[str] = ("tool", "origins", "camera"),
        sd: Mapping[str, float] | None = None,
        noise: float = 2e-3,
        delay: float = 0.0,
        dt: float = 1e-3,
    ) -> None:
        self._remember(locals())
        task = PositionTask(task) if isinstance(task, Robot) else task
        points = _points(task)
        self.task = task
        self.unknown = _kinds(unknown)
        self.sd = _deviations(sd)
        self.noise = as_number("noise", noise, unit="m", above=0.0)
        self.delay = as_number("delay", delay, unit="s", minimum=0.0)
        as_number("dt", dt, unit="s", above=0.0)
        frames = list(dict.fromkeys(each.frame for each in points))
        self.regressor = regressor = KinematicRegressor(task.robot, frames)
        rows = ["xyz".index(axis) for each in points for axis in each.axes]
        self._rows = np.array(
            [
                3 * frames.index(each.frame) + "xyz".index(axis)
                for each in points
                for axis in each.axes
            ]
        )
        turns = "camera" in self.unknown
        axes = list(dict.fromkeys(rows)) if turns else sorted(set(rows))
        if turns and any(
            each.axes != points[0].axes or each.axes not in _TURNABLE for each in points
        ):
            raise InvalidInputError(
                f"a camera that may be turned needs the same axes of every point, one of "
                f"{', '.join(_TURNABLE)}, got {task!r}",
                given=task,
            )

        # p = offset(q) + Y(q)(θ_0 + S u)
        known = regressor.theta.copy()
        n_tool = 3 * len(frames)
        is_tool = np.arange(regressor.p) >= regressor.p - n_tool
        is_learnt = is_tool * ("tool" in self.unknown) | ~is_tool * ("origins" in self.unknown)
        columns = list(np.eye(regressor.p)[is_learnt])
        deviations = [self.sd["tool" if tool else "origins"] for tool in is_tool[is_learnt]]
        u_0, names = list(known[is_learnt]), [
            name for name, learnt in zip(regressor.names, is_learnt, strict=True) if learnt
        ]  # fmt: skip
        self._learnt_theta = np.flatnonzero(is_learnt)
        known[is_learnt] = 0.0
        self._is_scaled = "scale" in self.unknown
        if self._is_scaled:
            if "origins" in self.unknown or "m" in task.robot.joint_units:
                raise InvalidInputError(
                    "scale can be learnt only where the origins are known and no joint slides, "
                    f"got unknown = {self.unknown} for {task.robot.name}, where lengths and scale "
                    "are one",
                    given=unknown,
                )
            columns.append(known)
            u_0.append(1.0)
            names.append("scale")
            deviations.append(self.sd["scale"])
            known = np.zeros(regressor.p)
        self._known, self._S = known, np.array(columns).reshape(-1, regressor.p).T
        self._u_0, self._n_u = np.array(u_0), len(u_0)
        sd_u = np.array(deviations)
        has_offset = turns or "offset" in self.unknown
        self._d = len(axes)
        letters = ["xyz"[axis] for axis in axes]
        self._axis = np.array([axes.index(row) for row in rows])  # of each entry of x
        self._offsets = np.eye(self._d)[self._axis] if has_offset else np.zeros((task.m, 0))
        self._estimator: KnownCamera | UnknownCamera
        self._turns = turns
        if turns:
            names += [f"offset.{axis}" for axis in letters]
            names += [f"camera.r{axis}" for axis in "xyz"] if self._d == 3 else ["camera.turn"]
            self._estimator = UnknownCamera(
                self._u_0, sd_u, self._d, self.sd["offset"], self.sd["camera"], self.noise
            )
        else:
            names += [f"offset.{axis}" for axis in letters if has_offset]
            count = self._d if has_offset else 0
            self._estimator = KnownCamera(self._u_0, sd_u, count, self.sd["offset"], self.noise)
        self.names = tuple(names)
        self._spins = len(law.generators(self._d)) if turns else 0
        self._frames = Frames(task.robot, task.m, self.delay, dt)
        self._gate = Gate(task.robot, task.m)
        self._prior = np.concatenate([
            sd_u, np.full(self._offsets.shape[1], self.sd["offset"]),
            np.full(self._spins, self.sd["camera"]),
        ])  # fmt: skip
        self._spread = self._S * sd_u  # of θ, as it is believed
        m, n, dd = task.m, self._n_u, self._d**2 if turns else 0
        sizes = {
            "frames": self._frames.size, "gate": self._gate.size, "sums": self._estimator.size,
            "told": len(names), "integral": m, "averaged": m, "chi": 2, "time": 2,
            "u": n, "b": m, "R": dd, "u_dot": n, "b_dot": m, "spin": self._spins,
        }  # fmt: skip
        ends = np.cumsum(list(sizes.values()))
        self._at = {
            name: slice(end - size, end)
            for (name, size), end in zip(sizes.items(), ends.tolist(), strict=True)
        }
        self.n_state = int(ends[-1])

    def __repr__(self) -> str:
        return f"AdaptiveKinematics({self.task!r}, unknown={self.unknown})"

    # -- state ---------------------------------------------------------------------------

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,): what is believed.

        x̂ is the first x, where that is not lost, so that learning begins without a jump.
        """
        at, state = self._at, np.zeros(self.n_state)
        state[at["frames"]] = self._frames.initial(measurement)
        state[at["gate"]] = self._gate.initial()
        state[at["sums"]] = self._estimator.initial()
        state[at["u"]] = self._u_0
        state[at["chi"]] = 1.0, 0.0
        state[at["time"]] = measurement.t, measurement.t - 1.0
        if self._turns:
            state[at["R"]] = np.eye(self._d).ravel()
        p = self._positions(measurement.q, self._u_0)
        x = np.asarray(measurement.x)
        state[at["b"]] = np.where(np.isfinite(x), x - p, 0.0)
        state[at["told"]] = self._told(state[at["sums"]])
        return state

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later.

        A measurement whose x is lost, or was seen before, or that jumps, teaches nothing.
        """
        state = state.copy()
        numbers = state[self._at["frames"]]
        self._frames.remember(numbers, measurement)
        frame = self._frames.new(numbers, measurement)
        if frame is not None:
            believed, is_anew = self._gate.judge(state[self._at["gate"]], frame, self._reach)
            if believed:
                self._learn(state, frame, is_anew)
        self._smooth(state, measurement.q, dt)
        return state

    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt; shape (…, p).

        In the order of `names` [m; rad for the camera's rotation vector].
        """
        return state[..., self._at["told"]]

    # -- learning ------------------------------------------------------------------------

    def _learn(self, state: Array, frame: Frame, is_anew: bool) -> None:
        """Learn from a frame, in place."""
        at = self._at
        since = min(max(frame.t - state[at["time"]][0], 0.0), _LONGEST)
        sums = state[at["sums"]]
        if is_anew:
            sums = self._estimator.renewed(sums)
            state[at["integral"]] = 0.0
        share = -math.expm1(-_FORGETTING * since)
        Y = self.regressor.Y(frame.q)[self._rows]
        known = Y.dot(self._known) + self.regressor.offset(frame.q)[self._rows]
        H = np.concatenate([Y.dot(self._S), self._offsets], axis=1)
        seen = np.isfinite(frame.x)
        if self._turns:  # a point that is seen in part tells nothing of a rotation
            seen = np.repeat(seen.reshape(-1, self._d).all(axis=1), self._d)
            if not seen.any():
                return
        is_due = not 0.0 <= frame.t - state[at["time"]][1] < _BUSY
        sums = self._estimator.learn(sums, H[seen], known[seen], frame.x[seen], share, is_due)
        state[at["sums"]] = sums
        state[at["time"]][0] = frame.t
        if is_due:
            state[at["told"]] = self._told(sums)
            state[at["time"]][1] = frame.t
        # what is left of x: taken up by the integral, and averaged to be looked at
        u, R, b = self._estimator.estimate(sums)
        left = frame.x - self._turned(R, known + H[:, : self._n_u].dot(u)) - self._spread_b(b)
        integral = state[at["integral"]]
        integral[seen] += -math.expm1(-_INTEGRAL * since) * (left - integral)[seen]
        kept = -math.expm1(-since / _WINDOW)
        averaged = state[at["averaged"]]
        averaged[seen] += kept * (left - averaged)[seen]
        if kept > 0.0:
            chi = averaged[seen].dot(averaged[seen]) / seen.sum() * (2.0 - kept) / kept
            state[at["chi"]][:1] += -math.expm1(-since / _MEMORY) * (
                chi / self.noise**2 - state[at["chi"]][0]
            )
        state[at["chi"]][1] += since

    def _reach(self, q_0: Array, q: Array) -> Array:
        """Return how far each entry of x may move from one configuration to another, (m,) [m]."""
        moved = self.regressor.Y(q) - self.regressor.Y(q_0)
        known = moved.dot(self._known + self._S.dot(self._u_0))
        known = known + self.regressor.offset(q) - self.regressor.offset(q_0)
        unknown = moved.dot(self._spread)
        each = np.sqrt((known.reshape(-1, 3) ** 2).sum(axis=1))
        unsure = np.sqrt((unknown.reshape(len(each), -1) ** 2).sum(axis=1))
        most = 1.5 * each + 4.0 * unsure + 8.0 * self.noise
        return np.asarray(most[self._rows // 3])

    # -- the smoothed estimates ----------------------------------------------------------

    def _smooth(self, state: Array, q: Array, dt: float) -> None:
        """Let the smoothed estimates follow for dt [s], in place.

        u and R follow with the rate β, and the offset such that x̂ at q does. Together they are
        slower where x̂ or R would be fast, as after a restart.
        """
        at = self._at
        u, R, b = self._estimator.estimate(state[at["sums"]])  # copies
        if self._is_scaled:
            u[-1] = max(u[-1], _SMALLEST_SCALE)
        smooth_u, smooth_b = state[at["u"]], state[at["b"]]
        Y = self.regressor.Y(q)[self._rows]
        known = Y.dot(self._known) + self.regressor.offset(q)[self._rows]
        YS = Y.dot(self._S)
        p, smooth_p = known + YS.dot(u), known + YS.dot(smooth_u)
        away = self._turned(R, p) + self._spread_b(b) + state[at["integral"]]
        smooth_R = state[at["R"]].reshape(self._d, -1) if self._turns else R
        away -= self._turned(smooth_R, smooth_p) + smooth_b
        rate = min(_SMOOTHING, _EASED_SPEED / max(math.hypot(*away.tolist()), 1e-9))
        if self._turns:
            turn = law.rotation_log(R.dot(smooth_R.T))
            rate = min(rate, _EASED_TURN / max(math.hypot(*turn.tolist()), 1e-9))
        u_dot = rate * (u - smooth_u)
        moved = self._turned(smooth_R, YS.dot(u_dot))
        if self._turns:
            spin = rate * turn
            K = np.tensordot(spin, law.generators(self._d), 1)
            moved = moved + self._turned(K.dot(smooth_R), smooth_p)
            state[at["spin"]] = spin
            state[at["R"]] = law.rotation_exp(dt * spin).dot(smooth_R).ravel()
        b_dot = rate * away - moved
        state[at["u_dot"]], state[at["b_dot"]] = u_dot, b_dot
        smooth_u += dt * u_dot
        smooth_b += dt * b_dot

    def _turned(self, R: Array, p: Array) -> Array:
        """Return R p of each point, shape (m,)."""
        return np.asarray(p.reshape(-1, self._d).dot(R.T).ravel()) if self._turns else p

    def _spread_b(self, b: Array) -> Array:
        return np.asarray(self._offsets.dot(b))

    def _positions(self, q: Array, u: Array) -> Array:
        p = self.regressor.position(q, self._known + self._S.dot(u))
        return np.asarray(p[self._rows])

    # -- what was learnt -----------------------------------------------------------------

    def _told(self, sums: Array) -> Array:
        """Return what is learnt in the order of `names`."""
        u, R, b = self._estimator.estimate(sums)
        if self._is_scaled:
            u[:-1] /= u[-1]
        turn = law.rotation_log(R) if self._turns else np.zeros(0)
        return np.concatenate([u, b, turn])

    def report(self, state: Array) -> KinematicReport:
        """Return what a state has learnt: values, standard deviations, and what was not seen."""
        at = self._at
        told, first = self.learnt(state), np.zeros(len(self.names))
        first[: self._n_u] = self._u_0
        chi = float(state[at["chi"]][0])
        P = self._estimator.covariance(state[at["sums"]])
        share = 1.0 - P.diagonal() / self._prior**2
        P = P * max(chi, 1.0)
        if self._is_scaled:  # translations were learnt times the scale
            scale, n = told[self._n_u - 1], self._n_u - 1
            T = np.eye(len(P))
            T[:n, :n] /= scale
            T[:n, n] = -told[:n] / scale
            P = T.dot(P).dot(T.T)
        units = [
            "" if name == "scale" else "rad" if "camera" in name else "m" for name in self.names
        ]
        sd = np.sqrt(P.diagonal())
        columns = zip(
            self.names,
            units,
            first.tolist(),
            told.tolist(),
            sd.tolist(),
            share.tolist(),
            strict=True,
        )
        angle = float(np.linalg.norm(told[len(told) - self._spins :]))
        rows = tuple(LearntNumber(*row) for row in columns)
        return KinematicReport(rows, P, angle, chi, float(state[at["chi"]][1]))

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with the translations that a state has learnt."""
        theta = self.regressor.theta.copy()
        theta[self._learnt_theta] = self.learnt(state)[: len(self._learnt_theta)]
        return self.regressor.robot_with(theta)

    # -- prediction ----------------------------------------------------------------------

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> Prediction:
        """Return the predicted error, in the base's axes, at q (nq,) and q̇ (n_v,).

        z = R̂ᵀ(x̂ − x_d), with the smoothed estimates, and all that its derivatives need.
        """
        at, rows, m = self._at, self._rows, self.task.m
        theta = self._known + self._S.dot(state[at["u"]])
        motion = self.regressor.motion(q, v, theta, self._S.dot(state[at["u_dot"]]))
        p, J, J_dot, drift = (part[rows] for part in motion)
        x_d, v_d, a_d = target
        feed = np.zeros(m) if v_d is None else v_d
        feed_dot = np.zeros(m) if a_d is None else a_d
        away, b_dot = x_d - state[at["b"]], state[at["b_dot"]]
        if not self._turns:
            return Prediction(p - away, J, J_dot, feed, feed_dot, drift + b_dot)
        R = state[at["R"]].reshape(self._d, -1)
        # rows are vectors: x R is Rᵀx, and with R' = [ω]ₓR the rate of Rᵀ is −Rᵀ[ω]ₓ
        KR = np.tensordot(state[at["spin"]], law.generators(self._d), 1).dot(R)

        def back(vectors: Array, by: Array = R) -> Array:
            return np.asarray(vectors.reshape(-1, self._d).dot(by).ravel())

        return Prediction(
            p - back(away), J, J_dot, back(feed), back(feed_dot) + back(feed, KR),
            drift - back(away, KR) + back(b_dot),
        )  # fmt: skip


def _points(task: Task) -> list[PositionTask]:
    """Return the positions that a task is made of."""
    points: list[PositionTask] = []
    for each in task.tasks if isinstance(task, StackedTask) else [task]:
        if not isinstance(each, PositionTask):
            raise InvalidInputError(
                f"task must be a PositionTask, a StackedTask of them, or a Robot, got {task!r}",
                given=task,
            )
        points.append(each)
    return points


def _kinds(unknown: Any) -> tuple[str, ...]:
    kinds = (unknown,) if isinstance(unknown, str) else tuple(unknown)
    if not kinds or not all(kind in KINDS for kind in kinds):
        raise InvalidInputError(
            f"unknown must be one or more of {', '.join(KINDS)}, got {unknown!r}", given=unknown
        )
    return kinds


def _deviations(sd: Any) -> dict[str, float]:
    given = {} if sd is None else sd
    require("sd", given, Mapping, f"a mapping from some of {', '.join(USUAL_SD)} to numbers")
    for kind in given:
        if kind not in USUAL_SD:
            raise UnknownNameError("kind", kind, "sd", USUAL_SD)
    return {
        kind: as_number(f"sd of {kind}", given.get(kind, usual), above=0.0)
        for kind, usual in USUAL_SD.items()
    }
