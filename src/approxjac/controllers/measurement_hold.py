"""`HeldMeasurement`: what was last seen, kept between images until the arm has moved too far."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Controller, Evaluation, Measurement, Status
from approxjac.tasks import Task
from approxjac.validation import Array, SetOnce, as_limits, as_number

_OK, _HELD = Status.OK, Status.MEASUREMENT_HELD  # members of an enum are slow to look up
_FLOAT = np.dtype(np.float64)
# Of the largest entry of a part. What is kept in a state has gone through old + dt·(new − old)/dt,
# which rounds; what differs by no more is the same image. (The round-off of an old one that was a
# thousand times larger is more, and gone a step later.)
_ROUND_OFF = 1e-12


class HeldMeasurement(SetOnce):
    """A controller that goes on with the last x that was seen, until the arm has moved too far.

    Images come some 30 times a second and some are lost; control runs at 1 kHz. What makes an old
    x wrong is not its age but the motion since, so there are no time stamps: what counts, for each
    of the task's `parts`, is how far the image must have moved since it last changed, as the
    believed Jacobian says,

        p = ∫ Ĵ q̇ dt

    This is a net displacement, in which noise of q̇ from an encoder does not add up. While every
    abs(pᵢ) <= unseenᵢ the controller gets the x that was last seen. A part beyond that is too old
    and stays it until it is seen again: the controller gets NaN there, and does what it does when
    a measurement is lost (no position force, damping and gravity compensation only, nothing
    learnt). An x that is lost, one that a camera repeats because no new image has come, and one
    that it repeats because it hangs, are all the same here: an arm at rest is told nothing new by
    them, and one that moves stops once it has moved too far without being seen. A new x ends it at
    once. A part that was never seen is too old.

    A part is new where it is finite and differs from the one last seen. Where a camera has noise,
    every new image does; without noise, one of an arm at rest does not, and need not.

    The status is that of the controller, or `MEASUREMENT_HELD` where that is `OK` and no part of x
    is new.

    What a controller or a limiter around it says of V is about the x that it was given, here the
    held one.

    Its state is that of the controller, then the last x (n_x,), p (m,), and for each part 1 if it
    was ever seen, else 0. All of it is finite always. Law (5) differentiates the x that is held, a
    staircase: with a time constant below the time between images its torque jumps at each of them.

    Immutable; one instance a thread, as the controller.

    Args:
        controller: What answers with Ĵ and has a task: a `SetpointController`,
            or `TorqueLimited` and the like around one.
        unseen: How far the image may move without being seen, a number or shape (m,) > 0, infinite
            for no limit [unit of the task]. Less than the arm moves from image to image (its
            fastest speed times the time between them, and a few more where some are lost) makes it
            stutter.
        dt: Sampling time of control [s], that of the controller where it has one.

    Attributes:
        controller: The controller.
        unseen: Shape (m,) [unit of the task].
        dt: Sampling time that control has to have [s].

    Raises:
        InvalidInputError: No such controller, another dt than the controller's, or numbers that
            are not > 0.
    """

    def __init__(
        self,
        controller: Controller,
        unseen: float | Sequence[float] | Array,
        dt: float = 1e-3,
    ) -> None:
        task = getattr(controller, "task", None)
        evaluates = hasattr(controller, "evaluate") and hasattr(controller, "initial_state")
        if isinstance(controller, HeldMeasurement):
            raise InvalidInputError(
                f"controller must be one that is not held yet, got {controller!r}", given=controller
            )
        if isinstance(controller, type) or not evaluates or not isinstance(task, Task):
            raise InvalidInputError(
                "controller must be a controller with a task, such as SetpointController(task), "
                f"got {controller!r}",
                given=controller,
            )
        self.controller = controller
        self.dt = as_number("dt", dt, unit="s", above=0.0)
        wanted = getattr(controller, "dt", None)
        if isinstance(wanted, float) and not math.isclose(self.dt, wanted):
            raise InvalidInputError(
                f"dt must be that of the controller, {wanted:g} [s], got {dt!r}", given=dt
            )
        self.unseen = as_limits("unseen", unseen, task.m, unit=task.measured.unit)
        self._task: Task = task
        self._measured = task.measured  # whose parts are lost one by one
        self._parts = self._measured.parts
        self._subtracts = self._measured.subtracts  # as most, and then x is as finite as its error
        self._origin = task.origin
        self._limits = [self.unseen[coordinates].tolist() for _, coordinates in self._parts]
        self._n_inner = controller.n_state
        self._x_end = self._n_inner + task.n_x
        self._p_end = self._x_end + task.m
        self._n_state = self._p_end + len(self._parts)

    @property
    def task(self) -> Task:
        """The task of the believed robot."""
        return self._task

    @property
    def law(self) -> Any:
        """The `SetpointController` that it is for, whose state comes first; None of others."""
        return getattr(self.controller, "law", None)

    @property
    def n_state(self) -> int:
        """Length of the controller's state, plus n_x, m and the number of parts."""
        return self._n_state

    def initial_state(self, measurement: Measurement) -> Array:
        """State before the first evaluation: nothing has been seen yet.

        Raises:
            InvalidInputError: As the controller.
            MeasurementError: As the controller, such as law (5) where the first x is lost.
        """
        state = self.controller.initial_state(measurement)
        unseen = np.zeros(self.task.m + len(self._parts))
        return np.concatenate([state, self._origin, unseen])

    def evaluate(self, state: Array, measurement: Measurement, target: Array) -> Evaluation:
        """Torque for one measurement, or for the x that was last seen.

        Args:
            state: State, shape (n_state,).
            measurement: t, q, v and the measured x, NaN where it is lost.
            target: x_d, shape (n_x,) [unit of the task].

        Returns:
            What the controller answers. Its e is that of the x that was used: of an earlier one
            where it is held, NaN where it is too old.

        Raises:
            MeasurementError: As the controller, or an x beyond what a state can keep.
            InvalidInputError: As the controller, or a controller that answers without Ĵ.
        """
        self._require(state, measurement)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is a named error
            answer = self._answer(state, measurement, target)
        if not math.isfinite(math.hypot(*answer.state_rate.tolist())):
            raise MeasurementError(
                f"the state overflows: x = {measurement[3].tolist()} and v = "
                f"{measurement[2].tolist()} are beyond what can be kept",
                given=measurement,
            )
        return answer

    def _answer(self, state: Array, measurement: Measurement, target: Array) -> Evaluation:
        """`evaluate` with a state and an x that have been checked."""
        t, q, v, x = measurement
        after = state.copy()
        last, p = after[self._n_inner : self._x_end], after[self._x_end : self._p_end]
        seen = after[self._p_end :]
        measured, before, moved = x.tolist(), last.tolist(), p.tolist()
        # numbers may be no measurement all the same, such as a quaternion of zeros
        errors = measured if self._subtracts else self._measured.error(x, self._origin).tolist()
        used, counts = x.copy(), None
        any_new = False
        for k, (entries, coordinates) in enumerate(self._parts):
            here = measured[entries]
            finite = all(map(math.isfinite, here + errors[coordinates]))
            never = seen[k] < 0.5  # a 1 may have been rounded
            if finite and (never or _differ(here, before[entries])):
                last[entries], p[coordinates], seen[k] = here, 0.0, 1.0
                any_new = True
            elif never or any(
                abs(far) > most
                for far, most in zip(moved[coordinates], self._limits[k], strict=True)
            ):
                used[entries] = math.nan
                counts = np.ones(len(p)) if counts is None else counts
                counts[coordinates] = 0.0
            elif not finite:
                used[entries] = before[entries]
        answer = self.controller.evaluate(
            state[: self._n_inner], Measurement(t, q, v, used), target
        )
        if answer.J_hat is None:
            raise InvalidInputError(
                f"controller must answer with J_hat, which says how far the image moves, "
                f"got {self.controller!r}, which has none",
                given=self.controller,
            )
        step = self.dt * self._task.measured_rate(answer.J_hat.dot(v))
        # p of what is too old stands still: an arm that sags back is not seen by that
        p += step if counts is None else counts * step
        rate = (after - state) / self.dt
        rate[: self._n_inner] = answer.state_rate
        status = _HELD if answer.status is _OK and not any_new else answer.status
        return answer._replace(state_rate=rate, status=status)

    def _require(self, state: Array, measurement: Measurement) -> None:
        """Refuse what the controller would not get to see, or not as it was given."""
        if not isinstance(measurement, tuple) or len(measurement) != 4:
            raise InvalidInputError(
                f"measurement must be Measurement(t, q, v, x), got {measurement!r}",
                given=measurement,
            )
        wanted = (("state", state, self._n_state), ("x", measurement[3], self.task.n_x))
        for name, value, size in wanted:
            if not isinstance(value, np.ndarray) or value.shape != (size,) or value.dtype != _FLOAT:
                array = isinstance(value, np.ndarray)
                given = f"{value.dtype} {value.shape}" if array else repr(value)
                raise InvalidInputError(
                    f"{name} must be an array of float64 of shape {(size,)}, got {given}",
                    given=value,
                )
        if not math.isfinite(math.hypot(*state[self._n_inner :].tolist())):
            raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)

    def with_task(self, task: Task) -> HeldMeasurement:
        """Return this for its controller with another task."""
        controller: Any = self.controller
        return type(self)(controller.with_task(task), self.unseen, self.dt)

    def __reduce__(self) -> tuple[Any, ...]:
        # a copy has scratch memory of its own, down to that of its controller
        return type(self), (self.controller, self.unseen, self.dt)

    def __repr__(self) -> str:
        unseen = self.unseen.tolist()
        return f"HeldMeasurement({self.controller!r}, unseen={unseen}, dt={self.dt:g})"


def _differ(here: list[float], before: list[float]) -> bool:
    """Whether two images of a part differ by more than the round-off of a state."""
    size = max(map(abs, here + before), default=0.0)
    return any(abs(a - b) > _ROUND_OFF * size for a, b in zip(here, before, strict=True))
