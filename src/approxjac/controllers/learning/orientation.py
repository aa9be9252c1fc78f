"""The orientation of a tool, learnt with its position."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.learning.estimator import PredictedError
from approxjac.interface import Target
from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.validation import Array

_AXES = np.eye(3)
_AXES.flags.writeable = False


class Orientation:
    """R_x = R R_f(q) T: R_f is that of the believed frame, T the tool's in it, R that of a tracker.

    To the estimators the three axes of x are points ℓ R_x e_k, linear in the nine numbers of T: R
    is one for them and the position, and what the sums over frames have to hold does not change.
    T is the rotation nearest to the nine: with R known, the average of R_fᵀRᵀR_x and the prior.
    Of a rotation vector φ, Σ‖ℓ[φ]ₓ e_k‖² = 2ℓ²‖φ‖²; so with ℓ = L/√2, and L the noise of
    positions over that of angles, both weigh as their noise says.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The believed robot.
        frame: The frame.
        length: L, metres that a radian counts as.
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
        """Return how far one of these points moves from one configuration to another [m]."""
        moved = self.frame_rotation(q) - self.frame_rotation(q_0)
        return law.length(moved.ravel()) * (self._l / math.sqrt(2.0))

    def left(self, points: Array, predicted: Array) -> Array:
        """Return the rotation vector from predicted points to measured ones, in L, (3,) [m]."""
        is_seen = np.isfinite(points[0])
        R = np.where(is_seen, points, 0.0).reshape(3, 3).T / self._l
        nearest = law.nearest_rotation(predicted.reshape(3, 3))
        return np.where(is_seen, self.length * law.rotation_log(R.dot(nearest)), math.nan)

    @staticmethod
    def told(numbers: Array) -> Array:
        """Return T of the nine numbers vec(Tᵀ), shape (3, 3)."""
        return law.nearest_rotation(numbers.reshape(3, 3).T)

    @staticmethod
    def told_by(numbers: Array) -> Array:
        """Return the rotation vector that small changes of the nine turn T by, a map (3, 9)."""
        tangents = law.tangents(Orientation.told(numbers)).reshape(3, 3, 3)
        return 0.5 * tangents.transpose(1, 0, 2).reshape(9, 3).T

    # -- for the law ----------------------------------------------------------------------

    def first(self, q: Array, quaternion: Array, R: Array) -> tuple[Array, Any]:
        """Return the T with which the first x is as predicted, (3, 3), and whether it is seen."""
        R_x, is_seen = law.rotation_of(quaternion)
        return self.frame_rotation(q).T.dot(R.T).dot(R_x), is_seen

    def apart(
        self, q: Array, before: tuple[Array, Array], goal: tuple[Array, Array], integral: Array
    ) -> tuple[Array, Array]:
        """Return how far the orientations of (R, T) are apart, and how to make it the tool's.

        Args:
            q: Configuration, (nq,).
            before: R and T as they are.
            goal: R and T as they are to be.
            integral: Rotation vector by which the orientation is to be beside that, in L [m].

        Returns:
            Rotation vector in the sensor's axes (3,), and the rotation from these axes to those in
            which T turns (3, 3).
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

        Args:
            q: Configuration, (nq,).
            v: q̇, (n_v,).
            target: Quaternion of R_d (4,), ω_d and its rate (3,) in the sensor's axes.
            T: The tool's rotation.
            T_spin: Its angular velocity, T' = [T_spin]ₓT.
            R: The sensor's rotation.
            spin: Its angular velocity.
        """
        x_d, x_d_dot, x_d_ddot = target
        R_d, is_some = law.rotation_of(x_d)
        J, R_f, _ = self._frame.motion(q)
        J = J[3:].copy()
        drift = R_f.dot(T_spin)
        D = R.T.dot(law.select(is_some, R_d, _AXES))
        E = R_f.dot(T).dot(D.T)
        x_d_dot, x_d_ddot = _back(R, spin, x_d_dot, x_d_ddot)
        speed, of_target = J.dot(v), x_d_dot - R.T.dot(spin)
        # of E' = [ω]ₓE, ω = speed + drift − E of_target; ż is no ω, but for small z
        z_dot = law.log_rate(E, speed + drift - E.dot(of_target))
        drift = z_dot - speed + x_d_dot
        J_dot = self._frame.jacobian_dot(q, v)[3:]
        return PredictedError(law.rotation_log(E), J, J_dot, x_d_dot, x_d_ddot, drift)


def _back(R: Array, spin: Array, x_d_dot: Any, x_d_ddot: Any) -> tuple[Array, Array]:
    """Return Rᵀẋ_d and its rate."""
    x_d_dot = np.zeros(3) if x_d_dot is None else x_d_dot
    x_d_ddot = np.zeros(3) if x_d_ddot is None else x_d_ddot
    return R.T.dot(x_d_dot), R.T.dot(x_d_ddot - law.cross_matrix(spin).dot(x_d_dot))
