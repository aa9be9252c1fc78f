"""What became of a scenario with a pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from approxjac.interface import Status
from approxjac.scenario.result import Mask, Result, number
from approxjac.tasks import ImageTask
from approxjac.validation import Array

_HALF_A_PIXEL = 0.5
_LITTLE = 0.2  # of an error, where forces along it are a fifth of what they are along others
_LATE = 1.5  # times that between images, after which one is missed
_LONG_ENOUGH = 4.0  # settling times before a run is called unstable


@dataclass(frozen=True, eq=False)
class ImageResult(Result):
    """What became of a visual servoing run, in pixels.

    The errors of its record are true ones, without noise, and there where no camera sees.
    """

    @property
    def sensor(self) -> ImageTask:
        """The true camera and what it sees."""
        assert isinstance(self.built.plant.sensor, ImageTask)  # as it was built
        return self.built.plant.sensor

    @property
    def tolerance(self) -> float:
        """RMS of an image coordinate's error below which the task counts as done [px]."""
        given, noise = self.built.scenario.run.tolerance, self.built.scenario.sensor.noise
        return (noise or _HALF_A_PIXEL) if given is None else given

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
        return self.final_error <= self.tolerance

    @property
    def settling_time(self) -> float:
        """First recorded time from which on all points stay within three tolerances [s]; or NaN."""
        return self._settled(np.all(self.errors <= 3.0 * self.tolerance, axis=1))

    @cached_property
    def unseen(self) -> Mask:
        """Whether a point was out of the true camera's view at each instant, shape (N,)."""
        return np.array([not np.isfinite(self.sensor._seen(x)).all() for x in self.run.x])

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
        run, sensor = self.run, self.built.scenario.sensor
        images = run.x_measured.reshape(len(run.t), len(self.sensor.points), -1)[:, :, :2]
        new: Mask = np.all(np.isfinite(images), axis=2)
        new[1:] &= np.any(images[1:] != images[:-1], axis=2)
        last = np.maximum.accumulate(np.where(new, run.t[:, None], -math.inf), axis=0)
        last = np.maximum(last, sensor.delay)  # before it none can arrive
        between = math.inf if sensor.rate is None else _LATE / sensor.rate
        waiting: Mask = ((run.t[:, None] - last).max(axis=1) > between) & ~self.braked
        return waiting

    @property
    def stays_in_view(self) -> bool:
        """Whether all points were in view at every recorded instant."""
        return not self.unseen.any()

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
        run, end = self.run, self._end
        if self._asks_too_much(0.1):
            return "the law asks for more torque than the motors deliver"
        if self.unseen[end].mean() > 0.5:
            return "a point left the camera's view: without it there are only brakes"
        if self.braked[end].mean() > 0.5:
            return "no new image comes: without it there are only brakes"
        norms = np.nan_to_num(np.linalg.norm(run.error, axis=1), nan=math.inf)  # behind the camera
        before = norms[: -len(norms[end])][-len(norms[end]) :]
        stands = len(before) > 0 and norms[end].min() > 0.9 * before.min()
        if stands and self._near_singular:
            return "stands where the believed Jacobian is singular along the error"
        if not stands:
            return "still approaching its target at the end"
        duration = self.built.scenario.run.duration
        settling_time = self.built.scenario.controller.settling_time
        enough = _LONG_ENOUGH * settling_time
        if duration < enough:
            return (
                f"too short to tell: {duration:g} s, of {settling_time:g} s to settle, where "
                f"{enough:g} s do"
            )
        exact = self.built.scenario.controller.gravity in ("learnt", "exact")
        weight = "" if exact else ", or gravity, which is not compensated as it is"
        if float(np.abs(run.v[end]).max()) < 0.1:
            if self._share_of_error() < _LITTLE:
                return "hardly moves: the believed Jacobian shows little of the error's direction"
            return f"came to rest away from its target: out of reach{weight}"
        return f"moves on without approaching: not stable with these errors{weight}"

    def _share_of_error(self) -> float:
        """‖Ĵᵀe‖ / (‖Ĵ‖ ‖e‖) at the end: how much of the error the believed Jacobian shows."""
        run, task = self.run, self.built.law.task
        e, J_hat = task.error(run.x[-1], run.target), task.jacobian(run.q[-1], run.x[-1])
        return float(np.linalg.norm(J_hat.T @ e) / (np.linalg.norm(J_hat, 2) * np.linalg.norm(e)))

    def _errors_summary(self) -> dict[str, Any]:
        return {
            "final_error_px": number(self.final_error),
            "tolerance_px": self.tolerance,
            "start_error_px": number(float(self.errors[0].max())),
            "stays_in_view": self.stays_in_view,
            "waiting_share": float(self.waiting.mean()),
            "braked_share": float(self.braked.mean()),
        }
