"""`Loop`: a controller in a closed loop, sample by sample, whatever moves in it."""

from __future__ import annotations

import math
from typing import ClassVar

from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, Measurement, Target, TargetPath
from approxjac.simulation.plant import Plant
from approxjac.simulation.targets import (
    Wanted,
    first_state,
    require_fit,
    target_at,
    wanted_of,
    x_of,
)
from approxjac.validation import Array, as_array


class Loop:
    """Base of the loops of a plant and of a robot.

    An observer may look at all of it, and may move the target, exchange the controller or stop it.

    Attributes:
        plant: The true robot, or of a real one what is believed of it.
        controller: The controller.
        path: What the target is now and later: an array at rest, a `Target` or a path.
        target: x_d, shape (n_x,).
        dt: Sampling time [s].
        step: Number of the step.
        steps: Number of the last one.
        truth: Measurement of ideal sensors; its x is NaN where the sensor does not see. Of a robot
            it is what was measured last.
        measurement: Measurement that the controller gets.
        state: State of the controller before this step, shape (n_state,).
        answer: Answer of the controller.
        tau: Torque at this instant, the controller's or that of the plant's servo, shape (n_v,).
        stopped: Whether an observer stopped it.
    """

    truth: Measurement
    measurement: Measurement
    state: Array
    answer: Evaluation
    tau: Array
    target: Array
    _wanted: Target | Array
    _knows_truth: ClassVar[bool] = True  # of a robot nobody does

    def __init__(
        self, plant: Plant, controller: Controller, path: Wanted, dt: float, steps: int
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.path = path
        self.dt = dt
        self.step = 0
        self.steps = steps
        self.stopped = False

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.truth.t

    @property
    def ended(self) -> bool:
        """Return True after the last step."""
        return self.stopped or self.step == self.steps

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Move the target, from the next step on.

        Raises:
            InvalidInputError: Wrong shape, not finite, or not a value that the sensor has.
        """
        path = wanted_of(self.plant.sensor, target, self.t)
        wanted = target_at(path, self.t)
        try:
            self.controller.step(self.state, self.measurement, wanted, self.dt)
        except MeasurementError as error:
            raise InvalidInputError(
                f"target must be one that the controller can be evaluated with, without an "
                f"overflow, got {x_of(wanted).tolist()}",
                given=target,
            ) from error
        self.path = path
        self.target = x_of(wanted)

    def exchange(self, controller: Controller) -> None:
        """Let another controller go on, from the next step on.

        It goes on with the state that there is, such as gravity that was learnt.

        Raises:
            InvalidInputError: A controller of another task, with a state of another length, or
                for another sampling time.
        """
        require_fit(self.plant, controller, self.dt)
        state = first_state(self.plant, controller, self._wanted, self.measurement, self.dt)
        if state.shape != self.state.shape:
            raise InvalidInputError(
                f"controller must have a state of length {len(self.state)} to go on with, got "
                f"{controller!r} with {len(state)}",
                given=controller,
            )
        self.controller = controller

    def stop(self) -> None:
        """End the run at this step."""
        self.stopped = True

    def _aim(self) -> None:
        self._wanted = target_at(self.path, self.step * self.dt)
        self.target = x_of(self._wanted)

    def _control(self) -> None:
        self._after, answer = self.controller.step(
            self.state, self.measurement, self._wanted, self.dt
        )
        if not math.isfinite(math.hypot(*self._after.tolist())):
            as_array("state", self._after, self._after.shape)
        # a controller may use one buffer for all its torques, and `aim_at` asks it once more
        self.answer = answer._replace(torque=answer.torque.copy())
        self.tau = self.answer.torque
