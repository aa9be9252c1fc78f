"""`ControllerWrapper`: a controller around another one; `law_of` finds the law inside."""

from __future__ import annotations

import math
from typing import Any, Literal, Self

import numpy as np

from approxjac.controllers.arguments import FLOAT64
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.controllers.proven_law import ProvenLaw
from approxjac.errors import InvalidInputError
from approxjac.formatting import wrapped
from approxjac.interface import Controller, Measurement
from approxjac.robots import Robot
from approxjac.tasks import Task
from approxjac.validation import Array, Immutable, as_vector


class ControllerWrapper(Immutable, Controller):
    """A controller that steps another one and keeps some memory of its own.

    Its state is that of the other one, followed by that memory, which is discrete by nature: such
    a controller has no rate of its state.

    Immutable; one instance a thread, as the controller inside.

    Attributes:
        controller: The controller inside.
    """

    controller: Controller
    _what: str = ""  # it does, in words
    _memory: int  # length of what it keeps itself

    def __str__(self) -> str:
        what = self._what or f"within {type(self).__name__}"
        return "\n".join([str(self.controller), *wrapped(what, "  ")])

    @property
    def command(self) -> Literal["torque", "velocity"]:  # type: ignore[override]  # read-only
        """Return what the controller inside commands."""
        return self.controller.command

    @property
    def task(self) -> Task:
        """The task of the believed robot."""
        return self.controller.task

    @property
    def dt(self) -> float | None:
        """Sampling time that control has to have [s], or None where any will do."""
        return self.controller.dt

    def learnt(self, state: Array) -> Array:
        """Return what the controller inside has learnt, shape (…, p)."""
        return self.controller.learnt(state)

    def with_task(self, task: Task) -> Self:
        """Return this around the controller with another task, such as of another believed robot.

        Args:
            task: A task with the same coordinates, of a robot with the same joints.
        """
        return self._rebuilt(controller=with_task(self.controller, task))

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return a state before a first step that knows what another state has learnt.

        Such as the last one of a run before, for `simulate(state=...)`; of the same controller.

        Raises:
            InvalidInputError: A state of another controller, a measurement of the wrong shapes, or
                a controller that learns no kinematics.
        """
        resume = self._inside("resumed")
        inner, _ = self._split(as_vector("state", state, len(self.initial_state(measurement))))
        return self._begun(resume(inner, measurement), measurement)

    def kinematics_learnt(self, state: Array) -> KinematicReport:
        """Return what a state has learnt of the kinematics.

        Raises:
            InvalidInputError: A controller that learns no kinematics, or a state of another one.
        """
        report: KinematicReport = self._inside("kinematics_learnt")(self._split(state)[0])
        return report

    def learnt_robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and joint origins.

        Masses, friction and the tracker are not in it; a state that is saved has them all.

        Raises:
            InvalidInputError: A controller that learns no kinematics, or a state of another one.
        """
        robot: Robot = self._inside("learnt_robot")(self._split(state)[0])
        return robot

    def _inside(self, name: str) -> Any:
        """Return a method of the controller inside, or refuse one that learns no kinematics."""
        method = getattr(self.controller, name, None)
        if method is None:
            raise InvalidInputError(
                "controller must learn kinematics, such as a TrackingController or a "
                f"PredictedMeasurement, got {self.controller!r}",
                given=self.controller,
            )
        return method

    def _begun(self, state: Array, measurement: Measurement) -> Array:
        """Return a first state of the controller inside with the memory before the first step."""
        fresh = self.initial_state(measurement)
        return np.concatenate([state, fresh[len(state) :]])

    def _split(self, state: Array) -> tuple[Array, Array]:
        """Return the state of the controller inside, and the memory.

        Raises:
            InvalidInputError: A state that is no such array, or a memory that is not finite.
        """
        least = self._memory
        if type(state) is not np.ndarray or state.ndim != 1 or state.dtype != FLOAT64:
            raise InvalidInputError(
                f"state must be an array of float64 as initial_state and step return it, got "
                f"{f'{state.dtype} {state.shape}' if type(state) is np.ndarray else repr(state)}",
                given=state,
            )
        if len(state) < least:
            raise InvalidInputError(
                f"state must have the {least} numbers of {type(self).__name__} after those of the "
                f"controller inside, got {len(state)}",
                given=state,
            )
        inner, memory = state[: len(state) - least], state[len(state) - least :]
        if not math.isfinite(math.hypot(*memory.tolist())):
            raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)
        return inner, memory


def law_of(controller: Controller) -> Controller:
    """Return the controller inside of all wrappers, such as the `SetpointController`.

    Its state is the first part of theirs.
    """
    while isinstance(controller, ControllerWrapper):
        controller = controller.controller
    return controller


def with_task(controller: Controller, task: Task) -> Controller:
    """Return a controller of this library with another task.

    Raises:
        InvalidInputError: A controller of your own.
    """
    if not isinstance(controller, ProvenLaw | ControllerWrapper):
        raise InvalidInputError(
            f"controller must be able to take another task for its belief to be changed, got "
            f"{controller!r}",
            given=controller,
        )
    return controller.with_task(task)
