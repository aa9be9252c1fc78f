"""`PredictedMeasurement`: a set-point law on the x̂ predicted by learnt kinematics."""

import math
import operator
from collections.abc import Mapping
from typing import Self

import numpy as np

from approxjac import law
from approxjac.controllers import arguments
from approxjac.controllers.controller import Controller
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.wrapper import ControllerWrapper
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.robots import Robot
from approxjac.tasks import Task
from approxjac.tasks.analysis import features
from approxjac.validation import Array, require

_OK, _PREDICTED = Status.OK, Status.PREDICTED  # members of an enum are slow to look up
_LOST = Status.MEASUREMENT_LOST


class PredictedMeasurement(ControllerWrapper):
    """A set-point law that controls a predicted error, while the kinematics learn from x.

    The law gets the predicted error z and its exact Jacobian Ĵ in place of the measured x and the
    believed Jacobian: the Jacobian error p of Theorem 1 is zero, whatever the true arm is. With
    kinematics whose estimates have θ̂' ∈ L², as those of Theorem A, s(z) and q̇ go to zero, and e
    with z ("Learning the kinematics" in the documentation). Noise, delay and frame rate of the
    sensor are outside the loop. Until x is first seen the law acts as if x were lost; then it
    uses the prediction.

    Its state is that of the controller, followed by that of the kinematics.

    Args:
        controller: A `SetpointController`, or a wrapper such as `TorqueLimited` around one. It
            keeps its gains and gravity.
        kinematics: Kinematics of the controller's task, such as `AdaptiveKinematics`.

    Attributes:
        controller: The controller, whose task has Ĵ as a part of its value.

    Raises:
        InvalidInputError: Another controller, or kinematics of another task.
    """

    _what = "controls the x that kinematics predict, which are learnt"

    def __init__(self, controller: Controller, kinematics: Kinematics) -> None:
        require("kinematics", kinematics, Kinematics, "AdaptiveKinematics(task)")
        self._require_measured(controller)
        task = kinematics.task
        frames, own = ([each.frame for each in features(t)] for t in (controller.task, task))
        alike = (controller.task.labels, controller.task.units) == (task.labels, task.units)
        if not alike or frames != own or controller.task.robot != task.robot:
            raise InvalidInputError(
                f"kinematics must be of the controller's task {controller.task!r} and its robot, "
                f"with its URDF and gravity, got {kinematics!r}",
                given=kinematics,
            )
        self.controller = controller.with_task(_WithJacobian(task))
        self._kinematics, self._memory = kinematics, kinematics.n_state

    kinematics: Kinematics = property(operator.attrgetter("_kinematics"))  # type: ignore[assignment]
    task: Task = property(operator.attrgetter("_kinematics.task"))  # type: ignore[assignment]
    # V and the torque of the law are of what is predicted
    lyapunov = Controller.lyapunov
    task_torque = Controller.task_torque

    def learnt(self, state: Array) -> Array:
        """Return the learnt numbers of the law, then of the kinematics, shape (…, p)."""
        n, end = self.controller.size, self.size
        parts = [self.controller.learnt(state[..., :n]), self.kinematics.learnt(state[..., n:end])]
        return np.concatenate(parts, axis=-1)

    @property
    def parameters(self) -> Mapping[str, str]:  # type: ignore[override]
        """Name → unit of the learnt numbers of the law, then of the kinematics."""
        return {**self.controller.parameters, **self.kinematics.parameters}

    def learnt_sd(self, state: Array) -> Array:
        inner, known = self._split(state)
        return np.concatenate([self.controller.learnt_sd(inner), self.kinematics.sd_of(known)])

    def with_task(self, task: Task) -> Self:
        """Return this controller for its own task; raise an InvalidInputError for another."""
        raise InvalidInputError(
            f"task must be {self.task!r}, which the kinematics are of; build a new controller for "
            f"{task!r}",
            given=task,
        )

    def begin(self, measurement: Measurement) -> Array:
        if not hasattr(getattr(measurement, "q", None), "arm_of"):  # or it is of symbols
            arguments.require_arrays(np.zeros(0), measurement, self.task.origin, self.task, 0)
        return self._started(self.kinematics.initial_state(measurement), measurement)

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        fresh = self.initial_state(measurement)
        inner, known = self._split(state)
        fresh[: self.size] = self._started(self.kinematics.resumed(known, measurement), measurement)
        p = self.controller.learnt(inner).shape[-1]
        fresh[:p] = inner[:p]
        return fresh

    def _started(self, known: Array, measurement: Measurement) -> Array:
        seen, _ = self._predicted(known, measurement, Target(self.task.origin))
        return np.concatenate([self.controller.begin(seen), known])

    def advance(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and the output for the predicted error.

        The output's e is that of the measured x, NaN where that is lost. Errors are those of the
        controller.
        """
        target = target if isinstance(target, Target) else Target(target)
        (inner, known), task = self._split(state), self.task
        if not hasattr(state, "arm_of"):
            x_d = task.target(target.x)
            q, v, _ = arguments.require_arrays(state, measurement, x_d, task, len(state))
            if not math.hypot(*q.tolist(), *v.tolist(), *x_d.tolist()) < arguments.HUGE:
                arguments.require_finite(q, v, x_d, state, task)
            target = arguments.with_rates(target._replace(x=x_d), task.measured.m)
            self.kinematics.check(known, measurement, dt)
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # an overflow is a named error
                now = self.kinematics.status(known, measurement)
                e = law.array(task.error(measurement.x, target.x))
                seen, origin = self._predicted(known, measurement, target)
                z = seen.x[: task.m]
                # nothing is predicted before x was seen once
                z = law.select(now == _LOST, np.full(len(z), math.nan), z)
                seen = seen._replace(x=np.concatenate([z, seen.x[len(z) :]]))
                after, answer = self.controller.advance(inner, seen, origin, dt)
                known = known.copy()
                self.kinematics.correct(known, measurement, dt)
        except (ArithmeticError, np.linalg.LinAlgError):
            raise arguments.overflow(measurement) from None
        is_predicted = (now == _PREDICTED) | law.complement(law.is_finite(e))
        usual = (answer.status == _OK) | (answer.status == Status.HOLDING)
        status = law.select(is_predicted & usual, _PREDICTED, answer.status)
        return self._joined(after, known, measurement), answer._replace(e=e, status=status)

    def kinematics_of(self, state: Array) -> tuple[Kinematics, Array]:
        return self.kinematics, self._split(state)[1]

    def _predicted(
        self, known: Array, measurement: Measurement, target: Target
    ) -> tuple[Measurement, Target]:
        """Return z and Ĵ as a measurement, and the target that it is to reach: none is left."""
        t, q, v, *_ = measurement
        ahead = self.kinematics.predict(known, q, v, target)
        x = np.concatenate([law.array(ahead.z), law.array(ahead.J).ravel()])
        moves = target.v is not None
        return Measurement(t, q, v, x, t), Target(0.0 * x, ahead.x_d_dot if moves else None)

    def __repr__(self) -> str:
        return f"PredictedMeasurement({self.controller!r}, {self.kinematics!r})"


class _WithJacobian(Task):
    """A task with X = (its error, Ĵ row by row), so that a law takes the Ĵ that comes with x."""

    uses_x = True

    def __init__(self, task: Task) -> None:
        super().__init__(task.robot, task.labels, task.units, task.m * (1 + task.robot.nv))
        self._plain = task

    def value(self, q: Array) -> Array:
        plain = self._plain
        z = plain.error(plain.value(q), plain.origin)
        return np.concatenate([z, plain.jacobian(q).ravel()])

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        if x is None:
            return self._plain.jacobian(q)
        return x[self.m :].reshape(self.m, -1)

    def error(self, x: Array, x_d: Array) -> Array:
        return np.asarray(x[: self.m] - x_d[: self.m])

    def on(self, robot: Robot) -> Task:
        return _WithJacobian(self._plain.on(robot))

    def __repr__(self) -> str:
        return repr(self._plain)
