"""`TaskController`: the base of `SetpointController`, which checks the arguments of a step."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, Measurement, Target
from approxjac.tasks import Task
from approxjac.validation import Array, Immutable, as_number, as_vector

FLOAT64 = np.dtype(np.float64)
_MAKES_ONE = "numpy.array({0}, dtype=float) makes one of numbers"
_NUMBERS = (list, tuple, int, float)
HUGE = 1e30  # below it nothing overflows in the law with gains that make sense


class TaskController(Immutable, ABC):
    """A law of one task in continuous time: arguments are checked here, the law is in `_answer`.

    The usual case costs one comparison of shapes and one sum; only an unusual one is taken apart.

    Attributes:
        task: The task of the believed robot.
        dt: None: any sampling time will do.
    """

    task: Task
    dt: None = None

    def _take(self, task: Task, n_state: int) -> None:
        """Keep the task and the shapes that the arguments of an evaluation have."""
        robot = task.robot
        self.task = task
        self._subtracts = task._subtracts  # as most do
        self._n_state = n_state
        self._shapes = ((robot.nq,), (robot.nv,), (task.n_x,), (task.n_x,), (n_state,))
        self._continuous = robot.nq != robot.nv
        self._no_rate = np.zeros(n_state)
        self._no_rate.flags.writeable = False

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after dt [s], one Euler step of its rate, and the answer of `evaluate`.

        Raises:
            MeasurementError: As `evaluate`.
            InvalidInputError: As `evaluate`, or a dt that is not positive.
        """
        answer = self.evaluate(state, measurement, target)
        if not (isinstance(dt, float) and 0.0 < dt < math.inf):
            dt = as_number("dt", dt, unit="s", above=0.0)
        return state + dt * answer.state_rate, answer  # type: ignore[operator]  # a law has a rate

    def evaluate(
        self, state: Array, measurement: Measurement, target: Target | Array
    ) -> Evaluation:
        """Return torque and rate of the state for one measurement.

        A measurement x that is not finite counts as lost: then there is no position force, only
        damping (by K_v and B_c, where the law has them) and gravity compensation, and learning
        rests.

        Args:
            state: Controller state, shape (n_state,).
            measurement: t, q, v and the measured x.
            target: x_d, shape (n_x,) [unit of the task], or a `Target` that moves.

        Raises:
            MeasurementError: q or v not finite, or a torque that overflows.
            InvalidInputError: Wrong shapes or types, a target or state that is not finite, or
                (cos, sin) pairs of continuous joints off the unit circle.
        """
        x_d_dot = None
        if isinstance(target, Target):
            target, x_d_dot, _ = target
            if x_d_dot is not None:
                x_d_dot = as_vector("v of the target", x_d_dot, self.task.m)
        try:
            _, q, v, x, _ = measurement
            usual = (
                (q.shape, v.shape, x.shape, target.shape, state.shape) == self._shapes
                and q.dtype is v.dtype is x.dtype is target.dtype is state.dtype is FLOAT64
            )
        except (TypeError, ValueError, AttributeError):
            usual = False
        if not usual:
            q, v, x = self._require_arrays(state, measurement, target)
        # One number that is not small if anything is not finite. Unlike sums of squares it
        # overflows without a warning, and it is faster.
        size = math.hypot(*q.tolist(), *v.tolist(), *x.tolist(), *target.tolist(), *state.tolist())
        if size < HUGE:
            e = x - target if self._subtracts else self.task.error(x, target)
            if self._subtracts or math.isfinite(e.dot(e)):
                if self._continuous:
                    self.task.robot.configuration(q)
                answer = self._answer(q, v, x, e, state, x_d_dot, lost=False)
                torque = answer.torque
                if torque.dot(torque) < HUGE:  # a task or a saturation of one's own may fail
                    return answer
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is a named error
            e = x - target if self._subtracts else self.task.error(x, target)
            lost = self._require_finite(q, v, x, target, state, e)
            self.task.robot.configuration(q)
            try:
                answer = self._answer(q, v, x, e, state, None if lost else x_d_dot, lost)
                if np.isfinite(answer.torque).all() and np.isfinite(answer.state_rate).all():  # type: ignore[arg-type]
                    return answer
            except np.linalg.LinAlgError:  # no eigenvalues: Ĵ has overflowed
                pass
        raise MeasurementError(
            f"the torque overflows or is no number at q = {q.tolist()}, v = {v.tolist()}, "
            f"x = {x.tolist()}: they are beyond what the law, or a task or saturation of your own, "
            "is for",
            given=measurement,
        )

    @abstractmethod
    def _answer(
        self,
        q: Array,
        v: Array,
        x: Array,
        e: Array,
        state: Array,
        x_d_dot: Array | None,
        lost: bool,
    ) -> Evaluation:
        """Evaluate the law at inputs that have been checked."""

    def _require_arrays(
        self, state: Array, measurement: Measurement, target: Array
    ) -> tuple[Array, Array, Array]:
        """Refuse an argument that is no array of floats of its shape; return q, v and x."""
        try:
            _, q, v, x, _ = measurement
        except (TypeError, ValueError):
            raise InvalidInputError(
                f"measurement must be Measurement(t, q, v, x), got {measurement!r}",
                given=measurement,
            ) from None
        names = ("q", "v", "x", "target", "state")
        for name, value, shape in zip(names, (q, v, x, target, state), self._shapes, strict=True):
            if not isinstance(value, np.ndarray) or value.shape != shape:
                given = value.shape if isinstance(value, np.ndarray) else type(value).__name__
                raise InvalidInputError(
                    f"{name} must be an array of shape {shape} for {self.task!r}, got {given}"
                    + (f"; {_MAKES_ONE.format(name)}" if isinstance(value, _NUMBERS) else ""),
                    given=value,
                )
            if value.dtype != FLOAT64:  # differences of unsigned pixels would wrap around
                raise InvalidInputError(
                    f"{name} must be an array of float64, got {value.dtype}; "
                    f"{name}.astype(float) makes one of numbers",
                    given=value,
                )
        return q, v, x

    def _require_finite(
        self, q: Array, v: Array, x: Array, target: Array, state: Array, e: Array
    ) -> bool:
        """Refuse anything but x that is not finite; return whether x is lost."""
        for name, value in (("q", q), ("v", v)):
            if not np.isfinite(value).all():
                raise MeasurementError(
                    f"{name} must be finite, got {value.tolist()}: no safe torque exists without "
                    "the joint state; stop the robot",
                    given=value,
                )
        if not np.isfinite(state).all():
            raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)
        self.task.target(target)
        if np.isfinite(e).all():
            return False
        if np.isfinite(x).all() and self._subtracts:
            raise MeasurementError(
                f"the error overflows: x = {x.tolist()} is beyond what the law can be evaluated at",
                given=x,
            )
        return True


def is_beyond(torque: Array, limits: Array) -> bool:
    """Return whether any torque is beyond its limit, both of shape (n_v,)."""
    share = torque / limits
    # the norm first: it is cheap, and mostly small enough
    return bool(math.hypot(*share.tolist()) > 1.0 and np.abs(share).max() > 1.0)
