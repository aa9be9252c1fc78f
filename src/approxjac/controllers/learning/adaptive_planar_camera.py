"""`AdaptivePlanarCamera`: the paper's camera, learnt as a tracker that is turned in its plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.controllers.arguments import chosen_kinds
from approxjac.controllers.learning.adaptive_kinematics import AdaptiveKinematics
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.controllers.learning.kinematic_unknowns import KINDS
from approxjac.controllers.learning.predicted_error import Kinematics, PredictedError
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Status, Target
from approxjac.robots import Robot
from approxjac.tasks import ImageTask, PositionTask
from approxjac.validation import Array, as_number, require


class AdaptivePlanarCamera(Kinematics):
    """x̂ = m R̂ p(q; θ̂) + d̂, learnt from the image in a `PlanarCamera` while the arm moves.

    It is `AdaptiveKinematics` of the position in the arm's plane, with x as the believed camera
    would locate it. A wrong magnification m is learnt as lengths that are wrong by its factor:
    images tell the two from each other by nothing.

    Args:
        task: An `ImageTask` of the believed robot with a `PlanarCamera`, for one frame's origin.
        unknown: As of `AdaptiveKinematics`; "camera" is roll and offset.
        sd: As of `AdaptiveKinematics`, in the arm's plane. By default "tool" and "origins" are as
            wrong as magnification and lengths may be: 0.5 m.
        noise: Standard deviation of x [m on the sensor].
        delay: Age of x where `Measurement.t_x` is None [s].
        dt: Sampling time of control [s].

    Attributes:
        kinematics: `AdaptiveKinematics` of the position [m in the arm's plane].
        names: Names of what is learnt, such as "joint2.x", "offset.x" and "camera.turn", from the
            believed camera to the learnt one.

    Raises:
        InvalidInputError: Another task, or as `AdaptiveKinematics`.
        UnknownNameError: As `AdaptiveKinematics`.
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
        self._remember(locals())
        require("task", task, ImageTask, "an ImageTask of the believed robot")
        camera = task.camera
        if not isinstance(camera, PlanarCamera) or task.frame is None or task.points.any():
            raise InvalidInputError(
                f"task must be an ImageTask of a frame's origin in a PlanarCamera, got {task!r}; "
                "AdaptiveCamera is for a PinholeCamera",
                given=task,
            )
        self.task = task
        noise = as_number("noise", noise, unit="m", above=0.0)
        self._m = m = camera.magnification
        c, s = np.cos(camera.roll), np.sin(camera.roll)
        self._R, self._d = np.array([[c, s], [-s, c]]), np.asarray(camera.offset)
        kinds = chosen_kinds(unknown, KINDS)
        usual = {kind: 0.5 for kind in kinds if kind in ("tool", "origins")}
        position = PositionTask(task.robot, task.frame, axes=camera.plane)
        self.kinematics = AdaptiveKinematics(
            position, unknown, usual if sd is None else sd, noise / m, delay, dt
        )
        self._kept = self.kinematics._kept
        self.names, self.units = self.kinematics.names, self.kinematics.units
        self.n_state = self.kinematics.n_state

    def __repr__(self) -> str:
        return f"AdaptivePlanarCamera({self.task!r}, unknown={self.kinematics.unknown})"

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,): what is believed."""
        return self.kinematics.initial_state(self._located(measurement))

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later."""
        return self.kinematics.step(state, self._located(measurement), dt)

    def status(self, state: Array, measurement: Measurement) -> Status:
        """Return what may be done by a state; see `Kinematics`."""
        return self.kinematics.status(state, measurement)

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,), turned into the base's axes.

        In the size that it has on the sensor of the believed camera [m].
        """
        x_d, v_d, a_d = target
        v_d = None if v_d is None else v_d.dot(self._R) / self._m
        a_d = None if a_d is None else a_d.dot(self._R) / self._m
        located = Target((x_d - self._d).dot(self._R) / self._m, v_d, a_d)
        found = self.kinematics.predict(state, q, v, located)
        return PredictedError(*(self._m * each for each in found))

    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt, shape (…, p)."""
        return self.kinematics.learnt(state)

    def report(self, state: Array) -> KinematicReport:
        """Return what a state has learnt, in the arm's plane."""
        return self.kinematics.report(state)

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with lengths as the believed camera sees them."""
        return self.kinematics.robot(state)

    def _is_state(self, state: Array) -> bool:
        return self.kinematics._is_state(state)

    def _located(self, measurement: Measurement) -> Measurement:
        """Return a measurement with x in the arm's plane, as the believed camera has it."""
        x = (measurement.x - self._d).dot(self._R) / self._m
        return measurement._replace(x=x)
