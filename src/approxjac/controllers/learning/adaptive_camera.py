"""`AdaptiveCamera`: where points are and what sees them, learnt from their images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from approxjac import law
from approxjac.cameras import PinholeCamera
from approxjac.controllers.arguments import LONGEST_DELAY, is_rotation
from approxjac.controllers.learning.camera_unknowns import CameraUnknowns
from approxjac.controllers.learning.image_estimator import ImageEstimate, ImageEstimator
from approxjac.controllers.learning.image_rays import ImageRays
from approxjac.controllers.learning.kinematic_frames import Frame, Frames, Gate, parts_of
from approxjac.controllers.learning.kinematic_report import KinematicReport, TiltedAxes, rows_of
from approxjac.controllers.learning.predicted_error import Kinematics, PredictedError
from approxjac.interface import Measurement, Status, Target
from approxjac.robots import Robot
from approxjac.tasks import ImageTask
from approxjac.tasks.analysis import seen_configurations
from approxjac.validation import Array, as_number

_SMOOTHING = 20.0  # β [1/s]
_INTEGRAL = 1.0  # ω_b [1/s]
_EASED_SPEED = 0.5  # of the predicted points beside their rays, by what is learnt [m/s]
_EASED_TURN = 2.0 * math.pi  # of the camera's estimate [rad/s]
_LONGEST = 0.1  # time that one frame counts for [s]
_WINDOW = 0.3  # over which residuals are averaged: noise goes, what is not explained stays [s]
_CHANGED = 10.0  # averaged residual, in standard deviations of x: another camera or tool
_SETTLED = 1.0  # after which what is learnt explains x, if χ² is below the next number [s]
_EXPLAINED = 4.0
_NOISE_MEMORY = 2.0  # of the noise that is seen [s]
_JUMP = 8.0  # standard deviations of x
_MOVES = 2.0  # times as far as believed, and four standard deviations: what is no jump


class AdaptiveCamera(Kinematics):
    """x̂ = π(R̂(r(q; û) − p̂); f̂), learnt from the images of points while the arm moves.

    Learnt are where the points are on the tool, the camera's pose and focal length, and the origins
    of the joints if told. A camera in the world watches points of the robot; one that the robot
    carries watches points of the world. Depth is not measured: it is what explains how images move.

    What the law controls is how far each point is beside the ray of its target, at its predicted
    depth Ẑ: z = (f₀/Z₀) Ẑ(ρ̂ − ρ_d), with ρ the ray (X/Z, Y/Z) and the believed f₀ over a usual
    depth Z₀, which makes pixels of it. It is [I, −ρ_d] times the point in the camera's axes, so
    that Ĵ is as regular as the arm's own, on the way through any roll and even where the camera is
    believed behind the points. z = 0 where x̂ = x_d.

    Frames are paired with the configuration at which they were taken, so delay and frame rate are
    outside the loop. Points that jump are passed over; a camera that was moved, or a tool that
    slipped, is learnt anew. A camera that is believed rolled, or on another side of the arm, is
    found from how images move; nothing proves that it always is.

    Args:
        task: An `ImageTask` of the believed robot with a `PinholeCamera`, as it is believed. Its
            center and distortion are taken for true. Of a tag take three corners, `points[:3]`.
        unknown: What may be wrong: "tool", or "points" of the world, where what is watched is, all
            by one translation; "origins" of the joints; "camera", its position and rotation;
            "focal_length". By default all but the origins.
        sd: Plausible errors: "tool", "points", "origins" and "position" of the camera [m], its
            "rotation" [rad], and of "focal_length" the logarithm; by default 0.2, 0.2, 0.02, 0.5,
            1.0 and 0.3.
        noise: Standard deviation of x [px].
        delay: Age of x where `Measurement.t_x` is None [s]. No frame that is older than 0.25 s, or
            than twice the delay, is learnt from.
        dt: Sampling time of control [s].

    Attributes:
        names: Names of what is learnt, such as "tool.x", "points.x", "camera.x", "camera.rz" (of
            the rotation from the believed camera's axes to the learnt one's, in the believed one's)
            and "focal_length" [px].

    Raises:
        InvalidInputError: Another task or camera, nothing unknown or something else than that, or
            numbers that make no sense.
        UnknownNameError: An sd of something else.
    """

    def __init__(
        self,
        task: ImageTask,
        unknown: Sequence[str] | None = None,
        sd: Mapping[str, float] | None = None,
        noise: float = 0.5,
        delay: float = 0.0,
        dt: float = 1e-3,
    ) -> None:
        self._remember(locals())
        self._unknowns = unknowns = CameraUnknowns(task, unknown, sd)
        self.task, self.unknown = task, unknowns.kinds
        self.names, self.units = unknowns.names, unknowns.units
        self.noise = as_number("noise", noise, unit="px", above=0.0)
        self.delay = as_number("delay", delay, unit="s", minimum=0.0, most=LONGEST_DELAY)
        dt = as_number("dt", dt, unit="s", above=0.0)
        self._points, self._believed = unknowns.points, unknowns.believed
        self._k, n = self._points.k, len(self._believed.u)
        self._camera = camera = unknowns.camera
        self._rays, self._f = ImageRays(camera), np.asarray(camera.focal_length)
        noise_of_rays = self.noise / self._f
        estimator = ImageEstimator(self._believed, unknowns.sd, noise_of_rays, self._k)
        self._estimator, self._told = estimator, estimator.sd > 0.0
        self._frames = Frames(task.robot, task.m, self.delay, dt)
        self._gate = Gate(task.robot, task.m)
        seen = seen_configurations(task, 20)
        self._usual_depth = float(np.median([task.depths(q) for q in seen]))
        self._scale = self._f / self._usual_depth
        m = task.m
        sizes = {
            "frames": self._frames.size, "gate": self._gate.size, "keys": estimator.size,
            "told": len(self.names), "integral": m, "averaged": m, "left": m, "seen": 4, "time": 1,
            "u": n, "R": 9, "t": 3, "stretch": 1, "b": m,
            "u_dot": n, "spin": 3, "t_dot": 3, "stretch_dot": 1, "b_dot": m,
        }  # fmt: skip
        self._at, self.n_state = parts_of(sizes)
        learnt = "keys told integral averaged left seen u R t stretch b"
        self._kept = tuple(self._at[name] for name in learnt.split())

    def __repr__(self) -> str:
        return f"AdaptiveCamera({self.task!r}, unknown={self.unknown})"

    # -- state ---------------------------------------------------------------------------

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,): what is believed.

        The camera is believed where it sees the first x that is not lost.
        """
        at, state = self._at, np.zeros(self.n_state)
        measurement = self._rays.of_measurement(measurement)
        state[at["frames"]] = self._frames.initial(measurement)
        state[at["keys"]] = self._estimator.initial()
        state[at["time"]] = measurement.t
        state[at["seen"]] = 0.0, 0.0, self.noise**2, 0.0
        self._place(state, self._frames.first(measurement))
        return state

    def _place(self, state: Array, frame: Frame | None) -> None:
        """Let the camera, and what is controlled, begin where it sees a first frame, in place."""
        at, numbers = self._at, state[self._at["keys"]]
        y = None if frame is None else self._rays.at(frame.x)
        if frame is not None and y is not None and np.isfinite(y).all(axis=1).any():
            H, o = self._points.at(frame.q)
            numbers = self._estimator.renewed(self._estimator.learn(numbers, H, o, y))
            numbers[-2] = 1e-12  # the camera was placed
            state[at["keys"]] = numbers
        u, R, p, stretch = estimate = self._estimator.estimate(numbers)
        state[at["told"]] = self._in_order(estimate)
        state[at["u"]], state[at["R"]], state[at["t"]] = u, R.ravel(), -R.dot(p)
        state[at["stretch"]] = stretch

    def status(self, state: Array, measurement: Measurement) -> Status:
        """Return what may be done by a state; see `Kinematics`."""
        has_begun = self._estimator.has_begun(state[self._at["keys"]])
        return self._frames.status(state[self._at["frames"]], measurement, has_begun)

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later.

        A measurement whose x is lost, or was seen before, or that jumps, teaches nothing.
        """
        state, measurement = state.copy(), self._rays.of_measurement(measurement)
        numbers = state[self._at["frames"]]
        measurement = self._frames.on_time(numbers, measurement, dt)
        is_time = self._frames.remember(numbers, measurement)
        frame = self._frames.new(numbers, measurement)
        if frame is not None:
            if not self._estimator.has_begun(state[self._at["keys"]]):
                self._place(state, frame)
            believed, is_anew = self._gate.judge(state[self._at["gate"]], frame, self._reach)
            if believed:
                self._learn(state, frame, is_anew)
                is_time = True
        if is_time:  # the rates of smoothed estimates may wait for some milliseconds
            self._aim(state, measurement.q, dt)
        self._advance(state, dt)
        return state

    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt; shape (…, p).

        In the order of `names` [m, rad, px].
        """
        return state[..., self._at["told"]]

    def _in_order(self, estimate: ImageEstimate) -> Array:
        """Return what is learnt in the order of `names`."""
        turn = law.rotation_log(self._believed.R.dot(estimate.R.T))
        f = self._f[0] * math.exp(estimate.stretch)
        return np.concatenate([estimate.u, estimate.p, turn, [f]])[self._told]

    # -- learning ------------------------------------------------------------------------

    def _reach(self, q_0: Array, q: Array) -> Array:
        """Return how far each entry of w may move from one configuration to another, (m,)."""
        (H_0, o_0), (H, o) = self._points.at(q_0), self._points.at(q)
        u = self._believed.u
        known = np.linalg.norm(o + H.dot(u) - o_0 - H_0.dot(u), axis=1)
        unsure = self._unknowns.unsure(H - H_0)
        rays = (_MOVES * known + 4.0 * unsure) * _MOVES / self._usual_depth
        return np.asarray(np.repeat(rays, 2) + _JUMP * self.noise / self._f.min())

    def _learn(self, state: Array, frame: Frame, is_anew: bool) -> None:
        """Learn from a frame, in place."""
        at, estimator = self._at, self._estimator
        since = min(max(frame.t - float(state[at["time"]][0]), 0.0), _LONGEST)
        state[at["time"]] = frame.t
        H, o = self._points.at(frame.q)
        y, keys = self._rays.at(frame.x), state[at["keys"]]
        seen = np.isfinite(y).all(axis=1)
        if not seen.any():
            return
        # seconds, restarts, variance of x [px²], and whether it was explained
        noted, averaged = state[at["seen"]], state[at["averaged"]].reshape(-1, 2)
        unlike = bool(np.abs(averaged * self._f).max() > _CHANGED * self.noise)
        if is_anew or (unlike and noted[3]):  # what was learnt before is contradicted
            keys = estimator.renewed(keys)
            state[at["integral"]] = averaged[:] = 0.0
            noted[0], noted[1], noted[3] = 0.0, noted[1] + 1.0, 0.0
        state[at["keys"]] = keys = estimator.learn(keys, H, o, y)
        u, R, p, stretch = estimate = estimator.estimate(keys)
        state[at["told"]] = self._in_order(estimate)
        c = (o + H.dot(u) - p).dot(R.T)
        seen &= c[:, 2] > self._camera.near  # others have no image, as far as is known
        left = np.zeros_like(y)
        left[seen] = y[seen] - law.rays(c[seen], math.exp(stretch))
        integral = state[at["integral"]].reshape(-1, 2)
        integral[seen] += -math.expm1(-_INTEGRAL * since) * (left[seen] - integral[seen])
        averaged[seen] += -math.expm1(-since / _WINDOW) * (left[seen] - averaged[seen])
        before = state[at["left"]].reshape(-1, 2)
        change = (left - before) * self._f * seen[:, np.newaxis]
        before[seen] = left[seen]
        noted[0] += since
        if noted[0] > _SETTLED and estimator.chi_squared(keys) < _EXPLAINED:
            noted[3] = 1.0
        share = since / min(noted[0] + 0.3, _NOISE_MEMORY)
        noted[2] += share * (0.25 * float((change * change).sum()) / max(seen.sum(), 1) - noted[2])

    # -- the smoothed estimates ----------------------------------------------------------

    def _aim(self, state: Array, q: Array, dt: float) -> None:
        """Set the rates at which the smoothed estimates follow, in place.

        All follow with the rate β, and the camera such that the points at q do. All are slower
        where x̂ or R would be fast, as after a restart.
        """
        at = self._at
        u, R, p, stretch = self._estimator.estimate(state[at["keys"]])
        smooth_u, smooth_R, smooth_stretch = self._smooth(state)
        H, o = self._points.at(q)
        r, smooth_r = o + H.dot(u), o + H.dot(smooth_u)
        c, smooth_c = (r - p).dot(R.T), smooth_r.dot(smooth_R.T) + state[at["t"]]
        # how far apart the two are beside the rays, at the depth of the points
        ray, smooth_ray = (
            each[:, :2] / np.maximum(each[:, 2:], self._camera.near) for each in (c, smooth_c)
        )
        beside = np.abs(ray - smooth_ray).max() * max(float(c[:, 2].max()), self._camera.near)
        turn = law.rotation_log(R.dot(smooth_R.T))
        rate = min(
            _SMOOTHING,
            0.5 / dt,
            _EASED_SPEED / max(float(beside), 1e-9),
            _EASED_TURN / max(math.hypot(*turn.tolist()), 1e-9),
        )
        u_dot, spin = rate * (u - smooth_u), rate * turn
        moved = H.dot(u_dot).dot(smooth_R.T) + smooth_r.dot(law.cross_matrix(spin).dot(smooth_R).T)
        state[at["u_dot"]], state[at["spin"]] = u_dot, spin
        state[at["t_dot"]] = (rate * (c - smooth_c) - moved).mean(axis=0)
        state[at["stretch_dot"]] = rate * (stretch - smooth_stretch)
        state[at["b_dot"]] = rate * (state[at["integral"]] - state[at["b"]])

    def _advance(self, state: Array, dt: float) -> None:
        """Let the smoothed estimates follow for dt [s], in place."""
        at = self._at
        for name in ("u", "t", "stretch", "b"):
            state[at[name]] += dt * state[at[f"{name}_dot"]]
        R = state[at["R"]].reshape(3, 3)
        state[at["R"]] = law.rotation_exp(dt * state[at["spin"]]).dot(R).ravel()

    def _smooth(self, state: Array) -> tuple[Array, Array, float]:
        """Return the smoothed u, R and λ."""
        at = self._at
        return state[at["u"]], state[at["R"]].reshape(3, 3), float(state[at["stretch"]][0])

    # -- prediction ----------------------------------------------------------------------

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,).

        z = (f₀/Z₀) N(ρ_d) c, with the smoothed estimates, c the points in the camera's axes and
        N(ρ) = [I, −ρ]; and, exactly, all that its derivatives need.
        """
        at, k, s = self._at, self._k, self._scale[:, np.newaxis]
        u, R, stretch = self._smooth(state)
        t_dot, spin, l_dot = (
            state[at["t_dot"]],
            state[at["spin"]],
            float(state[at["stretch_dot"]][0]),
        )
        r, J_r, J_r_dot, drift_r = self._points.motion(q, v, u, state[at["u_dot"]])
        R_dot = law.cross_matrix(spin).dot(R)
        c, A = r.dot(R.T) + state[at["t"]], R @ J_r
        drift_c = drift_r.dot(R.T) + r.dot(R_dot.T) + t_dot
        A_dot = R @ J_r_dot + R_dot @ J_r
        # the target's rays, as the learnt focal length shows them
        y, y_dot, y_ddot = self._rays.of_target(target)
        shrink = math.exp(-stretch)
        rho = shrink * (y - state[at["b"]].reshape(-1, 2))
        led, led_dot = shrink * y_dot, shrink * (y_ddot - l_dot * y_dot)
        rho_dot = -l_dot * rho - shrink * state[at["b_dot"]].reshape(-1, 2)  # by what is learnt
        N, Z = law.ray_basis(rho) * s, c[:, 2:]
        J = (N @ A).reshape(2 * k, -1)
        N_dot = -(s[:, 0] * (led + rho_dot))[:, :, np.newaxis] * A[:, 2:]
        J_dot = (N @ A_dot + N_dot).reshape(2 * k, -1)
        Z_dot = (A[:, 2].dot(v) + drift_c[:, 2])[:, np.newaxis]
        scale = s[:, 0]
        drift = (N @ drift_c[:, :, np.newaxis])[..., 0] - scale * Z * rho_dot
        return PredictedError(
            (N @ c[:, :, np.newaxis]).ravel(),
            J,
            J_dot,
            (scale * Z * led).ravel(),
            (scale * (Z_dot * led + Z * led_dot)).ravel(),
            drift.ravel(),
        )

    # -- what was learnt -----------------------------------------------------------------

    def _is_state(self, state: Array) -> bool:
        _, R, _, _ = self._estimator.estimate(state[self._at["keys"]])
        return is_rotation(R)

    def camera(self, state: Array) -> PinholeCamera:
        """Return the camera as a state has learnt it."""
        state = self._required(state)
        _, R, p, stretch = self._estimator.estimate(state[self._at["keys"]])
        return self._camera.with_error(
            shift=self._believed.R.dot(p - self._believed.p),
            rotation=law.rotation_log(self._believed.R.dot(R.T)),
            focal_factor=math.exp(stretch),
        )

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with the translations that a state has learnt."""
        u, *_ = self._estimator.estimate(self._required(state)[self._at["keys"]])
        return self._points.regressor.robot_with(self._points.theta(u))

    def report(self, state: Array) -> KinematicReport:
        """Return what a state has learnt: values, standard deviations, and what was not seen.

        The covariance is of the rotation in the learnt camera's own axes.
        """
        at, noise, state = self._at, self.noise, self._required(state)
        keys = state[at["keys"]]
        told, sd = self.learnt(state).copy(), self._estimator.sd[self._told]
        believed = self._in_order(self._believed)
        seconds, restarts, variance, _ = state[at["seen"]].tolist()
        P = self._estimator.covariance(keys)[np.ix_(self._told, self._told)]
        share = 1.0 - P.diagonal() / sd**2
        beyond = max(1.0, variance / noise**2)  # noise that is seen, over what was told
        chi = self._estimator.chi_squared(keys) / beyond
        units = self._unknowns.units
        scale = np.array([-1.0 if unit == "rad" else 1.0 for unit in units])
        if units[-1] == "px":  # of which the logarithm is learnt
            scale[-1] = told[-1]
        P = P * (max(chi, 1.0) * beyond) * scale * scale[:, np.newaxis]
        rows = rows_of(self.names, units, believed, told, P, share)
        angle = math.hypot(*told[[unit == "rad" for unit in units]].tolist())
        untested, told_seen = TiltedAxes(1.0, 0.0, "", 0.0), (noise, math.sqrt(variance))
        return KinematicReport(
            rows, P, angle, chi, untested, told_seen, seconds, int(restarts), "px",
            self._frames.silence(state[at["frames"]]), self._points.regressor.movers[-1],
        )  # fmt: skip
