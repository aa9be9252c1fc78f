"""`AdaptiveKinematics`: tool, joint origins and camera, learnt from the measured x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers.arguments import LONGEST_DELAY, chosen_kinds, is_rotation
from approxjac.controllers.learning.estimator import (
    EASED_SPEED,
    EASED_TURN,
    INTEGRAL,
    JUMP,
    LONGEST_FRAME,
    NOISE_MEMORY,
    SMOOTHING,
    WINDOW,
    Estimator,
    Frame,
    Frames,
    Gate,
    PredictedError,
    pulled_back,
)
from approxjac.controllers.learning.kinematic_report import KinematicReport, rows_of
from approxjac.controllers.learning.least_squares import (
    KnownCamera,
    UnknownCamera,
    tilted_axes,
)
from approxjac.controllers.learning.unknowns import KINDS, Unknowns
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.robots import Robot
from approxjac.tasks import ImageTask, PositionTask, Task
from approxjac.validation import Array, as_number, require

_FORGETTING = 1.0 / 30.0  # λ [1/s]
_MEMORY = 15.0  # of χ² [s]
_CHANGED = 3e-3, 9.0  # averaged residual [m], and in its sd: another sensor or tool
_WORST = 4.0  # χ² above which no more is passed over
_BELIEVED = 5.0  # of frames after which what was learnt is a belief when learning begins anew [s]
_SMALLEST_SCALE = 0.1
_NO_TIME = 1e-12  # of an average's share


class AdaptiveKinematics(Estimator):
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
        self._gate = Gate(task.robot, n_points, JUMP * self.noise)
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
        self._lay_out(sizes, "sums told integral averaged left chi placed u b R T", "u b")
        turning = (("R", "spin"), ("T", "T_spin"))
        self._turning = tuple(pair for pair in turning if sizes[pair[0]])

    def __repr__(self) -> str:
        return f"AdaptiveKinematics({self.task!r}, unknown={self.unknown})"

    # -- learning ------------------------------------------------------------------------

    def _points(self, x: Array) -> Array:
        return self._unknowns.points(x)

    def _begin(self, state: Array) -> None:
        at, unknowns = self._at, self._unknowns
        state[at["sums"]] = self._estimator.initial()
        state[at["told"]] = unknowns.believed
        state[at["chi"]] = 1.0, 0.0, 0.0, self.noise**2, 0.0
        state[at["time"]] = self._frames.last_time(state[at["frames"]])
        state[at["u"]] = unknowns.Theta[: unknowns.n_u]
        if self._turns:
            state[at["R"]] = unknowns.R.ravel()
        offset = unknowns.offsets.dot(unknowns.Theta[unknowns.n_u :])
        state[at["b"]] = self._turned(unknowns.R, offset)
        if self._orientation is not None:
            state[at["T"]] = np.eye(3).ravel()

    def _has_begun(self, state: Array) -> Any:
        return law.all_of(state[self._at["placed"]] > 0.0)

    def _place(self, state: Array, frame: Frame) -> None:
        at, (x, _, q), n_p = self._at, frame, self._n_p
        R = self._rotation(state)
        first = np.isfinite(x) & ~(state[at["placed"]] > 0.0)
        if self._orientation is not None:
            T, is_seen = self._orientation.first(q, x[3:], R)
            first[3:] = first[3:] & is_seen
            state[at["T"]] = np.where(law.all_of(first[3:]), T.ravel(), state[at["T"]])
        H, known = self._unknowns.at(q)
        x_hat = self._turned(R, known + H.dot(state[at["u"]]))
        state[at["b"]] = np.where(first[:n_p], x[:n_p] - x_hat, state[at["b"]])
        state[at["placed"]] = np.where(first, 1.0, state[at["placed"]])

    def _reach(self, q_0: Array, q: Array) -> Array:
        return self._unknowns.reach(q_0, q) + JUMP * self.noise

    def _correct(self, state: Array, frame: Frame, is_anew: Any) -> None:
        at, unknowns, x = self._at, self._unknowns, frame.x
        averaged, chi = state[at["averaged"]], state[at["chi"]]
        since = np.minimum(np.maximum(frame.t - state[at["time"]][0], 0.0), LONGEST_FRAME)
        kept = -np.expm1(-since / WINDOW)
        # as it was said, or as seen from frame to frame
        noise = np.maximum(self.noise, np.sqrt(np.maximum(chi[3], 0.0)))
        usual = noise * np.sqrt(kept / (2.0 - kept))  # of what noise leaves of an average
        # what was not explained all along is no news
        unexplained = np.sqrt(np.minimum(np.maximum(chi[0], 1.0), _WORST))
        changed = unexplained * np.maximum(_CHANGED[0], _CHANGED[1] * usual)
        is_anew = is_anew | (np.abs(averaged).max() > changed)
        law.alter(is_anew, state, self._renew)
        H, known = unknowns.regression(frame.q)
        H_T = np.concatenate([H, unknowns.tilts(frame.q, state[at["u"]])], axis=1)
        seen, z, o = np.isfinite(x), x, known
        if not law.surely(law.all_of(seen)):  # what is lost has no part in the sums
            z, o = np.where(seen, x, 0.0), np.where(seen, known, 0.0)
            H_T = np.where(seen[:, np.newaxis], H_T, 0.0)
        share = -np.expm1(-_FORGETTING * since)
        sums = self._estimator.learn(state[at["sums"]], H_T, o, z, share)
        state[at["sums"]] = sums
        state[at["time"]] = frame.t
        Theta, R = self._estimator.estimate(sums)
        state[at["told"]] = unknowns.told(Theta, R)
        # what is left of x: taken up by the integral, and averaged to be looked at
        left = unknowns.left(x, self._turned(R, known + H.dot(Theta)))
        seen = np.isfinite(left)
        n, before = np.where(seen, 1.0, 0.0).sum(), state[at["left"]]
        integral = state[at["integral"]]
        integral += np.where(seen, -np.expm1(-INTEGRAL * since) * (left - integral), 0.0)
        averaged += np.where(seen, kept * (left - averaged), 0.0)
        change = np.where(seen, left - before, 0.0)
        square = (np.where(seen, averaged, 0.0) ** 2).sum()
        state[at["left"]] = np.where(seen, left, before)

        def look(chi: Array) -> None:
            """Average what is left, as time has passed."""
            chi[1] += since
            chi[4] += since
            now = square / (n * usual**2)
            chi[0] += since / np.minimum(chi[4] + 1.0, _MEMORY) * (now - chi[0])
            seen_now = 0.5 * change.dot(change) / n
            chi[3] += since / np.minimum(chi[1] + 0.3, NOISE_MEMORY) * (seen_now - chi[3])

        law.alter(kept > _NO_TIME, chi, look)

    def _renew(self, state: Array) -> None:
        """Begin anew where what was learnt is contradicted, as by a tool that slipped, in place."""
        at = self._at
        sums, chi = state[at["sums"]], state[at["chi"]]
        was_learnt = chi[1] > _BELIEVED  # or it was a false start, of which χ² says nothing either
        initial = self._estimator.initial()
        state[at["sums"]] = np.where(was_learnt, self._estimator.renewed(sums), initial)
        chi[0], chi[4] = law.select(was_learnt, chi[0], 1.0), law.select(was_learnt, chi[4], 0.0)
        chi[1], chi[2] = 0.0, chi[2] + 1.0
        state[at["integral"]] = state[at["averaged"]] = 0.0

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
            u[-1] = np.maximum(u[-1], _SMALLEST_SCALE)
        H, known = self._unknowns.at(q)
        smooth_p, smooth_R = known + H.dot(smooth_u), self._rotation(state)
        p = known + H.dot(u) + self._unknowns.offsets.dot(Theta[n:])
        integral, n_p = state[at["integral"]], self._n_p
        away = self._turned(R, p) + integral[:n_p]
        away = away - (self._turned(smooth_R, smooth_p) + state[at["b"]])
        rate = np.minimum(_eased(EASED_SPEED, away), min(SMOOTHING, 0.5 / dt))
        turn = law.rotation_log(R.dot(smooth_R.T)) if self._turns else np.zeros(3)
        if self._turns:
            rate = np.minimum(rate, _eased(EASED_TURN, turn))
        if self._orientation is not None:
            T, T_goal = state[at["T"]].reshape(3, 3), self._unknowns.tool(state[at["told"]])
            smooth, goal = (smooth_R, T), (R, T_goal)
            apart, back = self._orientation.apart(q, smooth, goal, integral[n_p:])
            rate = np.minimum(rate, _eased(EASED_TURN, apart))
            state[at["T_spin"]] = rate * back.dot(apart - turn)
        u_dot = rate * (u - smooth_u)
        b_dot = rate * away - self._turned(smooth_R, H.dot(u_dot))
        if self._turns:
            state[at["spin"]] = spin = rate * turn
            b_dot = b_dot - self._turned(law.cross_matrix(spin).dot(smooth_R), smooth_p)
        state[at["u_dot"]], state[at["b_dot"]] = u_dot, b_dot

    def _rotation(self, state: Array) -> Array:
        """Return the smoothed rotation of the base's axes in the sensor's, (d, d)."""
        if not self._turns:
            return self._unknowns.R
        return state[self._at["R"]].reshape(self._d, self._d)

    def _turned(self, R: Array, p: Array) -> Array:
        """Return R p of each point, shape (m,)."""
        return p.reshape(-1, self._d).dot(R.T).ravel() if self._is_turned else p

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


def _eased(fastest: float, away: Array) -> Any:
    """Return the rate at which what is away by so much goes no faster than that."""
    return fastest / np.maximum(law.length(away), 1e-9)


class AdaptivePlanarCamera(AdaptiveKinematics):
    """x̂ = m R̂ p(q; θ̂) + d̂, learnt from the image in a `PlanarCamera` while the arm moves.

    It is `AdaptiveKinematics` of the position in the arm's plane, with x as the believed camera
    would locate it. A wrong magnification m is learnt as lengths that are wrong by its factor:
    images tell the two from each other by nothing.

    Args:
        task: An `ImageTask` of the believed robot with a `PlanarCamera`, for one frame's origin.
        unknown: As of `AdaptiveKinematics`; "camera" is roll and offset.
        sd: As of `AdaptiveKinematics`, in the arm's plane. By default "tool" and "origins" are as
            wrong as magnification and lengths may be: 0.5 m.
        noise: Standard deviation of x [m on the sensor].
        delay: Age of x where `Measurement.t_x` is None [s].
        dt: Sampling time of control [s].

    Attributes:
        names: Names of what is learnt, such as "joint2.x", "offset.x" and "camera.turn", from the
            believed camera to the learnt one.

    Raises:
        InvalidInputError: Another task, or as `AdaptiveKinematics`.
        UnknownNameError: As `AdaptiveKinematics`.
    """

    def __init__(
        self,
        task: ImageTask,
        unknown: Sequence[str] = ("tool", "origins", "camera"),
        sd: Mapping[str, float] | None = None,
        noise: float = 2e-5,
        delay: float = 0.0,
        dt: float = 1e-3,
    ) -> None:
        given = locals()
        require("task", task, ImageTask, "an ImageTask of the believed robot")
        camera = task.camera
        if not isinstance(camera, PlanarCamera) or task.frame is None or task.points.any():
            raise InvalidInputError(
                f"task must be an ImageTask of a frame's origin in a PlanarCamera, got {task!r}; "
                "AdaptiveCamera is for a PinholeCamera",
                given=task,
            )
        noise = as_number("noise", noise, unit="m", above=0.0)
        m = camera.magnification
        kinds = chosen_kinds(unknown, KINDS)
        usual = {kind: 0.5 for kind in kinds if kind in ("tool", "origins")}
        position = PositionTask(task.robot, task.frame, axes=camera.plane)
        usual = usual if sd is None else sd  # type: ignore[assignment]
        super().__init__(position, unknown, usual, noise / m, delay, dt)
        self._m = m
        vars(self)["task"] = task  # in place of the position
        self._remember(given)
        c, s = np.cos(camera.roll), np.sin(camera.roll)
        self._seen_R, self._seen_d = np.array([[c, s], [-s, c]]), np.asarray(camera.offset)

    def __repr__(self) -> str:
        return f"AdaptivePlanarCamera({self.task!r}, unknown={self.unknown})"

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,), turned into the base's axes.

        In the size that it has on the sensor of the believed camera [m].
        """
        x_d, *rates = target
        rates = [None if rate is None else rate.dot(self._seen_R) / self._m for rate in rates]
        located = Target((x_d - self._seen_d).dot(self._seen_R) / self._m, *rates)
        found = super().predict(state, q, v, located)
        return PredictedError(*(self._m * each for each in found))

    def _own(self, measurement: Measurement) -> Measurement:
        """Return a measurement with x in the arm's plane, as the believed camera has it."""
        x = (measurement.x - self._seen_d).dot(self._seen_R) / self._m
        return measurement._replace(x=x)
