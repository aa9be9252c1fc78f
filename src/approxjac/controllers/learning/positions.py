"""`AdaptiveKinematics`: tool, joint origins and camera, learnt from the measured x."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers.arguments import chosen_kinds, is_rotation
from approxjac.controllers.learning.estimator import JUMP, WINDOW, Estimator, Frame
from approxjac.controllers.learning.kinematic_report import TiltedAxes
from approxjac.controllers.learning.unknowns import KINDS, Unknowns
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.law import PredictedError
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
_ODDS = 2.0  # of another rotation against the one at hand, as a logarithm, before it is taken
_SD_TILT = 0.1  # of an axis that may be tilted [rad]
_SAME = 0.8  # of tr(AᵀA'): about 45°, nearer than which rotations are one to Newton's method


class AdaptiveKinematics(Estimator):
    """x̂ = R̂ p(q; θ̂) + b̂, learnt from the measured x while the arm moves.

    Learnt are the translations of the tool and of all joint origins, and rotation, offset and
    scale of a camera or tracker, as chosen. What the law controls is the *predicted* x̂, a known
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
        self.task = task = PositionTask(task) if isinstance(task, Robot) else task
        self.unknown = unknown
        noise = as_number("noise", noise, unit="m", above=0.0)
        angle_noise = as_number("angle_noise", angle_noise, unit="rad", above=0.0, most=1.0)
        self._unknowns = unknowns = Unknowns(task, unknown, sd, noise / angle_noise)
        self.noise = as_number("noise", noise, unit="m", above=0.0, most=unknowns.largest_noise)
        self.regressor, self._orientation = unknowns.regressor, unknowns.orientation
        self.names, self.units = unknowns.names, unknowns.units
        self._believed, self._sd = unknowns.believed, unknowns.sd
        kind = _UnknownRotation if unknowns.turns else _KnownRotation
        self._estimator: _LeastSquares = kind(unknowns, noise)
        self._turns, self._d = unknowns.turns, unknowns.d
        self._is_turned, self._n_p = unknowns.is_turned, len(unknowns.constant)
        turns, is_pose = unknowns.turns, unknowns.orientation is not None
        n, n_p, spin = unknowns.n_u, self._n_p, len(law.generators(self._d)) if turns else 0
        sizes = {
            "sums": self._estimator.size, "chi": 2, "placed": task.n_x,
            "R": self._d**2 if turns else 0, "R_spin": spin,
            "T": 9 if is_pose else 0, "T_spin": 3 if is_pose else 0,
            "u": n, "b": n_p, "u_dot": n, "b_dot": n_p,
        }  # fmt: skip
        n_points = len(unknowns.points(np.zeros(task.n_x)))
        self._lay_out(sizes, delay, dt, n_points, JUMP * noise)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.task!r}, unknown={self.unknown})"

    # -- learning ------------------------------------------------------------------------

    def _points(self, x: Array) -> Array:
        return self._unknowns.points(x)

    def _begin(self, state: Array) -> None:
        at, unknowns = self._at, self._unknowns
        state[at["sums"]] = self._estimator.initial()
        state[at["learnt"]] = unknowns.believed
        state[at["chi"]] = 1.0, 0.0
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

    def _correct(self, state: Array, frame: Frame, since: Any, is_anew: Any) -> None:
        at, unknowns, x = self._at, self._unknowns, frame.x
        averaged, chi = state[at["averaged"]], state[at["chi"]]
        kept = -np.expm1(-since / WINDOW)
        # as it was said, or as seen from frame to frame
        noise = np.maximum(self.noise, np.sqrt(np.maximum(state[at["noted"]][2], 0.0)))
        usual = noise * np.sqrt(kept / (2.0 - kept))  # of what noise leaves of an average
        # what was not explained all along is no news
        unexplained = np.sqrt(np.minimum(np.maximum(chi[0], 1.0), _WORST))
        changed = unexplained * np.maximum(_CHANGED[0], _CHANGED[1] * usual)
        law.alter(is_anew | (np.abs(averaged).max() > changed), state, self._renew)
        H, known = unknowns.regression(frame.q)
        H_T = np.concatenate([H, unknowns.tilts(frame.q, state[at["u"]])], axis=1)
        seen, z, o = np.isfinite(x), x, known
        if not law.surely(law.all_of(seen)):  # what is lost has no part in the sums
            z, o = np.where(seen, x, 0.0), np.where(seen, known, 0.0)
            H_T = np.where(seen[:, np.newaxis], H_T, 0.0)
        share = -np.expm1(-_FORGETTING * since)
        state[at["sums"]] = sums = self._estimator.learn(state[at["sums"]], H_T, o, z, share)
        Theta, R = self._estimator.estimate(sums)
        state[at["learnt"]] = unknowns.in_order(Theta, R)
        left = unknowns.left(x, self._turned(R, known + H.dot(Theta)))
        self._account(state, left, since)
        seen = np.isfinite(left)
        square = (np.where(seen, averaged, 0.0) ** 2).sum() / np.where(seen, 1.0, 0.0).sum()

        def look(chi: Array) -> None:
            """Average χ² as time has passed."""
            chi[1] += since
            chi[0] += since / np.minimum(chi[1] + 1.0, _MEMORY) * (square / usual**2 - chi[0])

        law.alter(kept > _NO_TIME, chi, look)

    def _renew(self, state: Array) -> None:
        """Begin anew where what was learnt is contradicted, as by a tool that slipped, in place."""
        at = self._at
        sums, chi = state[at["sums"]], state[at["chi"]]
        # or it was a false start, of which χ² says nothing either
        was_learnt = state[at["noted"]][0] > _BELIEVED
        initial = self._estimator.initial()
        state[at["sums"]] = np.where(was_learnt, self._estimator.renewed(sums), initial)
        chi[0], chi[1] = law.select(was_learnt, chi[0], 1.0), law.select(was_learnt, chi[1], 0.0)
        self._forget(state)

    # -- the smoothed estimates ----------------------------------------------------------

    def _aim(self, state: Array, q: Array, dt: float) -> None:
        # u and R follow, and the offset such that x̂ at q does; of a pose so does T
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
        turn = law.rotation_log(R.dot(smooth_R.T)) if self._turns else np.zeros(3)
        turns = [turn] if self._turns else []
        if self._orientation is not None:
            T, T_goal = state[at["T"]].reshape(3, 3), self._unknowns.tool(state[at["learnt"]])
            smooth, goal = (smooth_R, T), (R, T_goal)
            apart, back = self._orientation.apart(q, smooth, goal, integral[n_p:])
            turns.append(apart)
        rate = self._eased(dt, law.length(away), *turns)
        if self._orientation is not None:
            state[at["T_spin"]] = rate * back.dot(apart - turn)
        state[at["u_dot"]] = u_dot = rate * (u - smooth_u)
        b_dot = rate * away - self._turned(smooth_R, H.dot(u_dot))
        if self._turns:
            state[at["R_spin"]] = spin = rate * turn
            b_dot = b_dot - self._turned(law.cross_matrix(spin).dot(smooth_R), smooth_p)
        state[at["b_dot"]] = b_dot

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
        R, spin = self._rotation(state), state[at["R_spin"]] if self._turns else np.zeros(3)
        positions = self._positions(state, q, v, Target(x_d[:3], v_p, a_p))
        turns = self._orientation.predict(
            q, v, Target(x_d[3:], v_r, a_r), T, state[at["T_spin"]], R, spin
        )
        return PredictedError(*map(np.concatenate, zip(positions, turns, strict=True)))

    def _positions(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error of positions x̂ = R̂p + b̂, in the base's axes."""
        at, unknowns = self._at, self._unknowns
        theta, theta_dot = unknowns.translations(state[at["u"]]), unknowns.rates(state[at["u_dot"]])
        p, J, J_dot, drift = unknowns.seen(self.regressor.motion(q, v, theta, theta_dot))
        x_d, x_d_dot, x_d_ddot = target
        x_d_dot = np.zeros(len(p)) if x_d_dot is None else x_d_dot
        x_d_ddot = np.zeros(len(p)) if x_d_ddot is None else x_d_ddot
        away, b_dot, spin = state[at["b"]] - x_d, state[at["b_dot"]], state[at["R_spin"]]
        if self._is_turned:
            # rows are vectors: x R is Rᵀx. With R' = [ω]ₓR, Rᵀx changes by Rᵀ(x' + [ω]ₓᵀx)
            vectors = np.array([away, x_d_dot, b_dot, x_d_ddot]).reshape(-1, self._d)
            if len(spin):
                half = len(vectors) // 2
                vectors[half:] += vectors[:half].dot(law.cross_matrix(spin))
            back = vectors.dot(self._rotation(state))
            away, x_d_dot, b_dot, x_d_ddot = back if len(back) == 4 else back.reshape(4, -1)
        return PredictedError(p + away, J, J_dot, x_d_dot, x_d_ddot, drift + b_dot)

    # -- what was learnt -----------------------------------------------------------------

    def _is_state(self, state: Array) -> bool:
        sums = state[self._at["sums"]]
        return is_rotation(self._rotation(state)) and self._estimator.are_numbers(sums)

    def _covariance(self, state: Array) -> tuple[Array, float]:
        sums = state[self._at["sums"]]
        Theta, _ = self._estimator.estimate(sums)
        covariance = self._unknowns.merged(self._estimator.covariance(sums), Theta)
        return covariance, float(state[self._at["chi"]][0])

    def _in_units(self, covariance: Array, learnt: Array) -> Array:
        return self._unknowns.unscaled(covariance, learnt)

    def _axes(self, state: Array) -> TiltedAxes:
        noise = max(self.noise, math.sqrt(state[self._at["noted"]][2]))
        sums, joints = state[self._at["sums"]], self.regressor.turning
        return self._estimator.tilted_axes(sums, joints, (self.noise / noise) ** 2)

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and origins."""
        theta, learnt = self.regressor.theta.copy(), self.learnt(self._required(state))
        n = len(self._unknowns.of_theta)
        theta[self._unknowns.of_theta] = learnt[:n]
        turn = learnt[n : n + 3] if self._unknowns.n_t else None
        return self.regressor.robot_with(theta, turn)


class AdaptivePlanarCamera(AdaptiveKinematics):
    """x̂ = m R̂ p(q; θ̂) + d̂, learnt from the image in a `PlanarCamera` while the arm moves.

    It is `AdaptiveKinematics` of the position in the arm's plane, with x as the believed camera
    would locate it. A wrong magnification m is learnt as lengths that are wrong by its factor:
    images tell the two from each other by nothing.

    Args:
        task: An `ImageTask` of the believed robot with a `PlanarCamera`, for one frame's origin.
        unknown: As of `AdaptiveKinematics`, as are errors and what is not listed here; "camera" is
            roll and offset, and "camera.turn" from the believed camera to the learnt one.
        sd: In the arm's plane. By default "tool" and "origins" are as wrong as magnification and
            lengths may be: 0.5 m.
        noise: Standard deviation of x [m on the sensor].
        delay: Age of x where `Measurement.t_x` is None [s].
        dt: Sampling time of control [s].
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
        c, s = np.cos(camera.roll), np.sin(camera.roll)
        self._seen_R, self._seen_d = np.array([[c, s], [-s, c]]), np.asarray(camera.offset)

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,), turned into the base's axes.

        In the size that it has on the sensor of the believed camera [m].
        """
        x_d, *rates = target
        rates = [None if rate is None else rate.dot(self._seen_R) / self._m for rate in rates]
        located = Target((x_d - self._seen_d).dot(self._seen_R) / self._m, *rates)
        return PredictedError(*(self._m * each for each in super().predict(state, q, v, located)))

    def _own(self, measurement: Measurement) -> Measurement:
        """Return a measurement with x in the arm's plane, as the believed camera has it."""
        x = (measurement.x - self._seen_d).dot(self._seen_R) / self._m
        return measurement._replace(x=x)


class _LeastSquares(ABC):
    """Least squares of x = R(o + HΘ), of which a state has the sums: `size` numbers.

    Matrices (P, P) of these are kept as their upper triangles, as a state is copied and recorded.
    """

    size: int

    def __init__(self, unknowns: Unknowns, noise: float) -> None:
        self._first, self._R, self._d = unknowns.Theta, unknowns.R, unknowns.d
        self._n_u, self._P = unknowns.n_u, len(unknowns.Theta)
        tilts = np.full(unknowns.n_tilts, _SD_TILT)  # which are looked for and not learnt
        self.prior = np.diag(np.append(unknowns.sd_Theta, tilts) ** -2.0)
        self._weight = noise**-2.0
        n = len(self.prior)
        rows, columns = np.triu_indices(n)
        self._upper, self._n = rows * n + columns, len(rows)
        self._where = np.zeros((n, n), dtype=int)
        self._where[rows, columns] = self._where[columns, rows] = np.arange(len(rows))

    def _pack(self, matrix: Array) -> Array:
        return np.asanyarray(matrix.ravel()[self._upper])

    def _unpack(self, numbers: Array) -> Array:
        return np.asanyarray(numbers[self._where])

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._first, self._R.T)

    def are_numbers(self, numbers: Array) -> bool:
        """Return whether they can be those of such an estimator."""
        # forgetting goes towards the prior, so nothing is ever known less well
        diagonal = self._unpack(numbers).diagonal()
        return bool((diagonal > 0.99 * self.prior.diagonal()).all())

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        Theta, R = self.estimate(numbers)
        return self._about(Theta, R.T)

    @abstractmethod
    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor in the base's axes, 0 in rows that are lost, (m, P), and of tilts, (m, t):
                shape (m, P + t).
            o: What of them is known, shape (m,).
            x: What is measured, shape (m,).
            share: λT, to be forgotten.
        """

    @abstractmethod
    def estimate(self, numbers: Array) -> tuple[Array, Array]:
        """Return Θ̂ in the base's axes, (P,), and R̂ of the base's axes in the sensor's, (d, d)."""

    @abstractmethod
    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b), and of φ with R ← exp([φ]ₓ)R where R is learnt."""

    @abstractmethod
    def _about(self, Theta: Array, A: Array) -> Array:
        """Return the numbers of the prior alone, about these estimates, with A = Rᵀ."""

    @abstractmethod
    def _tilts(self, numbers: Array) -> tuple[float, Array, Array]:
        """Return by how much tilts of axes lower the sum of squares, which, and covariance."""

    def tilted_axes(self, numbers: Array, joints: Sequence[str], scale: float) -> TiltedAxes:
        """Judge whether tilts of the axes of joints, two each, would explain more.

        Args:
            numbers: Shape (size,).
            joints: Their names.
            scale: Of the noise's variance, as it is given over what it is.
        """
        if len(self.prior) == self._P:
            return TiltedAxes()
        fall, tilts, covariance = self._tilts(numbers)
        variances = covariance.diagonal()
        freedom = float((1.0 - variances / _SD_TILT**2).sum())  # of `fall`, if none is tilted
        pairs = np.array([tilts, tilts / np.sqrt(variances)]).reshape(2, -1, 2)
        joint = int(np.linalg.norm(pairs[1], axis=1).argmax())
        angle = float(np.linalg.norm(pairs[0, joint]))
        return TiltedAxes(fall / max(freedom, 1e-9) * scale, freedom, joints[joint], angle)


class _KnownRotation(_LeastSquares):
    """Rᵀx = o + HΘ with R known: recursive least squares with forgetting towards the prior.

    Theorem A. Its numbers: Λ, Θ̂.
    """

    def __init__(self, unknowns: Unknowns, noise: float) -> None:
        super().__init__(unknowns, noise)
        self._is_turned = not np.array_equal(self._R, np.eye(self._d))
        self.size = self._n + len(self.prior)

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        if self._is_turned:
            x = x.reshape(-1, self._d).dot(self._R).ravel()
        P, n, x = self._P, self._n, x - o
        N = law.forgotten_information(self._unpack(numbers), self.prior, share)
        N, T, H = law.information(N, H, self._weight), H[:, P:], H[:, :P]
        Theta, pull = numbers[n : n + P], numbers[n + P :]
        Theta = Theta + law.correction(N[:P, :P], H, self._weight, x - H.dot(Theta))
        pull = (1.0 - share) * pull + self._weight * x.dot(T)
        return np.concatenate([self._pack(N), Theta, pull])

    def estimate(self, numbers: Array) -> tuple[Array, Array]:
        return numbers[self._n : self._n + self._P].copy(), self._R

    def information(self, numbers: Array) -> Array:
        """Return Λ, shape (P, P)."""
        return self._unpack(numbers)[: self._P, : self._P]

    def covariance(self, numbers: Array) -> Array:
        n = self._n_u
        covariance = np.asarray(np.linalg.inv(self.information(numbers)), dtype=np.float64)
        if self._is_turned and n < self._P:
            covariance[n:] = self._R.dot(covariance[n:])
            covariance[:, n:] = covariance[:, n:].dot(self._R.T)
        return covariance

    def _tilts(self, numbers: Array) -> tuple[float, Array, Array]:
        n, P, N = self._n, self._P, self._unpack(numbers)
        pull = numbers[n + P :] - N[P:, :P].dot(numbers[n : n + P])
        left = np.linalg.inv(N[P:, P:] - N[P:, :P].dot(np.linalg.solve(N[:P, :P], N[:P, P:])))
        return float(pull.dot(left).dot(pull)), left.dot(pull), left

    def _about(self, Theta: Array, A: Array) -> Array:
        return np.concatenate([self._pack(self.prior), Theta, np.zeros(len(self.prior) - self._P)])


class _UnknownRotation(_LeastSquares):
    """x = R(o + Hu + c), with R any rotation: exact least squares over all frames at once.

    Theorem B. In the base frame Rᵀx = o + Hu + c, and as R changes no lengths, the sums over frames
    that the least squares need do not depend on R. So all frames are remembered, exactly, in sums
    N, a, B and E of fixed size: for a rotation A = Rᵀ, with w = vec A,

        Θ(A) = N⁻¹(a + Bw), and A maximises ½(a + Bw)ᵀN⁻¹(a + Bw) + Eᵀw

    over rotations only, 3 numbers (1 in the plane) instead of all, and looked for everywhere.
    Forgetting is towards the prior about what is estimated now, which leaves the estimate where it
    is; Theorem B then holds where the sum of squares is as convex as the prior.
    """

    def __init__(self, unknowns: Unknowns, noise: float) -> None:
        super().__init__(unknowns, noise)
        self._sd_R = unknowns.sd_R
        Q, dd = len(self.prior), self._d**2
        sizes = [self._n, Q, Q * dd, dd, self._P, dd]
        self.size = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self._parts = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._everywhere = law.rotations_everywhere(self._d).reshape(-1, dd)

    def _split(self, numbers: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Return N, a, B, E, and the estimates Θ and A."""
        N, a, B, E, Theta, A = (numbers[part] for part in self._parts)
        return N, a, B.reshape(len(a), -1), E, Theta, A.reshape(self._d, self._d)

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        d, P, W = self._d, self._P, self._weight
        *_, Theta, A = self._split(numbers)
        numbers = numbers + share * (self._about(Theta, A) - numbers)
        N, a, B, E, _, A = self._split(numbers)
        HW = W * H.T
        N = self._unpack(N) + HW.dot(H)
        if N.dtype.hasobject:  # symbols are symmetric only where they are the same
            N = self._unpack(self._pack(N))
        a = a - HW.dot(o)
        seen = x.reshape(-1, d)
        each = HW.reshape(len(a), -1, d).transpose(0, 2, 1).dot(seen)  # Σ Hᵀ x
        B = B + each.reshape(len(a), -1)
        E = E + (W * o.reshape(-1, d).T.dot(seen)).ravel()
        solved, M, h = _reduced(N[:P, :P], a[:P], B[:P], E)
        w = self._rotation(M, h, A).ravel()
        Theta = solved[:, 0] + solved[:, 1:].dot(w)
        return np.concatenate([self._pack(N), a, B.ravel(), E, Theta, w])

    def estimate(self, numbers: Array) -> tuple[Array, Array]:
        *_, Theta, A = self._split(numbers)
        return Theta.copy(), A.T

    def covariance(self, numbers: Array) -> Array:
        # that of the least squares: rotation first, all else given the rotation
        d, P = self._d, self._P
        *_, Theta, A = self._split(numbers)
        G, joint = law.generators(d), self._joint(numbers, A, P)[0]
        # b = Rc with R = Aᵀ ← R exp(−[δ]ₓ), and φ = −Rδ (−δ in the plane)
        c, R = Theta[self._n_u :], A.T
        T = np.eye(P + len(G))
        T[self._n_u : P, self._n_u : P] = R
        T[self._n_u : P, P:] = -R.dot((G @ c).T)
        T[P:, P:] = -R if d == 3 else -1.0
        return np.asarray(T.dot(joint).dot(T.T))

    def _tilts(self, numbers: Array) -> tuple[float, Array, Array]:
        # with all else and the rotation best for them
        P, Q = self._P, len(self.prior)
        *sums, _, A = self._split(numbers)
        _, without, _ = self._joint(numbers, A, P)
        _, M, h = _reduced(self._unpack(sums[0]), *sums[1:])
        covariance, value, Theta = self._joint(numbers, law.best_rotation(M, h, A), Q)
        return 2.0 * (value - without), Theta[P:], covariance[P:Q, P:Q]

    def _joint(self, numbers: Array, A: Array, n: int) -> tuple[Array, float, Array]:
        """Return the covariance of the first n numbers and δ of A ← exp([δ]ₓ)A, and what is best.

        Returns:
            The covariance (n + 1 or 3) squared; the fall of the sum of squares from where all is 0,
            halved; the numbers, (n,).
        """
        N, a, B, E, *_ = self._split(numbers)
        N, a = self._unpack(N)[:n, :n], a[:n]
        solved, M, h = _reduced(N, a, B[:n], E)
        known, axes = np.linalg.eigh(law.rotation_information(M, h, A))
        # nothing is known less well than before
        of_delta = (axes / np.maximum(known, self._sd_R**-2.0)).dot(axes.T)
        moved = np.concatenate([solved[:, 1:].dot(law.tangents(A)), np.eye(len(of_delta))])
        covariance = moved.dot(of_delta).dot(moved.T)
        covariance[:n, :n] += np.linalg.inv(N)
        value = law.explained(M, h, A.ravel()) + 0.5 * float(a.dot(solved[:, 0]))
        return covariance, value, solved[:, 0] + solved[:, 1:].dot(A.ravel())

    def _rotation(self, M: Array, h: Array, A: Array) -> Array:
        """Return the best rotation near A, or one elsewhere that is better beyond doubt."""
        near = law.best_rotation(M, h, A)
        start = law.most_explained(M, h, self._everywhere)

        def elsewhere() -> tuple[Array]:
            other = law.best_rotation(M, h, start.reshape(A.shape))
            better = law.explained(M, h, other) > law.explained(M, h, near) + _ODDS
            return (law.select(better, other, near),)

        is_other = start.dot(near.ravel()) <= _SAME * self._d
        best: Array = law.choose(is_other, elsewhere, lambda: (near,))[0]
        return best

    def _about(self, Theta: Array, A: Array) -> Array:
        d, n, P, Q = self._d, self._n_u, self._P, len(self.prior)
        b = A.T.dot(Theta[n:])
        a = [self.prior.diagonal()[:n] * Theta[:n], np.zeros(Q - n)]
        B = np.eye(d)[:, :, np.newaxis] * (b * self.prior[n, n])
        of_B = [np.zeros(n * d * d), B.ravel(), np.zeros((Q - P) * d * d)]
        E = (0.5 / self._sd_R**2) * A.ravel()
        return np.concatenate([self._pack(self.prior), *a, *of_B, E, Theta, A.ravel()])


def _reduced(N: Array, a: Array, B: Array, E: Array) -> tuple[Array, Array, Array]:
    """Return N⁻¹[a B], and M and h of what rotations alone have to maximise."""
    solved = np.linalg.solve(N, np.concatenate([a[:, np.newaxis], B], axis=1))
    M = B.T.dot(solved[:, 1:])
    return solved, 0.5 * (M + M.T), B.T.dot(solved[:, 0]) + E
