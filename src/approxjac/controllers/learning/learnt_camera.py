"""`AdaptiveCamera`: where points are and what sees them, learnt from their images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.cameras import PinholeCamera
from approxjac.controllers.arguments import (
    LONGEST_DELAY,
    chosen_deviations,
    chosen_kinds,
    is_rotation,
)
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
)
from approxjac.controllers.learning.key_frames import Deviations, ImageEstimate, ImageEstimator
from approxjac.controllers.learning.kinematic_report import KinematicReport, TiltedAxes, rows_of
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.robots import KinematicRegressor, Robot
from approxjac.tasks import CombinedTask, ImageTask
from approxjac.tasks.analysis import (
    controllable_coordinates,
    require_controllable,
    seen_configurations,
)
from approxjac.validation import Array, as_number, require

_CHANGED = 10.0  # averaged residual, in standard deviations of x: another camera or tool
_SETTLED = 1.0  # after which what is learnt explains x, if χ² is below the next number [s]
_EXPLAINED = 4.0
_MOVES = 2.0  # times as far as believed, and four standard deviations: what is no jump
_DIFFERENCE = 1e-5  # of rays, either way, from which the lens's curvature is taken


class AdaptiveCamera(Estimator):
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
        self._points_of, self._believed = unknowns.points, unknowns.believed
        self._k, n = self._points_of.k, len(self._believed.u)
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
            "R": 9, "u": n, "t": 3, "stretch": 1, "b": m,
            "spin": 3, "u_dot": n, "t_dot": 3, "stretch_dot": 1, "b_dot": m,
        }  # fmt: skip
        learnt = "keys told integral averaged left seen u R t stretch b"
        self._lay_out(sizes, learnt, "u t stretch b")
        self._turning = (("R", "spin"),)

    def __repr__(self) -> str:
        return f"AdaptiveCamera({self.task!r}, unknown={self.unknown})"

    # -- learning ------------------------------------------------------------------------

    def _own(self, measurement: Measurement) -> Measurement:
        return self._rays.of_measurement(measurement)

    def _begin(self, state: Array) -> None:
        at = self._at
        state[at["keys"]] = self._estimator.initial()
        state[at["time"]] = self._frames.last_time(state[at["frames"]])
        state[at["seen"]] = 0.0, 0.0, self.noise**2, 0.0
        self._follow(state)

    def _has_begun(self, state: Array) -> Any:
        return self._estimator.has_begun(state[self._at["keys"]])

    def _place(self, state: Array, frame: Frame) -> None:
        """Let the camera, and what is controlled, begin where it sees a first frame, in place."""
        y = self._rays.at(frame.x)
        if np.isfinite(y).all(axis=1).any():
            H, o = self._points_of.at(frame.q)
            numbers = state[self._at["keys"]]
            numbers[:] = self._estimator.renewed(self._estimator.learn(numbers, H, o, y))
            numbers[-2] = 1e-12  # the camera was placed
        self._follow(state)

    def _follow(self, state: Array) -> None:
        """Let what is controlled be what is estimated, in place."""
        at = self._at
        u, R, p, stretch = estimate = self._estimator.estimate(state[at["keys"]])
        state[at["told"]] = self._in_order(estimate)
        state[at["u"]], state[at["R"]], state[at["t"]] = u, R.ravel(), -R.dot(p)
        state[at["stretch"]] = stretch

    def _in_order(self, estimate: ImageEstimate) -> Array:
        """Return what is learnt in the order of `names`."""
        turn = law.rotation_log(self._believed.R.dot(estimate.R.T))
        f = self._f[0] * math.exp(estimate.stretch)
        return np.concatenate([estimate.u, estimate.p, turn, [f]])[self._told]

    def _reach(self, q_0: Array, q: Array) -> Array:
        """Return how far each entry of w may move from one configuration to another, (m,)."""
        (H_0, o_0), (H, o) = self._points_of.at(q_0), self._points_of.at(q)
        u = self._believed.u
        known = np.linalg.norm(o + H.dot(u) - o_0 - H_0.dot(u), axis=1)
        unsure = self._unknowns.unsure(H - H_0)
        rays = (_MOVES * known + 4.0 * unsure) * _MOVES / self._usual_depth
        return np.asarray(np.repeat(rays, 2) + JUMP * self.noise / self._f.min())

    def _correct(self, state: Array, frame: Frame, is_anew: Any) -> None:
        """Learn from a frame, in place."""
        at, estimator = self._at, self._estimator
        since = min(max(frame.t - float(state[at["time"]][0]), 0.0), LONGEST_FRAME)
        state[at["time"]] = frame.t
        H, o = self._points_of.at(frame.q)
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
        integral[seen] += -math.expm1(-INTEGRAL * since) * (left[seen] - integral[seen])
        averaged[seen] += -math.expm1(-since / WINDOW) * (left[seen] - averaged[seen])
        before = state[at["left"]].reshape(-1, 2)
        change = (left - before) * self._f * seen[:, np.newaxis]
        before[seen] = left[seen]
        noted[0] += since
        if noted[0] > _SETTLED and estimator.chi_squared(keys) < _EXPLAINED:
            noted[3] = 1.0
        share = since / min(noted[0] + 0.3, NOISE_MEMORY)
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
        H, o = self._points_of.at(q)
        r, smooth_r = o + H.dot(u), o + H.dot(smooth_u)
        c, smooth_c = (r - p).dot(R.T), smooth_r.dot(smooth_R.T) + state[at["t"]]
        # how far apart the two are beside the rays, at the depth of the points
        ray, smooth_ray = (
            each[:, :2] / np.maximum(each[:, 2:], self._camera.near) for each in (c, smooth_c)
        )
        beside = np.abs(ray - smooth_ray).max() * max(float(c[:, 2].max()), self._camera.near)
        turn = law.rotation_log(R.dot(smooth_R.T))
        rate = min(
            SMOOTHING,
            0.5 / dt,
            EASED_SPEED / max(float(beside), 1e-9),
            EASED_TURN / max(math.hypot(*turn.tolist()), 1e-9),
        )
        u_dot, spin = rate * (u - smooth_u), rate * turn
        moved = H.dot(u_dot).dot(smooth_R.T) + smooth_r.dot(law.cross_matrix(spin).dot(smooth_R).T)
        state[at["u_dot"]], state[at["spin"]] = u_dot, spin
        state[at["t_dot"]] = (rate * (c - smooth_c) - moved).mean(axis=0)
        state[at["stretch_dot"]] = rate * (stretch - smooth_stretch)
        state[at["b_dot"]] = rate * (state[at["integral"]] - state[at["b"]])

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
        r, J_r, J_r_dot, drift_r = self._points_of.motion(q, v, u, state[at["u_dot"]])
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
        return self._points_of.regressor.robot_with(self._points_of.theta(u))

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
            self._frames.silence(state[at["frames"]]), self._points_of.regressor.movers[-1],
        )  # fmt: skip


USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "points": 0.2, "origins": 0.02, "position": 0.5, "rotation": 1.0,
    "focal_length": 0.3,
}  # fmt: skip
"""Plausible errors: of translations along each axis [m], rotation [rad], and the log of f."""
_THREE = "; of a tag take three corners, ImageTask(robot, camera, points=points[:3])"


class CameraUnknowns:
    """Unknowns of the image of points in a pinhole camera.

    Args:
        task: Image of the points, of the believed robot.
        unknown: What may be wrong, or None for the usual.
        sd: Plausible errors in place of those of `USUAL_SD`.

    Attributes:
        camera: The believed camera.
        kinds: What may be wrong.
        points: The points, linear in translations.
        believed: What is believed.
        sd: Plausible errors of it, 0 of what is known.
        names: Names of what is learnt, in the order of an estimate.
        units: Their units.
    """

    def __init__(self, task: Any, unknown: Any, sd: Any) -> None:
        self.camera = camera = _camera(task)
        where = "tool" if camera.mount is None else "points"
        valid = (where, "origins", "camera", "focal_length")
        self.kinds = kinds = chosen_kinds(
            (where, *valid[2:]) if unknown is None else unknown, valid
        )
        used = {*kinds, *(("position", "rotation") if "camera" in kinds else ())}
        sds = chosen_deviations(sd, USUAL_SD, used)
        self.points = points = WatchedPoints(task, where in kinds, "origins" in kinds)
        R, p = np.asarray(camera.rotation).T, np.asarray(camera.position)
        self.believed = ImageEstimate(points.u, R, p, 0.0)
        moves, zooms = "camera" in kinds, "focal_length" in kinds
        self.sd = Deviations(
            np.where(points.is_points, sds[where], sds["origins"]),
            moves * sds["position"],
            moves * sds["rotation"],
            zooms * sds["focal_length"],
        )
        pose = [f"camera.{each}" for each in ("x", "y", "z", "rx", "ry", "rz")] if moves else []
        zoom = ["focal_length"] if zooms else []
        self.names = (*points.names, *pose, *zoom)
        self.units = tuple(
            "px" if name in zoom else "rad" if name in pose[3:] else "m" for name in self.names
        )

    def unsure(self, moved: Array) -> Array:
        """Return the standard deviation of moves (k, 3, n_u) of the points, shape (k,) [m]."""
        return np.asarray(np.sqrt(((moved * self.sd.u) ** 2).sum(axis=(1, 2))))


def _camera(task: Any) -> PinholeCamera:
    """Return the camera of a task that can be learnt."""
    wanted = "an ImageTask of the believed robot"
    if isinstance(task, CombinedTask):
        wanted += f" without a combination of coordinates{_THREE}"
    require("task", task, ImageTask, wanted)
    if task.m > controllable_coordinates(task) == 6:
        raise InvalidInputError(
            f"task must have at most 6 coordinates, got {task!r} with {task.m}{_THREE}",
            given=task,
        )
    require_controllable(task)
    camera = task.camera
    if not isinstance(camera, PinholeCamera):
        raise InvalidInputError(
            f"task must have a PinholeCamera, got {task!r}; AdaptivePlanarCamera is for one that "
            "looks straight at the plane of an arm",
            given=task,
        )
    if task._uses_x:
        raise InvalidInputError(
            f"task must have depth='believed', as depth is learnt, got {task!r}", given=task
        )
    if camera.mount is not None and task.frame is not None:
        raise InvalidInputError(
            f"task of a camera that is carried must watch points of the world, frame=None, "
            f"got {task!r}",
            given=task,
        )
    return camera


class ImageRays:
    """Pixels as rays: center, distortion and focal length are those that are believed.

    Args:
        camera: The camera as it is believed.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._f, self._c = np.asarray(camera.focal_length), np.asarray(camera.center)
        self._camera = camera
        self._lens = None if camera._lens.is_straight else camera._lens

    def of_measurement(self, measurement: Measurement) -> Measurement:
        """Return a measurement with x from the camera's center, in focal lengths."""
        x = (measurement.x.reshape(-1, 2) - self._c) / self._f
        return measurement._replace(x=x.ravel())

    def at(self, w: Array) -> Array:
        """Return the rays (k, 2) that are seen at w (2k,), in focal lengths; NaN where none is."""
        w, lens = w.reshape(-1, 2), self._lens
        if lens is None:
            return w
        return np.array([lens.ray(each) if np.isfinite(each).all() else each for each in w])

    def of_target(self, target: Target) -> tuple[Array, Array, Array]:
        """Return the rays of a target, and their first and second derivatives, (k, 2) each.

        Of one that moves out of the image they are those at its edge.
        """
        x_d, v_d, a_d = target
        x_d = x_d.reshape(-1, 2)
        if self._lens is not None:
            x_d = np.array([self._camera.nearest(each) for each in x_d])
        y = self.at(((x_d - self._c) / self._f).ravel())
        nothing = np.zeros(y.shape)
        y_dot = nothing if v_d is None else v_d.reshape(-1, 2) / self._f
        y_ddot = nothing if a_d is None else a_d.reshape(-1, 2) / self._f
        if self._lens is None or v_d is None:
            return y, y_dot, y_ddot
        y_ddot = y_ddot.copy()
        for i, ray in enumerate(y):  # w = d(y), so Dy' = w' and Dy″ = w″ − D'y'
            D = self._slopes(ray)
            y_dot[i] = rate = np.linalg.solve(D, y_dot[i])
            h = _DIFFERENCE / max(math.hypot(*rate.tolist()), 1e-12)
            bent = self._slopes(ray + h * rate) - self._slopes(ray - h * rate)
            y_ddot[i] = np.linalg.solve(D, y_ddot[i] - bent.dot(rate) / (2.0 * h))
        return y, y_dot, y_ddot

    def _slopes(self, ray: Array) -> Array:
        assert self._lens is not None
        return np.array(self._lens.slopes(*ray.tolist())).reshape(2, 2)


class PointsMotion(NamedTuple):
    """Points and their derivatives, with translations that are learnt.

    Attributes:
        r: Points in the axes of the mount, shape (k, 3) [m].
        J: ∂r/∂q, shape (k, 3, n_v).
        J_dot: Its rate along q̇ and u', shape (k, 3, n_v).
        drift: What u' moves r by, shape (k, 3) [m/s].
    """

    r: Array
    J: Array
    J_dot: Array
    drift: Array


class WatchedPoints:
    """r(q) = o(q) + H(q)u in the axes of the camera's mount, with u translations.

    Of a camera in the world the points are the robot's: u moves the tool. Of one on the robot they
    are the world's: u moves all of them, in the axes of the world.

    Owns scratch memory: one instance a thread.

    Args:
        task: Image of the points, of the believed robot.
        moves: Whether where the points are is in u.
        origins: Whether the origins of the joints are.

    Attributes:
        names: Names of u, such as "tool.x", "points.x" or "panda_joint4.x".
        u: What is believed of it, shape (n_u,) [m].
        is_points: Which of u are of the points, shape (n_u,).
        k: Number of points.
    """

    def __init__(self, task: ImageTask, moves: bool, origins: bool) -> None:
        mount, self.k = task.camera.mount, len(task.points)
        self._is_carried = mount is not None
        if mount is None:
            self.regressor = KinematicRegressor(task.robot, task.frame, task.points)
        else:  # its origin, and the ends of its axes
            self.regressor = KinematicRegressor(task.robot, mount, np.eye(4, 3, -1))
        self._world = task.points if self._is_carried else np.zeros((self.k, 3))
        regressor = self.regressor
        p, theta = regressor.p, regressor.theta.copy()
        is_tool = np.arange(p) >= p - 3
        learnt = np.where(is_tool, moves and not self._is_carried, origins)
        self.of_theta = np.flatnonzero(learnt)
        self.names = [regressor.names[i] for i in self.of_theta]
        u, own = theta[self.of_theta].tolist(), is_tool[self.of_theta].tolist()
        theta[self.of_theta] = 0.0
        self._theta, self._S = theta, np.eye(p)[:, self.of_theta]
        self._n_theta = len(u)
        self._moves_world = moves and self._is_carried
        if self._moves_world:
            self.names += [f"points.{axis}" for axis in "xyz"]
            u, own = [*u, 0.0, 0.0, 0.0], [*own, True, True, True]
        self.u, self.is_points = np.array(u), np.array(own, dtype=bool)

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return H(q), shape (k, 3, n_u), and o(q), shape (k, 3)."""
        Y = self.regressor.Y(q)
        known = Y.dot(self._theta)
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q)
        if not self._is_carried:
            return Y.dot(self._S).reshape(self.k, 3, -1), known.reshape(-1, 3)
        known = known.reshape(4, 3)
        A = known[1:] - known[0]  # rows are the mount's axes
        H = -A.dot(Y[:3].dot(self._S))
        if self._moves_world:
            H = np.concatenate([H, A], axis=1)
        return np.broadcast_to(H, (self.k, *H.shape)), (self._world - known[0]).dot(A.T)

    def theta(self, u: Array) -> Array:
        """Return all translations of `regressor`, those that are known as well; shape (p,) [m]."""
        return np.asarray(self._theta + self._S.dot(u[: self._n_theta]))

    def motion(self, q: Array, v: Array, u: Array, u_dot: Array) -> PointsMotion:
        """Return points and derivatives at q (nq,) and q̇ (n_v,), with u and u' (n_u,)."""
        n = self._n_theta
        theta, theta_dot = self.theta(u), self._S.dot(u_dot[:n])
        p, J, J_dot, drift = self.regressor.motion(q, v, theta, theta_dot)
        J, J_dot = (each.reshape(-1, 3, J.shape[1]) for each in (J, J_dot))
        p, drift = p.reshape(-1, 3), drift.reshape(-1, 3)
        if not self._is_carried:
            return PointsMotion(p, J, J_dot, drift)
        # r = A(P − o) with rows a of A: each entry is a product a·w
        A, a_J, a_J_dot = p[1:] - p[0], J[1:] - J[0], J_dot[1:] - J_dot[0]
        a_dot = a_J.dot(v)
        w, w_dot = self._world - p[0], -J[0].dot(v) - drift[0]
        moved = -drift[0]
        if self._moves_world:
            w, w_dot, moved = w + u[n:], w_dot + u_dot[n:], moved + u_dot[n:]
        each = np.einsum("kj,ajn->kan", w, a_J)
        each_dot = np.einsum("kj,ajn->kan", w, a_J_dot) + np.einsum("j,ajn->an", w_dot, a_J)
        return PointsMotion(
            w.dot(A.T),
            each - A.dot(J[0]),
            each_dot - a_dot.dot(J[0]) - A.dot(J_dot[0]),
            np.tile(A.dot(moved), (self.k, 1)),
        )
