"""A visual servoing run that is ready, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from approxjac.controllers import HeldMeasurement, SetpointController, VelocityServo
from approxjac.interface import Status
from approxjac.robots import Robot
from approxjac.robots.joint_limits import beyond_positions
from approxjac.simulation import Plant, Trajectory
from approxjac.studies.servo_settings import ServoSettings
from approxjac.tasks import ImageTask
from approxjac.validation import Array

Mask = np.ndarray[Any, np.dtype[np.bool_]]

_HALF_A_PIXEL = 0.5
_LITTLE = 0.2  # of an error, where forces along it are a fifth of what they are along others
_LATE = 1.5  # times that between images, after which one is missed

_LONG_ENOUGH = 4.0  # settling times before a run is called unstable


@dataclass(frozen=True, eq=False)
class Servo:
    """A visual servoing run that is ready: truth, belief, start and target.

    Attributes:
        robot: Name or file of the arm.
        settings: What was asked for.
        plant: The truth, whose sensor is the true camera.
        controller: The law with its belief.
        held: What runs: the law, with the last image kept between images.
        q0: Start, shape (nq,).
        q_goal: Posture whose image the target is, shape (nq,), unless one was given.
        target: x_d, shape (n_x,).
        believe: Makes the believed robot from the length that is believed of the object [m].
    """

    robot: str
    settings: ServoSettings
    plant: Plant
    controller: SetpointController | VelocityServo
    held: HeldMeasurement
    q0: Array
    q_goal: Array
    target: Array
    believe: Callable[[float], Robot]

    @property
    def sensor(self) -> ImageTask:
        """The true camera and what it sees."""
        assert isinstance(self.plant.sensor, ImageTask)  # as it was prepared
        return self.plant.sensor

    @property
    def tolerance(self) -> float:
        """RMS of an image coordinate's error below which the task counts as done [px]."""
        given, noise = self.settings.tolerance, self.settings.noise
        if given is not None:
            return given
        return noise if noise > 0.0 else _HALF_A_PIXEL


@dataclass(frozen=True, eq=False)
class ServoResult:
    """What became of a visual servoing run.

    Attributes:
        servo: What was run.
        run: The record. Its errors are true ones, without noise, and there where no camera sees.
    """

    servo: Servo
    run: Trajectory

    @property
    def errors(self) -> Array:
        """True distance of each point from its target, shape (N, points) [px]."""
        return np.asarray(np.linalg.norm(self.run.error.reshape(len(self.run.t), -1, 2), axis=2))

    @property
    def final_error(self) -> float:
        """RMS over the last tenth of the run of the worst image coordinate's true error [px]."""
        last = self.run.error[-max(1, len(self.run.t) // 10) :]
        return float(np.sqrt((last**2).mean(axis=0)).max())

    @property
    def converged(self) -> bool:
        """Whether that is within the tolerance, by default the noise of a single image."""
        return self.final_error <= self.servo.tolerance

    @property
    def settling_time(self) -> float:
        """First recorded time from which on all points stay within three tolerances [s]; or NaN."""
        outside = ~(self.errors <= 3.0 * self.servo.tolerance).all(axis=1)
        beyond = np.nonzero(outside)[0]
        if len(beyond) == 0:
            return 0.0
        if beyond[-1] == len(self.run.t) - 1:
            return math.nan
        return float(self.run.t[beyond[-1] + 1])

    @property
    def unseen(self) -> Mask:
        """Whether a point was out of the true camera's view at each instant, shape (N,)."""
        sensor = self.servo.sensor
        return np.array([not np.isfinite(sensor._seen(x)).all() for x in self.run.x])

    @property
    def braked(self) -> Mask:
        """Whether the last image of a point was too old to go by at each instant, shape (N,)."""
        return np.asarray(self.run.status == Status.MEASUREMENT_LOST)

    @property
    def waiting(self) -> Mask:
        """Whether the law went on although a point had no new image in time, shape (N,).

        In time is one and a half times that between images. Without noise the images of an arm at
        rest do not change, and are none that are new.
        """
        run, k = self.run, len(self.servo.sensor.points)
        images = run.x_measured.reshape(len(run.t), k, -1)[:, :, :2]
        new: Mask = np.all(np.isfinite(images), axis=2)
        new[1:] &= np.any(images[1:] != images[:-1], axis=2)
        last = np.maximum.accumulate(np.where(new, run.t[:, None], -math.inf), axis=0)
        last = np.maximum(last, self.servo.settings.latency)  # before it none can arrive
        late = (run.t[:, None] - last).max(axis=1) > _LATE / self.servo.settings.frame_rate
        waiting: Mask = late & ~self.braked
        return waiting

    @property
    def stays_in_view(self) -> bool:
        """Whether all points were in view at every recorded instant."""
        return not self.unseen.any()

    @property
    def peak_torque_ratio(self) -> float:
        """Largest torque asked for, as a share of what its motor delivers; NaN if not known."""
        limits = self.motor_limits
        if not np.isfinite(limits).any():
            return math.nan
        return float((np.abs(self.run.tau) / limits).max())

    @property
    def motor_limits(self) -> Array:
        """What the true motors deliver, shape (n_v,) [N m or N]."""
        limits = self.servo.plant.torque_limits
        return self.servo.plant.robot.effort_limits if limits is None else limits

    @property
    def joint_limit_excess(self) -> float:
        """How far a joint was beyond its position limits at most [rad or m]; 0 if none was."""
        return max(0.0, float(beyond_positions(self.servo.plant.robot, self.run.q).max()))

    @property
    def torque_roughness(self) -> float:
        """RMS of the change of torques from record to record over the last tenth [N m or N]."""
        last = self.run.tau[-max(2, len(self.run.t) // 10) :]
        return float(np.sqrt((np.diff(last, axis=0) ** 2).sum(axis=1).mean()))

    @property
    def reason(self) -> str:
        """What kept the task from being done, in words; nothing if it was done."""
        if self.converged:
            return ""
        run = self.run
        quarter = slice(-max(1, len(run.t) // 4), None)
        beyond = np.abs(run.tau[quarter]) > self.motor_limits * (1.0 + 1e-9)  # solvers round
        if beyond.any(axis=1).mean() > 0.1:
            return "the law asks for more torque than the motors deliver"
        if self.unseen[quarter].mean() > 0.5:
            return "a point left the camera's view: without it there are only brakes"
        if float((run.status[quarter] == Status.MEASUREMENT_LOST).mean()) > 0.5:
            return "no new image comes: without it there are only brakes"
        norms = np.nan_to_num(np.linalg.norm(run.error, axis=1), nan=math.inf)  # behind the camera
        singular = float((run.status[quarter] == Status.NEAR_SINGULAR).mean())
        before = norms[: -len(norms[quarter])][-len(norms[quarter]) :]
        stands = len(before) > 0 and norms[quarter].min() > 0.9 * before.min()
        if stands and singular > 0.5:
            return "stands where the believed Jacobian is singular along the error"
        if not stands:
            return "still approaching its target at the end"
        settings = self.servo.settings
        enough = _LONG_ENOUGH * settings.settling_time
        if settings.duration < enough:
            return (
                f"too short to tell: {settings.duration:g} s, of {settings.settling_time:g} s to "
                f"settle, where {enough:g} s do"
            )
        if float(np.abs(run.v[quarter]).max()) < 0.1:
            if self._share_of_error() < _LITTLE:
                return "hardly moves: the believed Jacobian shows little of the error's direction"
            return f"came to rest away from its target: out of reach{self._weight}"
        return f"moves on without approaching: not stable with these errors{self._weight}"

    @property
    def _weight(self) -> str:
        """What may be to blame besides, in words."""
        exact = self.servo.settings.gravity in ("learnt", "exact")
        return "" if exact else ", or gravity, which is not compensated as it is"

    def _share_of_error(self) -> float:
        """‖Ĵᵀe‖ / (‖Ĵ‖ ‖e‖) at the end: how much of the error the believed Jacobian shows."""
        run, task = self.run, self.servo.controller.task
        e, J_hat = task.error(run.x[-1], run.target), task.jacobian(run.q[-1], run.x[-1])
        return float(np.linalg.norm(J_hat.T @ e) / (np.linalg.norm(J_hat, 2) * np.linalg.norm(e)))

    def summary(self) -> dict[str, Any]:
        """What goes into summary.json."""
        run, servo = self.run, self.servo
        counts = {status.name: count for status, count in run.status_counts().items()}
        return {
            "robot": run.robot_name,
            "final_error_px": _number(self.final_error),
            "tolerance_px": servo.tolerance,
            "settling_time_s": _number(self.settling_time),
            "peak_torque_ratio": _number(self.peak_torque_ratio),
            "joint_limit_excess": self.joint_limit_excess,
            "verdict": "converged" if self.converged else "not converged",
            "reason": self.reason,
            "stays_in_view": self.stays_in_view,
            "start_error_px": _number(float(self.errors[0].max())),
            "start": run.x[0].tolist(),
            "target": run.target.tolist(),
            "end": [_number(value) for value in run.x[-1].tolist()],
            "q_start": servo.q0.tolist(),
            "q_end": run.q[-1].tolist(),
            "controller": repr(servo.controller),
            "status_counts": counts,
            "waiting_share": float(self.waiting.mean()),
            "braked_share": float(self.braked.mean()),
            "settings": {f.name: getattr(servo.settings, f.name) for f in fields(ServoSettings)},
        }


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if math.isfinite(value) else None
