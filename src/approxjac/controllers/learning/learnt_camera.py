"""`AdaptiveCamera`: positions of points and the camera that sees them, learnt from images."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.cameras import PinholeCamera
from approxjac.controllers.arguments import chosen_deviations, chosen_kinds, is_rotation
from approxjac.controllers.learning.estimator import Estimator, motion_of_points
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.law import PredictedError, images, rotation
from approxjac.robots import KinematicRegressor, Robot
from approxjac.robots.kinematic_regressor import PointMotion, Unknowns
from approxjac.robots.traced import moved
from approxjac.tasks import ImageTask
from approxjac.tasks.analysis import (
    controllable_coordinates,
    require_controllable,
    seen_configurations,
)
from approxjac.validation import Array, as_number

_CHANGED = 10.0  # averaged residual, in standard deviations of x: another camera or tool
_SETTLED = 1.0  # after which what is learnt explains x, if χ² is below the next number [s]
_EXPLAINED = 4.0
_MOVES = 2.0  # times as far as believed, and four standard deviations: what is no jump
_DIFFERENCE = 1e-5  # of rays, either way, from which the lens's curvature is taken
_USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "points": 0.2, "origins": 0.02, "axes": 3e-3, "encoders": 0.015,
    "position": 0.5, "rotation": 1.0, "focal_length": 0.3,
}  # fmt: skip
_KEYS = 40, 160  # key frames, and with axes
_ANEW = 4  # of them that each frame linearises anew, with axes
_MOST = 200.0  # frames that one of them counts for at most
_NEW = (0.03, 0.15)  # of o [m] and H, from a key frame on
_NEAREST = 0.05  # that a point is before the camera [m]
_PLACED = 0.5  # depth of points that are believed behind the camera [m]
_DAMPING = (0.0, 1.0, 1e2, 1e4, 1e6)  # of Levenberg and Marquardt, in prior informations
_TURN = 0.7  # of one step [rad]
_DOUBT = 4.0  # χ² a degree of freedom, above which another roll is looked for
_LARGEST_CHI = 1e9  # that is said
_ODDS = 8.0  # of it against the one at hand, as a logarithm, before it is taken
_BETTER = 0.7  # and its cost, as a share
_VIEWS = 6  # of the best ones that are tried
_PATIENCE = 10.0  # frames for it to become better


class AdaptiveCamera(Estimator):
    """x̂ = π(R̂(r(q; û) − p̂); f̂), learnt from the images of points while the arm moves.

    It learns the position of the points on the tool, the camera's pose and focal length, and, on
    request, joint origins, axes and encoders. A camera in the world watches points of the robot; a
    camera on the robot watches points of the world. Depth is not measured but inferred from how
    images move.

    The law controls the distance of each point from the ray of its target, at its predicted depth
    Ẑ: z = (f₀/Z₀) Ẑ(ρ̂ − ρ_d), with ρ the ray (X/Z, Y/Z), the believed focal length f₀ and a usual
    depth Z₀, so that z is in pixels. So Ĵ is as regular as the arm's own, whatever the roll and
    even if the camera is believed behind the points.

    A wrongly believed roll or side of the arm is usually detected from how images move; nothing
    proves that it always is. In all else it is like `AdaptiveKinematics`.

    Args:
        task: An `ImageTask` of the believed robot with the believed `PinholeCamera`, whose center
            and distortion are taken as true. For a tag use three corners, `points[:3]`.
        unknown: Parameters that may be wrong: "tool" or, for points of the world, "points" (one
            translation of all points); "origins" of the joints; "axes", tilts of joint axes and
            offsets of encoders; "camera", its position and rotation; "focal_length". By default
            all but origins and axes.
        sd: Plausible errors: "tool", "points", "origins" and "position" of the camera [m], "axes",
            "encoders" and the camera's "rotation" [rad], and the logarithm of "focal_length"; by
            default 0.2, 0.2, 0.02, 0.5, 0.003, 0.015, 1.0 and 0.3.
        noise: Standard deviation of x [px].
        delay: As for `AdaptiveKinematics`.
        dt: As for `AdaptiveKinematics`.
        restarts: As for `AdaptiveKinematics`.

    Attributes:
        names: Names of the learnt numbers, such as "tool.x", "points.x", "camera.x", "camera.rz"
            (rotation vector from the believed to the learnt camera, in the believed one's axes)
            and "focal_length" [px].

    Raises:
        InvalidInputError: Another task or camera, and as `AdaptiveKinematics`.
        UnknownNameError: An sd of something else.
    """

    _noise_unit = "px"

    def __init__(
        self,
        task: ImageTask,
        unknown: Sequence[str] | None = None,
        sd: Mapping[str, float] | None = None,
        noise: float = 0.5,
        delay: float = 0.0,
        dt: float = 1e-3,
        restarts: bool = True,
    ) -> None:
        _require_image(task)
        self._restarts = restarts
        self._camera: PinholeCamera = task.camera  # type: ignore[assignment]
        camera = self._camera
        where = "tool" if camera.mount is None else "points"
        valid = (where, "origins", "axes", "camera", "focal_length")
        usual = (where, *valid[3:])
        self.unknown = kinds = chosen_kinds(usual if unknown is None else unknown, valid)
        moves, zooms = "camera" in kinds, "focal_length" in kinds
        used = {*kinds, *(("position", "rotation") if moves else ())}
        used |= {"encoders"} if "axes" in kinds else set()
        sds = chosen_deviations(sd, _USUAL_SD, used)
        self.task, self.noise = task, as_number("noise", noise, unit="px", above=0.0)
        # r(q) = o(q) + H(q)u in the mount's axes. Of a camera in the world u moves the tool; of
        # one on the robot it moves the world's points, and the mount is its origin and axes' ends.
        mount, self._world, self._k = camera.mount, task.points, len(task.points)
        frame, ends = (task.frame, task.points) if mount is None else (mount, np.eye(4, 3, -1))
        self.regressor = KinematicRegressor(task.robot, frame, ends, "axes" in kinds)
        self._moved = unknowns = Unknowns(self.regressor, kinds, sds)
        units, u, sd_u = (
            dict(zip(unknowns.names, unknowns.units, strict=True)), unknowns.u, unknowns.sd,
        )  # fmt: skip
        self._n, self._moves_world = len(u), "points" in kinds
        if self._moves_world:
            units |= {f"points.{axis}": "m" for axis in "xyz"}
            u, sd_u = np.append(u, np.zeros(3)), np.append(sd_u, np.full(3, sds["points"]))
        self._u, self._sd_u, n = u, sd_u, len(u)
        self._R, self._p = np.asarray(camera.rotation).T, np.asarray(camera.position)
        self._first = np.concatenate([u, self._R.ravel(), self._p, [0.0]])
        pose = [moves * sds["position"]] * 3 + [moves * sds["rotation"]] * 3
        all_sd = np.concatenate([sd_u, pose, [zooms * sds["focal_length"]]])
        # pixels as rays: center, distortion and focal length those that are believed
        self._f, self._center = np.asarray(camera.focal_length), np.asarray(camera.center)
        self._lens = None if camera._lens.is_straight else camera._lens
        self._estimator = _KeyFrames(
            self._first, all_sd, self.noise / self._f, self._k,
            *((task.robot.nq, self._watched_about) if "axes" in kinds else ()),
        )  # fmt: skip
        self._is_learnt = all_sd > 0.0
        self._sd = np.append(all_sd[:-1], all_sd[-1] * self._f[0])[self._is_learnt]
        self._believed = self._in_order(self._first)
        if moves:
            units |= {f"camera.{axis}": "m" for axis in "xyz"}
            units |= {f"camera.r{axis}": "rad" for axis in "xyz"}
        self.names = (*units, *(["focal_length"] if zooms else []))
        self.units = (*units.values(), *(["px"] if zooms else []))
        depths = [task.depths(q) for q in seen_configurations(task, 20)]
        self._usual_depth = float(np.median(depths))
        self._scale, self._pixels = self._f / self._usual_depth, np.tile(self._f, self._k)
        m = task.m
        sizes = {
            "keys": self._estimator.size, "explained": 1,
            "R": 9, "R_spin": 3, "u": n, "t": 3, "stretch": 1, "b": m,
            "u_dot": n, "t_dot": 3, "stretch_dot": 1, "b_dot": m,
        }  # fmt: skip
        self._lay_out(sizes, delay, dt, m)

    def __repr__(self) -> str:
        return f"AdaptiveCamera({self.task!r}, unknown={self.unknown})"

    def _own(self, measurement: Measurement) -> Measurement:
        x = (measurement.x.reshape(-1, 2) - self._center) / self._f
        return measurement._replace(x=x.ravel())

    def _rays(self, w: Array) -> Array:
        """Return the rays (k, 2) that are seen at w (2k,), in focal lengths; NaN where none is."""
        w, lens = w.reshape(-1, 2), self._lens
        if lens is None:
            return w
        return np.array([lens.ray(each) if np.isfinite(each).all() else each for each in w])

    def _target_rays(self, target: Target) -> tuple[Array, Array, Array]:
        """Return rays of a target, or of the image's edge, and their two derivatives; (k, 2)."""
        x_d, v_d, a_d = target
        x_d = x_d.reshape(-1, 2)
        if self._lens is not None:
            x_d = np.array([self._camera.nearest(each) for each in x_d])
        y = self._rays(((x_d - self._center) / self._f).ravel())
        y_dot, y_ddot = (
            np.zeros(y.shape) if rate is None else rate.reshape(-1, 2) / self._f
            for rate in (v_d, a_d)
        )
        if self._lens is None or v_d is None:
            return y, y_dot, y_ddot
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

    def _watched(self, q: Array, u: Array | None = None) -> tuple[Array, Array]:
        """Return H(q) = ∂r/∂u, shape (k, 3, n_u), and o(q) = r − Hu, shape (k, 3), at u."""
        n, u = self._n, self._u if u is None else u
        H, known = self._moved.at(q, u[:n])
        known = known.reshape(-1, 3)
        H = H.reshape(len(known), 3, n)
        if self._camera.mount is None:
            return H, known
        p = known + H.dot(u[:n])
        A, w = p[1:] - p[0], self._world - p[0]  # rows of A are the mount's axes
        if self._moves_world:
            w = w + u[n:]
        H = np.einsum("kj,ajn->kan", w, H[1:] - H[0]) - A.dot(H[0])
        if self._moves_world:
            H = np.concatenate([H, np.broadcast_to(A, (self._k, 3, 3))], axis=2)
        return H, w.dot(A.T) - H.dot(u)

    def _watched_about(self, q: Array, u: Array) -> tuple[Array, Array]:
        """Return the same at a mean q, of which continuous joints are not of length one."""
        robot = self.task.robot
        return self._watched(moved(robot, q, np.zeros(robot.nv)), u)

    def _watched_motion(self, q: Array, v: Array, u: Array, u_dot: Array) -> PointMotion:
        """Return r (k, 3), ∂r/∂q (k, 3, n_v), its rate, and what u' moves r by (k, 3)."""
        n = self._n
        p, J, J_dot, drift = self._moved.motion(q, v, u[:n], u_dot[:n])
        J, J_dot = (each.reshape(-1, 3, J.shape[1]) for each in (J, J_dot))
        p, drift = p.reshape(-1, 3), drift.reshape(-1, 3)
        if self._camera.mount is None:
            return PointMotion(p, J, J_dot, drift)
        # r = A(P − o) with rows a of A: each entry is a product a·w
        A, a_J, a_J_dot = p[1:] - p[0], J[1:] - J[0], J_dot[1:] - J_dot[0]
        turned = drift[1:] - drift[0]
        a_dot = a_J.dot(v) + turned
        w, w_dot = self._world - p[0], -J[0].dot(v) - drift[0]
        moved = -drift[0]
        if self._moves_world:
            w, w_dot, moved = w + u[n:], w_dot + u_dot[n:], moved + u_dot[n:]
        each = np.einsum("kj,ajn->kan", w, a_J)
        each_dot = np.einsum("kj,ajn->kan", w, a_J_dot) + np.einsum("j,ajn->an", w_dot, a_J)
        return PointMotion(
            w.dot(A.T),
            each - A.dot(J[0]),
            each_dot - a_dot.dot(J[0]) - A.dot(J_dot[0]),
            A.dot(moved) + w.dot(turned.T),
        )

    def _begin(self, state: Array) -> None:
        state[self._at["keys"]] = self._estimator.about(self._first)
        self._follow(state)

    def _has_begun(self, state: Array) -> Any:
        return bool(state[self._at["keys"]][-2] > 0.0)  # χ² is, from the first frame on

    def _place(self, state: Array, frame: Measurement) -> None:
        y = self._rays(frame.x)
        if np.isfinite(y).all(axis=1).any():
            keys = state[self._at["keys"]]
            learnt = self._estimator.learn(keys, *self._watched(frame.q), y, frame.q)
            keys[:] = self._estimator.about(self._estimator.estimate(learnt))
            keys[-2] = 1e-12  # the camera was placed
        self._follow(state)

    def _follow(self, state: Array) -> None:
        at = self._at
        estimate = self._estimator.estimate(state[at["keys"]])
        u, R, p, stretch = _parts(estimate)
        state[at["learnt"]] = self._in_order(estimate)
        state[at["u"]], state[at["R"]], state[at["t"]] = u, R.ravel(), -R.dot(p)
        state[at["stretch"]] = stretch

    def _in_order(self, estimate: Array) -> Array:
        u, R, p, stretch = _parts(estimate)
        f = self._f[0] * math.exp(stretch)
        return np.concatenate([u, p, law.rotation_log(self._R.dot(R.T)), [f]])[self._is_learnt]

    def _reach(self, q_0: Array, q: Array) -> Array:
        before, after = self._watched(q_0), self._watched(q)
        known, unsure = motion_of_points(before, after, self._u, self._sd_u)
        return np.repeat((_MOVES * known + 4.0 * unsure) * _MOVES / self._usual_depth, 2)

    def _correct(self, state: Array, frame: Measurement, since: Any, is_anew: Any) -> None:
        at, estimator, y = self._at, self._estimator, self._rays(frame.x)
        seen = np.isfinite(y).all(axis=1)
        if not seen.any():
            return
        keys, explained, noted = state[at["keys"]], state[at["explained"]], state[at["noted"]]
        unlike = np.abs(state[at["averaged"]] * self._pixels).max() > _CHANGED * self.noise
        if self._restarts and (is_anew or (unlike and explained[0])):  # what was learnt is false
            self._renew(state)
        H, o = self._watched(frame.q, _parts(estimator.estimate(keys))[0])
        state[at["keys"]] = keys = estimator.learn(keys, H, o, y, frame.q)
        estimate = estimator.estimate(keys)
        u, R, p, stretch = _parts(estimate)
        state[at["learnt"]] = self._in_order(estimate)
        c = (o + H.dot(u) - p).dot(R.T)
        seen &= c[:, 2] > self._camera.near  # others have no image, as far as is known
        left = np.full_like(y, np.nan)
        left[seen] = y[seen] - images.rays(c[seen], math.exp(stretch))
        self._account(state, left.ravel(), since)
        if noted[0] > _SETTLED and keys[-2] < _EXPLAINED:
            explained[0] = 1.0

    def _renew(self, state: Array) -> None:
        keys = state[self._at["keys"]]
        keys[:] = self._estimator.about(self._estimator.estimate(keys))
        state[self._at["explained"]] = 0.0
        self._forget(state)

    def _aim(self, state: Array, q: Array, dt: float) -> None:
        # all follow, and the camera such that the points at q do
        at = self._at
        u, R, p, stretch = _parts(self._estimator.estimate(state[at["keys"]]))
        smooth_u, smooth_R, smooth_stretch = self._smooth(state)
        H, o = self._watched(q, smooth_u)
        r, smooth_r = o + H.dot(u), o + H.dot(smooth_u)
        c, smooth_c = (r - p).dot(R.T), smooth_r.dot(smooth_R.T) + state[at["t"]]
        # how far apart the two are beside the rays, at the depth of the points
        ray, smooth_ray = (
            each[:, :2] / np.maximum(each[:, 2:], self._camera.near) for each in (c, smooth_c)
        )
        beside = np.abs(ray - smooth_ray).max() * max(float(c[:, 2].max()), self._camera.near)
        turn = law.rotation_log(R.dot(smooth_R.T))
        rate = self._smoothing_rate(dt, beside, turn)
        u_dot, spin = rate * (u - smooth_u), rate * turn
        moved = H.dot(u_dot).dot(smooth_R.T) + smooth_r.dot(law.cross_matrix(spin).dot(smooth_R).T)
        state[at["u_dot"]], state[at["R_spin"]] = u_dot, spin
        state[at["t_dot"]] = (rate * (c - smooth_c) - moved).mean(axis=0)
        state[at["stretch_dot"]] = rate * (stretch - smooth_stretch)
        state[at["b_dot"]] = rate * (state[at["integral"]] - state[at["b"]])

    def _smooth(self, state: Array) -> tuple[Array, Array, float]:
        at = self._at
        return state[at["u"]], state[at["R"]].reshape(3, 3), float(state[at["stretch"]][0])

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return z = (f₀/Z₀) N(ρ_d) c at q (nq,) and q̇ (n_v,), with the smoothed estimates.

        Points in the camera's axes are c, and N(ρ) = [I, −ρ].
        """
        at, k, s = self._at, self._k, self._scale[:, np.newaxis]
        u, R, stretch = self._smooth(state)
        t_dot, spin = state[at["t_dot"]], state[at["R_spin"]]
        l_dot = float(state[at["stretch_dot"]][0])
        r, J_r, J_r_dot, drift_r = self._watched_motion(q, v, u, state[at["u_dot"]])
        R_dot = law.cross_matrix(spin).dot(R)
        c, A = r.dot(R.T) + state[at["t"]], R @ J_r
        drift_c = drift_r.dot(R.T) + r.dot(R_dot.T) + t_dot
        A_dot = R @ J_r_dot + R_dot @ J_r
        # the target's rays, as the learnt focal length shows them
        y, y_dot, y_ddot = self._target_rays(target)
        shrink = math.exp(-stretch)
        rho = shrink * (y - state[at["b"]].reshape(-1, 2))
        led, led_dot = shrink * y_dot, shrink * (y_ddot - l_dot * y_dot)
        rho_dot = -l_dot * rho - shrink * state[at["b_dot"]].reshape(-1, 2)  # by what is learnt
        N, Z = images.ray_basis(rho) * s, c[:, 2:]
        J = (N @ A).reshape(2 * k, -1)
        N_dot = -(s[:, 0] * (led + rho_dot))[:, :, np.newaxis] * A[:, 2:]
        J_dot = (N @ A_dot + N_dot).reshape(2 * k, -1)
        Z_dot = (A[:, 2].dot(v) + drift_c[:, 2])[:, np.newaxis]
        scale = s[:, 0]
        drift = (N @ drift_c[:, :, np.newaxis])[..., 0] - scale * Z * rho_dot
        x_d_dot, x_d_ddot = scale * Z * led, scale * (Z_dot * led + Z * led_dot)
        z = (N @ c[:, :, np.newaxis]).ravel()
        return PredictedError(z, J, J_dot, x_d_dot.ravel(), x_d_ddot.ravel(), drift.ravel())

    def _is_state(self, state: Array) -> bool:
        return is_rotation(_parts(self._estimator.estimate(state[self._at["keys"]]))[1])

    def camera(self, state: Array) -> PinholeCamera:
        """Return the camera that a state has learnt."""
        _, R, p, stretch = _parts(self._estimator.estimate(self._required(state)[self._at["keys"]]))
        return self._camera.with_error(
            shift=self._R.dot(p - self._p),
            rotation=law.rotation_log(self._R.dot(R.T)),
            focal_factor=math.exp(stretch),
        )

    def robot(self, state: Array) -> Robot:
        estimate = self._estimator.estimate(self._required(state)[self._at["keys"]])
        return self.regressor.robot_with(self._moved.theta(estimate[: self._n]))

    def _covariance(self, state: Array) -> tuple[Array, float]:
        keys, is_learnt = state[self._at["keys"]], self._is_learnt
        beyond = max(1.0, state[self._at["noted"]][2] / self.noise**2)
        covariance = self._estimator.covariance(keys)[np.ix_(is_learnt, is_learnt)]
        # rotations in the learnt camera's own axes; of the focal length its logarithm is learnt
        learnt = self.learnt(state)[-1]
        scale = np.array([{"rad": -1.0, "px": learnt}.get(unit, 1.0) for unit in self.units])
        covariance = covariance * scale * scale[:, np.newaxis]
        return covariance, float(keys[-2] / beyond)


def _require_image(task: Any) -> None:
    camera: Any = getattr(task, "camera", None)
    is_image = isinstance(task, ImageTask) and isinstance(camera, PinholeCamera)
    if is_image and not task.m > controllable_coordinates(task) == 6:
        require_controllable(task)
        if not task.uses_x and (camera.mount is None or task.frame is None):
            return
    raise InvalidInputError(
        "task must be an ImageTask of the believed robot with a PinholeCamera (AdaptiveKinematics "
        "is for a PlanarCamera), depth='believed', at most 6 coordinates, all of them (of a tag "
        "take three corners, ImageTask(robot, camera, points=points[:3])), and where the camera is "
        f"carried with points of the world, frame=None; got {task!r}",
        given=task,
    )


def _parts(estimate: Array) -> tuple[Array, Array, Array, float]:
    u, R, p = np.split(estimate[:-1], [-12, -3])
    return u, R.reshape(3, 3), p, float(estimate[-1])


_Terms = tuple[Array, Array, Array, Array]
_NO_Q = np.zeros(0)


class _KeyFrames:
    """Least squares of y = e^λ π(R(o + Hu − p)) over key frames, linearised anew with each frame.

    A key frame is the mean of y and of r = o + Hu over a short way, which is as linear in u as one
    frame is. Each new frame brings a step of Levenberg and Marquardt. Where the estimate does not
    explain what is seen, a camera elsewhere about the points, with the best turn of the image from
    there, is tried beside it for some frames, and taken if it is better beyond doubt.

    With axes o and H depend on u: then key frames have their mean q, at which `watched(q, u)`
    returns both, and a few of them are linearised anew with each frame.

    An estimate has the numbers u of arm and points, the rotation R of the mount's axes in the
    camera's, the camera's position p in its mount's axes, and λ. The numbers in the state: key
    frames (for each point its count, y, o, H and, with axes, q); the estimate; the one that is
    tried beside it; which key frame is linearised next; for how many frames another estimate was
    tried (0: none is); how many were before; χ² (0 before the first frame); and the index of
    the last key frame. sd are of u, p, the rotation and λ, 0 if known; the noise (2,) is of y.
    """

    def __init__(
        self, believed: Array, sd: Array, noise: Array, k: int, nq: int = 0, watched: Any = None
    ) -> None:
        self._first, self._k, self._e, self._n = believed, k, len(believed), len(believed) - 13
        self._free, self._size = np.flatnonzero(sd > 0.0), len(sd)
        self._prior = np.where(sd > 0.0, sd, np.inf) ** -2.0
        self._weight = noise**-2.0
        self._nq, self._watched = nq, watched
        self._shape = _KEYS[nq > 0], k, 6 + 3 * self._n + nq
        self._m = math.prod(self._shape)
        self.size = self._m + 2 * self._e + 5
        everywhere = rotation.rotations_everywhere(3)  # of which those with the same view are one
        _, first = np.unique(np.round(everywhere[:, 2], 6), axis=0, return_index=True)
        self._views = everywhere[first]

    def about(self, estimate: Array) -> Array:
        """Return the numbers (size,) before the first frame, with an estimate."""
        numbers = np.zeros(self.size)
        numbers[self._m : self._m + self._e] = estimate
        return numbers

    def estimate(self, numbers: Array) -> Array:
        """Return the estimate."""
        return numbers[self._m : self._m + self._e].copy()

    def learn(self, numbers: Array, H: Array, o: Array, y: Array, q: Array = _NO_Q) -> Array:
        """Return the numbers after a frame of H (k, 3, n_u), o (k, 3) and y (k, 2), NaN if lost."""
        numbers = numbers.copy()
        self._remember(numbers, H, o, y, q)
        self._linearize(numbers)
        terms = self._terms(numbers)
        best, other = numbers[self._m : self._m + 2 * self._e].reshape(2, -1)
        noted = numbers[-4:]
        tried, rank, is_first = noted[0], noted[1], noted[2] == 0.0
        if is_first or not math.isfinite(self._misfit(best, terms)):
            best[:] = self._placed(best, terms)
        best[:], cost = self._improved(best, terms, 8 if is_first else 1)
        if self._chi_squared(best, terms) > _DOUBT and not is_first and self._prior[-2] > 0.0:
            if not tried:
                other[:] = self._another(terms, int(rank))
            other[:], cost_other = self._improved(other, terms, 2)
            noted[0] = tried + 1.0
            if cost_other < min(_BETTER * cost, cost - _ODDS):
                best[:], noted[:2] = other, 0.0
            elif tried >= _PATIENCE:
                noted[:2] = 0.0, rank + 1.0
        else:
            noted[0] = 0.0
        noted[2] = min(max(self._chi_squared(best, terms), 1e-12), _LARGEST_CHI)
        return numbers

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, p, φ, λ), φ of R ← exp([φ]ₓ)R; 0 of what is known."""
        covariance, free = np.zeros((self._size, self._size)), np.ix_(self._free, self._free)
        A, _ = self._normal(self.estimate(numbers), self._terms(numbers))
        covariance[free] = np.linalg.inv(A[free])
        return covariance

    def _remember(self, numbers: Array, H: Array, o: Array, y: Array, q: Array) -> None:
        """Add a frame to the last key frame, or begin another one, in place."""
        keys, last = numbers[: self._m].reshape(self._shape), int(numbers[-1]) % self._shape[0]
        H = H.reshape(self._k, -1)
        key, has = keys[last], keys[last, :, 0] > 0.0
        if has.any():
            away = np.abs(key[has, 3:6] - o[has]).max() / _NEW[0]
            away += np.linalg.norm(key[has, 6 : 6 + H.shape[1]] - H[has]) / _NEW[1]
            if away > 1.0:
                numbers[-1] = last = (last + 1) % self._shape[0]
                key = keys[last]
                key[:] = 0.0
        seen = np.isfinite(y).all(axis=1)
        count = np.minimum(key[:, 0] + seen, _MOST)
        share = np.where(seen, 1.0 / np.maximum(count, 1.0), 0.0)[:, np.newaxis]
        at = np.tile(q[: self._nq], (self._k, 1))
        key[:, 1:] += share * (np.concatenate([np.nan_to_num(y), o, H, at], axis=1) - key[:, 1:])
        key[:, 0] = count

    def _linearize(self, numbers: Array) -> None:
        """Write H and o of the next few key frames, which were about an earlier u, about u."""
        keys, nq = numbers[: self._m].reshape(self._shape), self._nq
        u, n = numbers[self._m : self._m + self._n], int(keys[:, :, 0].any(axis=1).sum())
        for i in (int(numbers[-5]) + np.arange(min(_ANEW, n))) % n if nq else ():
            for q in {tuple(row) for row in keys[i, :, -nq:].tolist()}:  # of each point
                which = (keys[i, :, -nq:] == q).all(axis=1)
                H, o = self._watched(np.array(q), u)
                new = np.concatenate([o, H.reshape(self._k, -1)], axis=1)
                keys[i, which, 3:-nq] = new[which]
            numbers[-5] = i + 1

    def _terms(self, numbers: Array) -> _Terms:
        """Return weights (N, 2), y (N, 2), o (N, 3) and H (N, 3, n_u) of what is remembered."""
        rows = numbers[: self._m].reshape(-1, self._shape[2])
        rows = rows[rows[:, 0] > 0.0]
        weights = rows[:, :1] * self._weight
        H = rows[:, 6 : 6 + 3 * self._n].reshape(len(rows), 3, self._n)
        return weights, rows[:, 1:3], rows[:, 3:6], H

    def _chi_squared(self, estimate: Array, terms: _Terms) -> float:
        rows = 2.0 * len(terms[0])
        return 2.0 * self._misfit(estimate, terms) / max(rows - len(self._free), 0.5 * rows)

    def _places(self, estimate: Array, terms: _Terms) -> Array:
        """Return the points in the camera's axes, shape (N, 3)."""
        u, R, p, _ = _parts(estimate)
        return np.asarray((terms[2] + terms[3].dot(u) - p).dot(R.T))

    def _misfit(self, estimate: Array, terms: _Terms) -> float:
        """Return half the weighted sum of squares of what is left of y; inf behind the camera."""
        c = self._places(estimate, terms)
        if not (c[:, 2] > _NEAREST).all():
            return math.inf
        left = terms[1] - images.rays(c, math.exp(estimate[-1]))
        return 0.5 * float((terms[0] * left * left).sum())

    def _away(self, estimate: Array) -> tuple[Array, Array]:
        """Return u, p and λ minus their believed values, 0 for the rotation; R − R₀ (9,)."""
        away = estimate - self._first
        n = self._n
        return np.concatenate([away[:n], away[n + 9 : -1], np.zeros(3), away[-1:]]), away[n : n + 9]

    def _cost(self, estimate: Array, terms: _Terms) -> float:
        """Return the misfit plus the cost of the distance from the belief."""
        away, turned = self._away(estimate)
        prior = away.dot(self._prior * away) + 0.5 * self._prior[-2] * turned.dot(turned)
        return self._misfit(estimate, terms) + 0.5 * float(prior)

    def _normal(self, estimate: Array, terms: _Terms) -> tuple[Array, Array]:
        """Return the normal matrix (P, P) and the descent (P,) of the cost."""
        (weights, y, _, H), n = terms, self._n
        (_, R, *_), stretch = _parts(estimate), math.exp(estimate[-1])
        c = self._places(estimate, terms)
        shown, A = images.rays(c, stretch), images.ray_jacobian(c, stretch)
        AR, G = A @ R, rotation.generators(3)
        turns = A @ G.dot(c.T).transpose(2, 1, 0)  # c moves by φ × c
        rows = np.concatenate([AR @ H, -AR, turns, shown[..., np.newaxis]], axis=2)
        rows = rows.reshape(-1, self._size)
        weighted, (away, turned) = rows * weights.reshape(-1, 1), self._away(estimate)
        descent = (y - shown).ravel().dot(weighted) - self._prior * away
        descent[n + 3 : n + 6] -= 0.5 * self._prior[-2] * (G @ R).reshape(3, -1).dot(turned)
        return weighted.T.dot(rows) + np.diag(self._prior), descent

    def _improved(self, estimate: Array, terms: _Terms, steps: int) -> tuple[Array, float]:
        """Return an estimate after some steps of Levenberg and Marquardt, and its cost."""
        cost, free = self._cost(estimate, terms), self._free
        for _ in range(steps if math.isfinite(cost) else 0):  # nothing leads out from behind it
            normal, descent = self._normal(estimate, terms)
            normal, descent = normal[np.ix_(free, free)], descent[free]
            for damping in _DAMPING:
                step = np.zeros(self._size)
                damped = normal + np.diag(damping * self._prior[free])
                step[free] = np.linalg.solve(damped, descent)
                (u, R, p, stretch), n = _parts(estimate), self._n
                step = step / max(1.0, math.hypot(*step[n + 3 : n + 6].tolist()) / _TURN)
                R, p = law.rotation_exp(step[n + 3 : n + 6]).dot(R), p + step[n : n + 3]
                new = np.concatenate([u + step[:n], R.ravel(), p, [stretch + step[-1]]])
                lower = self._cost(new, terms)
                if lower < cost:
                    estimate, cost = new, lower
                    break
            else:
                break
        return estimate, cost

    def _placed(self, estimate: Array, terms: _Terms) -> Array:
        """Return an estimate whose camera is moved back, and sideways, such that it sees them."""
        if self._prior[self._n] == 0.0:  # where it is is known
            return estimate
        weights, placed = terms[0][:, 0] / terms[0][:, 0].sum(), estimate.copy()
        c = self._places(estimate, terms)
        back = 0.0 if c[:, 2].min() > _NEAREST else _PLACED - float(c[:, 2].min())
        c[:, 2] += back
        beside = weights.dot(c[:, 2:] * terms[1] * math.exp(-estimate[-1]) - c[:, :2])
        placed[-4:-1] -= np.append(beside, back).dot(_parts(estimate)[1])
        return placed

    def _another(self, terms: _Terms, rank: int) -> Array:
        """Return another estimate to begin with: a camera elsewhere about the points, and rolled.

        Every other one is from where it is believed, at the believed depth; the others are from
        views whose images are alike but for turn and size, the best first.
        """
        weights, y, o, H = terms
        w = weights[:, 0] / weights[:, 0].sum()
        placed = self._placed(self._first, terms)
        u, R, p, stretch = _parts(placed)
        r = o + H.dot(u)
        depth = max(float(w.dot((r - p).dot(R[2]))), _PLACED)
        R = R @ (np.eye(3)[np.newaxis] if rank % 2 == 0 else self._views)
        center = depth * np.append(math.exp(-stretch) * w.dot(y), 1.0)
        c = (r - w.dot(r)) @ R.transpose(0, 2, 1) + center
        c[..., 2] = np.maximum(c[..., 2], _NEAREST)
        turns, left = images.image_turn(c[..., :2] / c[..., 2:], y, weights[:, 0])
        best = np.argsort(left)[(rank // 2) % min(_VIEWS, len(left))]
        rolled = law.rotation_exp(np.array([0.0, 0.0, turns[best]])).dot(R[best])
        placed[self._n : -4] = rolled.ravel()
        if self._prior[self._n] > 0.0:
            placed[-4:-1] = w.dot(r) - center.dot(rolled)
        return placed
