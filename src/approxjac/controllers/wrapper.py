"""`ControllerWrapper`: a controller around another one."""

import math
import operator
from typing import Self

import numpy as np

from approxjac.controllers.arguments import FLOAT64, overflow
from approxjac.controllers.controller import Controller, Instant
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.errors import InvalidInputError
from approxjac.formatting import shown
from approxjac.interface import Measurement
from approxjac.tasks import Task
from approxjac.validation import Array, Immutable, require


class ControllerWrapper(Immutable, Controller):
    """A controller that steps another one and has some memory of its own.

    Its state is that of the other one, followed by that memory, which is discrete: the state has
    no rate.

    Immutable; one instance per thread, as the controller inside.

    Attributes:
        controller: The controller inside.
    """

    controller: Controller
    _what: str = ""  # it does, in words
    _memory: int = 0  # length of what it keeps itself

    def describe(self) -> list[str]:
        return [*self.controller.describe(), self._what or f"within {type(self).__name__}"]

    def learnt(self, state: Array) -> Array:
        return self.controller.learnt(state[..., : self.controller.size])

    def with_task(self, task: Task) -> Self:
        return self._rebuilt(controller=self.controller.with_task(task))

    def describe_learnt(self, state: Array) -> str:
        return self.controller.describe_learnt(self._split(state)[0])

    def learnt_sd(self, state: Array) -> Array:
        return self.controller.learnt_sd(self._split(state)[0])

    def lyapunov(self, at: Instant) -> float:
        return self.controller.lyapunov(at._replace(state=self._split(at.state)[0]))

    def task_torque(self, at: Instant) -> Array:
        return self.controller.task_torque(at._replace(state=self._split(at.state)[0]))

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        fresh = self.initial_state(measurement)
        inner = self._split(state)[0]
        n = len(inner)
        fresh[:n] = self.controller.resumed(inner, measurement)[:n]
        return fresh

    def kinematics_of(self, state: Array) -> tuple[Kinematics, Array]:
        return self.controller.kinematics_of(self._split(state)[0])

    @staticmethod
    def _require_measured(controller: Controller) -> None:
        wanted = "a controller with a task, such as SetpointController(task)"
        require("controller", controller, Controller, wanted)
        if controller.law.kinematics is not None:
            raise InvalidInputError(
                f"controller must be one that controls the measured x, got {controller!r}, which "
                "predicts x by kinematics of its own",
                given=controller,
            )

    @staticmethod
    def _joined(inner: Array, memory: Array, measurement: Measurement) -> Array:
        """Return a state of these parts, or refuse a memory that a measurement made overflow."""
        if not hasattr(memory, "arm_of") and not math.isfinite(math.hypot(*memory.tolist())):
            raise overflow(measurement)
        return np.concatenate([inner, memory]) if len(inner) else memory

    def _split(self, state: Array) -> tuple[Array, Array]:
        """Return the state of the controller inside, and the memory.

        Raises:
            InvalidInputError: A state that is no such array, or a memory that is not finite.
        """
        n, end = self.controller.size, self.controller.size + self._memory
        if hasattr(state, "arm_of"):  # symbols
            return state[:n], state[n:end]
        state = self._own_part(state)
        is_vector = type(state) is np.ndarray and state.ndim == 1 and state.dtype == FLOAT64
        if not is_vector or len(state) != self.size:
            raise InvalidInputError(
                "state must be an array of float64 as initial_state and step return it, with the "
                f"{n} numbers of the controller inside and {self._memory} of "
                f"{type(self).__name__}, got {shown(state)}",
                given=state,
            )
        inner, memory = state[:n], state[n:end]
        if not math.isfinite(math.hypot(*memory.tolist())):
            raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)
        return inner, memory


_INSIDE = (  # what is the controller's inside
    "command", "task", "dt", "latency", "tuning", "limits", "motion_limits", "parameters",
    "kinematics", "unseen", "gain_values", "law", "needs_solver",
)  # fmt: skip
for _name in _INSIDE:
    _its, _doc = (
        operator.attrgetter(f"controller.{_name}"),
        f"As `{_name}` of the controller inside.",
    )
    setattr(ControllerWrapper, _name, property(_its, doc=_doc))
