"""`HeldMeasurement`: hold the last measured x until the arm has moved too far."""

from collections.abc import Sequence

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import require_array, time_of_x
from approxjac.controllers.controller import Controller
from approxjac.controllers.wrapper import ControllerWrapper
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.tasks.analysis import uncombined
from approxjac.validation import Array, as_limits, require

_OK, _HELD = Status.OK, Status.MEASUREMENT_HELD  # members of an enum are slow to look up


class HeldMeasurement(ControllerWrapper):
    """A controller that uses the last measured x until the arm has moved too far.

    An old x is wrong because of the motion since, not its age. For each part of the task (each
    feature of an image) this integrates the motion since its last new value by the believed
    Jacobian, p = ∫ Ĵ q̇ dt. While every abs(pᵢ) <= unseenᵢ the controller gets the last x. A part
    beyond that, or never seen, is NaN until it is seen again, and the controller acts as for a lost
    measurement. So the arm stops once it has moved too far, whether x is lost or a frozen camera
    repeats it.

    A part is new if it is finite and x was taken later than the last one (`Measurement.t_x`); if
    that time is unknown, if it differs from the last one: with noise every new image does.

    The status is that of the controller, or `MEASUREMENT_HELD` if that is `OK` and no part of x is
    new. A limiter inside it evaluates V with the held x.

    Its state is that of the controller, then the last x (n_x,), the time it was taken, p (m,), and
    for each part 1 if it was ever seen, else 0. Law (5) differentiates the held x, a staircase:
    with a time constant below the time between images its torque jumps at each of them.

    Args:
        controller: A controller that returns Ĵ: a `SetpointController`, or a wrapper such as
            `TorqueLimited` around one.
        unseen: Largest motion of the image without a new measurement, a number or shape (m,) > 0,
            infinite for no limit [unit of the task]. It must exceed the motion between images (the
            fastest speed times the image period, times a few if some are lost), or the arm
            stutters.

    Attributes:
        unseen: Shape (m,) [unit of the task].

    Raises:
        InvalidInputError: No such controller, or numbers that are not > 0.
    """

    unseen: Array = np.zeros(0)  # its own, not that of the controller inside
    _what = "goes on with the last x that was seen while the arm moves it by less than the bound"

    def __init__(self, controller: Controller, unseen: float | Sequence[float] | Array) -> None:
        self._require_measured(controller)
        task = controller.task
        self.controller = controller
        self._measured = task.measured  # whose parts are lost one by one
        m = self._measured.m
        self.unseen = as_limits("unseen", unseen, m, unit=joined(self._measured.units))
        self._parts, self._most = task.parts, self.unseen.tolist()
        self._origin = task.origin
        self._uncombined = uncombined(task)
        self._memory = task.n_x + 1 + m + len(self._parts)

    def begin(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,), without any x.

        Raises the controller's errors, such as that of law (5) if the first x is lost.
        """
        memory = np.append(self._origin, np.zeros(self._memory - len(self._origin)))
        return np.concatenate([self.controller.begin(measurement), memory])

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is a named error
    def advance(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and the controller's output for this x or the last one.

        Raises:
            MeasurementError: As the controller, or an x too large for the state.
            InvalidInputError: As the controller; t_x is not finite, or the output has no Ĵ.
        """
        inner, memory = self._split(state)
        require("measurement", measurement, Measurement, "Measurement(t, q, v, x)")
        t, q, v, x, t_x = measurement
        if not hasattr(state, "arm_of"):
            require_array("x", x, len(self._origin), self.controller.task)
            t_x = time_of_x(t_x)
        # numbers may be no measurement all the same, such as a quaternion of zeros
        errors = x if self._measured.subtracts else self._measured.error(x, self._origin)
        taken, knows_time = (0.0, False) if t_x is None else (t_x, True)
        if hasattr(t_x, "graph"):  # a symbol, NaN where it is not known
            knows_time = t_x == t_x
        held = law.hold_step(memory, x, errors, taken, knows_time, self._parts, self._most)
        used = Measurement(t, q, v, held.x, measurement.t_x)
        after, answer = self.controller.advance(inner, used, target, dt)
        if answer.J_hat is None:
            raise InvalidInputError(
                f"controller must return an Evaluation with J_hat, to predict how x moves, "
                f"got {self.controller!r}, which has none",
                given=self.controller,
            )
        rate = answer.J_hat.dot(v)
        motion = dt * (rate if self._uncombined is None else self._uncombined.dot(rate))
        memory = law.hold_moved(held, motion)
        usual = (answer.status == _OK) | (answer.status == Status.HOLDING)
        is_held = law.complement(held.is_new) & usual
        status = law.select(is_held, _HELD, answer.status)
        return self._joined(after, memory, measurement), answer._replace(status=status)

    def __repr__(self) -> str:
        return f"HeldMeasurement({self.controller!r}, unseen={self.unseen.tolist()})"
