"""`PredictedError`: the error that a law controls, predicted by known or learnt kinematics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Status, Target
from approxjac.robots import Robot
from approxjac.robots.kinematic_regressor import PointMotion
from approxjac.tasks import Task
from approxjac.validation import Array, Immutable, as_vector


class PredictedError(NamedTuple):
    """The error as the estimates have it at one instant, and all that its derivatives need.

    In the frame where the law works: the base frame, into which the target is pulled back. With
    Ĉ = R̂ᵀ/ŝ and ĉ = −Ĉb̂ of a camera or tracker x = sRp + b (Ĉ = I where it is known),
    z = p̂(q) − (Ĉx_d + ĉ) and, exactly, ż = Ĵq̇ − feed + drift. Unit of the task where the sensor
    measures in metres.

    Attributes:
        z: Predicted error, shape (m,).
        J: Ĵ, the exact Jacobian of the prediction, shape (m, n_v).
        J_dot: dĴ/dt along q̇ and the motion of the estimates, shape (m, n_v).
        feed: Ĉẋ_d, shape (m,).
        feed_dot: Its rate Ĉẍ_d + Ĉ'ẋ_d, shape (m,).
        drift: What the estimates move z by, ż − Ĵq̇ + feed, shape (m,).
    """

    z: Array
    J: Array
    J_dot: Array
    feed: Array
    feed_dot: Array
    drift: Array


class Kinematics(Immutable, ABC):
    """Kinematics, known or learnt, that predict what a law controls.

    It learns from the measured x in `step`, and from nothing else; `predict` is a function of its
    state, q and q̇. Its state is flat: it goes in and comes out.

    Immutable, but it owns scratch memory: one instance a thread.

    Attributes:
        task: The task of the believed robot.
        n_state: Length of a state.
    """

    task: Task
    n_state: int
    names: tuple[str, ...] = ()  # of what `learnt` returns
    units: tuple[str, ...] = ()
    _kept: tuple[slice, ...] = ()  # parts of a state that hold what was learnt

    @abstractmethod
    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,)."""

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return a state before a first step that knows what another state has learnt.

        Times, configurations and frames of the other one are forgotten.

        Raises:
            InvalidInputError: A state that is not of such kinematics.
        """
        state = self._required(state)
        fresh = self.initial_state(measurement)
        for part in self._kept:
            fresh[part] = state[part]
        return fresh

    @abstractmethod
    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later.

        A measurement whose x is lost, or has been seen before, teaches nothing.
        """

    def go_on(self, state: Array, measurement: Measurement, dt: float) -> None:
        """Make a state that of `step`, in place: thousands of numbers are slow to copy."""
        state[:] = self.step(state, measurement, dt)

    def status(self, state: Array, measurement: Measurement) -> Status:
        """Return what may be done by a state, if any, of kinematics that learn from x.

        `MEASUREMENT_LOST` before x was ever seen, so that what is predicted is as believed;
        `PREDICTED` where x is too old to be learnt from, for a second; else `OK`.
        """
        return Status.OK

    @abstractmethod
    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,) [rad/s or m/s]."""

    @abstractmethod
    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt, shape (…, p)."""

    @property
    def parameters(self) -> Mapping[str, str]:
        """Names and units of what `learnt` returns."""
        return dict(zip(self.names, self.units, strict=True))

    def sd_of(self, state: Array) -> Array:
        """Return the standard deviations of what a state has learnt, shape (p,)."""
        return np.array([row.sd for row in self.report(state).rows] if self.names else [])

    def _required(self, state: Array) -> Array:
        """Return a state of such kinematics, or refuse what is none."""
        state = as_vector("state", state, self.n_state)
        if not self._is_state(state):
            raise InvalidInputError(
                f"state must be one of {self!r}, as initial_state and step return it, got numbers "
                "that are not",
                given=state,
            )
        return state

    def _is_state(self, state: Array) -> bool:
        """Return whether finite numbers (n_state,) can be a state, as far as can be told."""
        return True

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and joint origins.

        Masses, friction and the tracker are not in it; a state that is saved has them all.

        Raises:
            InvalidInputError: Kinematics that learn nothing, or a state of others.
        """
        raise InvalidInputError(
            f"kinematics must learn to change a robot, got {self!r}", given=self
        )

    def report(self, state: Array) -> KinematicReport:
        """Return what a state has learnt: values, standard deviations, and what was not seen.

        Raises:
            InvalidInputError: Kinematics that learn nothing, or a state of others.
        """
        raise InvalidInputError(f"kinematics must learn to report, got {self!r}", given=self)


def pulled_back(
    motion: PointMotion, b: Array, b_dot: Array, R: Array | None, spin: Array, target: Target
) -> PredictedError:
    """Return the predicted error of positions x̂ = R̂p + b̂, with the target in the base's axes.

    Args:
        motion: Of the points.
        b: b̂, shape (m,).
        b_dot: Its rate, shape (m,).
        R: R̂ of each point's d axes, shape (d, d); None is none.
        spin: Its rate, (1 or 3,) [rad/s]; (0,) where it is known.
        target: The target, shape (m,).
    """
    p, J, J_dot, drift = motion
    x_d, feed, feed_dot = target
    nothing = np.zeros(len(p))
    feed = nothing if feed is None else feed
    feed_dot = nothing if feed_dot is None else feed_dot
    away = b - x_d
    if R is None:
        return PredictedError(p + away, J, J_dot, feed, feed_dot, drift + b_dot)
    # rows are vectors: x R is Rᵀx. With R' = [ω]ₓR, Rᵀx changes by Rᵀ(x' + [ω]ₓᵀx)
    vectors = np.array([away, feed, b_dot, feed_dot]).reshape(-1, len(R))
    if len(spin):
        half = len(vectors) // 2
        vectors[half:] += vectors[:half].dot(law.cross_matrix(spin))
    back = vectors.dot(R)
    away, feed, b_dot, feed_dot = back if len(back) == 4 else back.reshape(4, -1)
    return PredictedError(p + away, J, J_dot, feed, feed_dot, drift + b_dot)
