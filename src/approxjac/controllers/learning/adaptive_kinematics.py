"""`AdaptiveKinematics`: tool, joint origins and camera, learnt from the measured x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import LONGEST_DELAY, is_rotation
from approxjac.controllers.learning.kinematic_estimators import (
    KnownCamera,
    UnknownCamera,
    tilted_axes,
)
from approxjac.controllers.learning.kinematic_frames import Frame, Frames, Gate, parts_of
from approxjac.controllers.learning.kinematic_report import KinematicReport, rows_of
from approxjac.controllers.learning.kinematic_unknowns import Unknowns
from approxjac.controllers.learning.predicted_error import Kinematics, PredictedError, pulled_back
from approxjac.interface import Measurement, Status, Target
from approxjac.robots import Robot
from approxjac.tasks import PositionTask, Task
from approxjac.validation import Array, as_number

_FORGETTING = 1.0 / 30.0  # λ [1/s]
_SMOOTHING = 20.0  # β [1/s]
_INTEGRAL = 1.0  # ω_b [1/s]
_EASED_SPEED = 0.5  # of x̂, by what is learnt [m/s]
_EASED_TURN = 2.0 * math.pi  # of the camera's estimate [rad/s]
_LONGEST = 0.1  # time that one frame counts for [s]
_JUMP = 8.0  # standard deviations of x
_WINDOW = 0.3  # over which residuals are averaged: noise goes, what is not explained stays [s]
_MEMORY = 15.0  # of χ² [s]
_NOISE_MEMORY = 2.0  # of the noise that is seen [s]
_CHANGED = 3e-3, 9.0  # averaged residual [m], and in its sd: another sensor or tool
_WORST = 4.0  # χ² above which no more is passed over
_BELIEVED = 5.0  # of frames after which what was learnt is a belief when learning begins anew [s]
_SMALLEST_SCALE = 0.1


class AdaptiveKinematics(Kinematics):
    """x̂ = R̂ p(q; θ̂) + b̂, learnt from the measured x while the arm moves.

    Learnt are the translations of the tool and of all joint origins, and rotation, offset and
    scale of a camera or tracker, as told. What the law controls is the *predicted* x̂, a known
    function of q, turned back into the base frame, so that no estimate of the camera makes Ĵ
    singular.

    With a rotation that is known it is recursive least squares with forgetting towards the prior
    (Theorem A): x̂ → x for any motion whatever, without excitation. With one that is not, it is the
    same over all rotations: all frames, not the last one only, say which one is right. An integral
    offset on x̂ takes up what the parameters do not explain.

    Frames are paired with the configuration at which they were taken, so delay and frame rate are
    outside the loop. A sensor that jumps is passed over. One that was moved is learnt anew, and so
    is a tool that slipped: what was learnt before is a belief then.

    Of a pose R̂_x = R̂ R_f(q) T̂ is learnt, too, the tool's rotation T̂ with that of the tracker.

    Args:
        task: A `PositionTask` or `TrackerTask` of the believed robot, or a `StackedTask` of them;
            a `PoseTask` or `PoseTrackerTask`; or the robot, for the position of its tip. A camera
            that may be turned needs two axes or three, the same of every point. Two turn in their
            plane.
        unknown: What may be wrong: "tool" and "origins" are translations, of a pose "tool" is its
            orientation, too; "camera" is rotation and offset, "offset" the offset alone; "scale"
            only of positions and where the origins are known.
        sd: Plausible errors: "tool", "origins" and "offset" [m], "orientation" of the tool and
            "camera" [rad], "scale"; by default 0.2, 0.02, 0.2, 1.0, 1.0 and 0.2.
        noise: Standard deviation of x [m].
        delay: Age of x where `Measurement.t_x` is None [s]. No frame that is older than 0.25 s, or
            than twice the delay, is learnt from.
        dt: Sampling time of control [s].
        angle_noise: Standard deviation of the orientation of a pose [rad].

    Attributes:
        regressor: p(q) of the points, linear in the translations.
        names: Names of what is learnt, such as "panda_joint4.x", "tool.x", "scale", "offset.y",
            "camera.rz", or "camera.turn" from the first axis to the second; of a pose "tool.rx",
            in the axes of the believed tool.

    Raises:
        InvalidInputError: Another task, nothing unknown or something else than that, a scale
            beside unknown origins or joints that slide, an sd of what is not unknown, or numbers
            that make no sense, such as milliseconds.
        UnknownNameError: An sd of something else.
    """

    def __init__(
        self,
        task: Task | Robot,
        unknown: Sequence[str] = ("tool", "origins", "camera"),
        sd: Mapping[str, float] | None = None,
        noise: float = 2e-3,
        delay: float = 0.0,
        dt: float = 1e-3,
        angle_noise: float = 5e-3,
    ) -> None:
        self._remember(locals())
        task = PositionTask(task) if isinstance(task, Robot) else task
        self.task, self.unknown = task, unknown
        self.noise = as_number("noise", noise, unit="m", above=0.0)
        angle_noise = as_number("angle_noise", angle_noise, unit="rad", above=0.0, most=1.0)
        self.delay = as_number("delay", delay, unit="s", minimum=0.0, most=LONGEST_DELAY)
        dt = as_number("dt", dt, unit="s", above=0.0)
        length = self.noise / angle_noise
        self._unknowns = unknowns = Unknowns(task, unknown, sd, length)
        as_number("noise", noise, unit="m", above=0.0, most=unknowns.largest_noise)
        self.regressor = unknowns.regressor
        self.names, self.units = unknowns.names, unknowns.units
        self._orientation = unknowns.orientation
        self._frames = Frames(task.robot, task.n_x, self.delay, dt)
        n_points = len(unknowns.points(np.zeros(task.n_x)))
        self._gate = Gate(task.robot, n_points, _JUMP * self.noise)
        kind = UnknownCamera if unknowns.turns else KnownCamera
        self._estimator: KnownCamera | UnknownCamera = kind(unknowns, self.noise)
        self._turns, self._d = unknowns.turns, unknowns.d
        self._is_turned, self._n_p = unknowns.is_turned, len(unknowns.constant)
        m, n, turns, n_p = task.m, unknowns.n_u, self._turns, self._n_p
        is_pose = self._orientation is not None
        sizes = {
            "frames": self._frames.size, "gate": self._gate.size, "sums": self._estimator.size,
            "told": len(self.names), "integral": m, "averaged": m, "left": m, "chi": 5, "time": 1,
            "placed": task.n_x, "u": n, "b": n_p, "R": self._d**2 if turns else 0,
            "T": 9 if is_pose else 0,
            "u_dot": n, "b_dot": n_p, "spin": len(law.generators(self._d)) if turns else 0,
            "T_spin": 3 if is_pose else 0,
        }  # fmt: skip
        self._at, self.n_state = parts_of(sizes)
        self._moving = slice(self._at["u"].start, self._at["b"].stop)
        self._rates = slice(self._at["u_dot"].start, self._at["b_dot"].stop)
        learnt = "sums told integral averaged left chi placed u b R T"
        self._kept = tuple(self._at[name] for name in learnt.split())

    def __repr__(self) -> str:
        return f"AdaptiveKinematics({self.task!r}, unknown={self.unknown})"

    # -- state ---------------------------------------------------------------------------

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,): what is believed.

        x̂ is the first x, so that learning begins without a jump; the first that is not lost.
        """
        at, state, unknowns = self._at, np.zeros(self.n_state), self._unknowns
        state[at["frames"]] = self._frames.initial(measurement)
        state[at["sums"]] = self._estimator.initial()
        state[at["told"]] = unknowns.believed
        state[at["chi"]] = 1.0, 0.0, 0.0, self.noise**2, 0.0
        state[at["time"]] = measurement.t
        state[at["u"]] = unknowns.Theta[: unknowns.n_u]
        if self._turns:
            state[at["R"]] = unknowns.R.ravel()
        offset = unknowns.offsets.dot(unknowns.Theta[unknowns.n_u :])
        state[at["b"]] = self._turned(unknowns.R, offset)
        if self._orientation is not None:
            state[at["T"]] = np.eye(3).ravel()
        frame = self._frames.first(measurement)
        if frame is not None:
            self._place(state, frame)
        return state

    def _place(self, state: Array, frame: Frame) -> None:
        """Let x̂ begin at the first x that is seen of each entry, in place."""
        at, (x, _, q), n_p = self._at, frame, self._n_p
        placed, R = state[at["placed"]], self._rotation(state)
        first = np.isfinite(x) & ~(placed > 0.0)
        if self._orientation is not None:
            T = self._orientation.first(q, x[3:], R)
            first[3:] &= T is not None
            if T is not None and first[3:].all():
                state[at["T"]] = T.ravel()
        H, known = self._unknowns.at(q)
        x_hat = self._turned(R, known + H.dot(state[at["u"]]))
        state[at["b"]][first[:n_p]] = (x[:n_p] - x_hat)[first[:n_p]]
        placed[first] = 1.0

    def status(self, state: Array, measurement: Measurement) -> Status:
        """Return what may be done by a state; see `Kinematics`."""
        has_begun = min(state[self._at["placed"]].tolist()) > 0.0
        return self._frames.status(state[self._at["frames"]], measurement, has_begun)

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later.

        A measurement whose x is lost, or was seen before, or that jumps, teaches nothing.
        """
        state = state.copy()
        self.go_on(state, measurement, dt)
        return state

    def go_on(self, state: Array, measurement: Measurement, dt: float) -> None:
        """Make a state that of `step`, in place."""
        self.notice(state, measurement, dt)
        self.advance(state, dt)

    def notice(self, state: Array, measurement: Measurement, dt: float) -> bool:
        """Take down a measurement, and learn from it, in place; the first half of `go_on`.

        Returns:
            Whether anything that `predict` and what follows go by has changed.
        """
        numbers = state[self._at["frames"]]
        measurement = self._frames.on_time(numbers, measurement, dt)
        is_time = self._frames.remember(numbers, measurement)
        frame = self._frames.new(numbers, measurement)
        if frame is not None:
            if not min(state[self._at["placed"]].tolist()) > 0.0:
                self._place(state, frame)
            frame = frame._replace(x=self._unknowns.points(frame.x))
            believed, is_anew = self._gate.judge(state[self._at["gate"]], frame, self._reach)
            if believed:
                self._learn(state, frame, is_anew)
                is_time = True
        if is_time:  # the rates of smoothed estimates may wait for some milliseconds
            self._aim(state, measurement.q, dt)
        return is_time or frame is not None

    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt; shape (…, p).

        In the order of `names` [m; rad for the camera's rotation vector].
        """
        return state[..., self._at["told"]]

    # -- learning ------------------------------------------------------------------------

    def _reach(self, q_0: Array, q: Array) -> Array:
        return self._unknowns.reach(q_0, q) + _JUMP * self.noise

    def _learn(self, state: Array, frame: Frame, is_anew: bool) -> None:
        """Learn from a frame, in place."""
        at, seen = self._at, np.isfinite(frame.x)
        if not seen.any():
            return
        since = min(max(frame.t - float(state[at["time"]][0]), 0.0), _LONGEST)
        sums, averaged, chi = state[at["sums"]], state[at["averaged"]], state[at["chi"]]
        kept = -math.expm1(-since / _WINDOW)
        noise = max(
            self.noise, math.sqrt(max(chi[3], 0.0))
        )  # as told, or as seen from frame to frame
        usual = noise * math.sqrt(kept / (2.0 - kept))  # of what noise leaves of an average
        # what was not explained all along is no news
        unexplained = math.sqrt(min(max(chi[0], 1.0), _WORST))
        changed = unexplained * max(_CHANGED[0], _CHANGED[1] * usual)
        is_anew = is_anew or bool(np.abs(averaged).max() > changed)
        if is_anew:  # what was learnt before is contradicted, as by a tool that slipped
            if chi[1] > _BELIEVED:
                sums = self._estimator.renewed(sums)
            else:  # a false start, of which χ² says nothing either
                sums, chi[0], chi[4] = self._estimator.initial(), 1.0, 0.0
            state[at["integral"]] = averaged[:] = 0.0
            chi[1:3] = 0.0, chi[2] + 1.0
        H, known = self._unknowns.regression(frame.q)
        T = self._unknowns.tilts(frame.q, state[at["u"]])
        some = slice(None) if seen.all() else seen
        share = -math.expm1(-_FORGETTING * since)
        sums = self._estimator.learn(sums, H[some], T[some], known[some], frame.x[some], share)
        state[at["sums"]] = sums
        state[at["time"]] = frame.t
        Theta, R = self._estimator.estimate(sums)
        state[at["told"]] = self._unknowns.told(Theta, R)
        # what is left of x: taken up by the integral, and averaged to be looked at
        left = self._unknowns.left(frame.x, self._turned(R, known + H.dot(Theta)))
        seen = np.isfinite(left)
        left, integral = left[seen], state[at["integral"]]
        integral[seen] += -math.expm1(-_INTEGRAL * since) * (left - integral[seen])
        averaged[seen] += kept * (left - averaged[seen])
        change = left - state[at["left"]][seen]
        state[at["left"]][seen] = left
        if kept > 1e-12:  # time has passed
            chi[[1, 4]] += since
            now = averaged[seen].dot(averaged[seen]) / (len(left) * usual**2)
            chi[0] += since / min(chi[4] + 1.0, _MEMORY) * (now - chi[0])
            seen_now = 0.5 * change.dot(change) / len(left)
            chi[3] += since / min(chi[1] + 0.3, _NOISE_MEMORY) * (seen_now - chi[3])

    # -- the smoothed estimates ----------------------------------------------------------

    def _aim(self, state: Array, q: Array, dt: float) -> None:
        """Set the rates at which the smoothed estimates follow, in place.

        u and R follow with the rate β, and the offset such that x̂ at q does; of a pose so does T.
        All are slower where x̂ or R would be fast, as after a restart.
        """
        at, n = self._at, self._unknowns.n_u
        Theta, R = self._estimator.estimate(state[at["sums"]])
        u, smooth_u = Theta[:n], state[at["u"]]
        if self._unknowns.has_scale:
            u[-1] = max(u[-1], _SMALLEST_SCALE)
        H, known = self._unknowns.at(q)
        smooth_p, smooth_R = known + H.dot(smooth_u), self._rotation(state)
        p = known + H.dot(u) + self._unknowns.offsets.dot(Theta[n:])
        integral, n_p = state[at["integral"]], self._n_p
        away = self._turned(R, p) + integral[:n_p]
        away -= self._turned(smooth_R, smooth_p) + state[at["b"]]
        rate = min(_SMOOTHING, _EASED_SPEED / max(math.hypot(*away.tolist()), 1e-9), 0.5 / dt)
        turn = law.rotation_log(R.dot(smooth_R.T)) if self._turns else np.zeros(3)
        rate = min(rate, _EASED_TURN / max(math.hypot(*turn.tolist()), 1e-9))
        if self._orientation is not None:
            T, T_goal = state[at["T"]].reshape(3, 3), self._unknowns.tool(state[at["told"]])
            smooth, goal = (smooth_R, T), (R, T_goal)
            apart, back = self._orientation.apart(q, smooth, goal, integral[n_p:])
            rate = min(rate, _EASED_TURN / max(math.hypot(*apart.tolist()), 1e-9))
            state[at["T_spin"]] = rate * back.dot(apart - turn)
        if self._turns:
            state[at["spin"]] = spin = rate * turn
        u_dot = rate * (u - smooth_u)
        b_dot = rate * away - self._turned(smooth_R, H.dot(u_dot))
        if self._turns:
            b_dot -= self._turned(law.cross_matrix(spin).dot(smooth_R), smooth_p)
        state[at["u_dot"]], state[at["b_dot"]] = u_dot, b_dot

    def advance(self, state: Array, dt: float) -> None:
        """Let the smoothed estimates follow for dt [s], in place."""
        at = self._at
        state[self._moving] += dt * state[self._rates]
        if self._turns:
            turned = law.rotation_exp(dt * state[at["spin"]]).dot(self._rotation(state))
            state[at["R"]] = turned.ravel()
        if self._orientation is not None:
            T = law.rotation_exp(dt * state[at["T_spin"]]).dot(state[at["T"]].reshape(3, 3))
            state[at["T"]] = T.ravel()

    def _rotation(self, state: Array) -> Array:
        """Return the smoothed rotation of the base's axes in the sensor's, (d, d)."""
        if not self._turns:
            return self._unknowns.R
        return np.asarray(state[self._at["R"]].reshape(self._d, self._d))

    def _turned(self, R: Array, p: Array) -> Array:
        """Return R p of each point, shape (m,)."""
        return np.asarray(p.reshape(-1, self._d).dot(R.T).ravel()) if self._is_turned else p

    # -- prediction ----------------------------------------------------------------------

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error, in the base's axes, at q (nq,) and q̇ (n_v,).

        z = R̂ᵀ(x̂ − x_d), with the smoothed estimates, and all that its derivatives need.
        """
        if self._orientation is None:
            return self._positions(state, q, v, target)
        at, T = self._at, state[self._at["T"]].reshape(3, 3)
        x_d, v_d, a_d = target
        rates = [(None, None) if rate is None else (rate[:3], rate[3:]) for rate in (v_d, a_d)]
        (v_p, v_r), (a_p, a_r) = rates
        R, spin = self._rotation(state), state[at["spin"]] if self._turns else np.zeros(3)
        positions = self._positions(state, q, v, Target(x_d[:3], v_p, a_p))
        turns = self._orientation.predict(
            q, v, Target(x_d[3:], v_r, a_r), T, state[at["T_spin"]], R, spin
        )
        return PredictedError(*map(np.concatenate, zip(positions, turns, strict=True)))

    def _positions(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error of positions."""
        at, unknowns = self._at, self._unknowns
        theta, theta_dot = unknowns.translations(state[at["u"]]), unknowns.rates(state[at["u_dot"]])
        motion = self.regressor.motion(q, v, theta, theta_dot)
        b, b_dot = state[at["b"]], state[at["b_dot"]]
        R = self._rotation(state) if self._is_turned else None
        spin = state[at["spin"]]
        return pulled_back(self._unknowns.seen(motion), b, b_dot, R, spin, target)

    # -- what was learnt -----------------------------------------------------------------

    def _is_state(self, state: Array) -> bool:
        sums = state[self._at["sums"]]
        return is_rotation(self._rotation(state)) and self._estimator.are_numbers(sums)

    def report(self, state: Array) -> KinematicReport:
        """Return what a state has learnt: values, standard deviations, and what was not seen."""
        at, unknowns, state = self._at, self._unknowns, self._required(state)
        told = self.learnt(state)
        chi, seconds, restarts, variance, _ = state[at["chi"]].tolist()
        Theta, _ = self._estimator.estimate(state[at["sums"]])
        P = unknowns.merged(self._estimator.covariance(state[at["sums"]]), Theta)
        share = 1.0 - P.diagonal() / unknowns.sd**2
        P = P * (max(chi, 1.0) * max(1.0, variance / self.noise**2))
        P = unknowns.unscaled(P, told)
        rows = rows_of(self.names, unknowns.units, unknowns.believed, told, P, share)
        turn = told[len(P) - len(state[at["spin"]]) :]
        angle, noise = math.hypot(*turn.tolist()), (self.noise, math.sqrt(variance))
        found, scale = self._estimator.tilts(state[at["sums"]]), (self.noise / max(noise)) ** 2
        axes = tilted_axes(found, self.regressor.turning, scale)
        times = seconds, int(restarts), "m", self._frames.silence(state[at["frames"]])
        last = self.regressor.movers[-1]
        return KinematicReport(rows, P, angle, chi, axes, noise, *times, last)

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and origins."""
        theta, told = self.regressor.theta.copy(), self.learnt(self._required(state))
        n = len(self._unknowns.of_theta)
        theta[self._unknowns.of_theta] = told[:n]
        turn = told[n : n + 3] if self._unknowns.n_t else None
        return self.regressor.robot_with(theta, turn)
