"""`RobotRun`: the record of a run on a robot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from approxjac.realtime.faults import Fault
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array

_SOME = 200  # instants of a run, among which the farthest target is looked for


@dataclass(frozen=True, eq=False, repr=False)
class RobotRun(Trajectory):
    """The record of a run on a robot, which plots and pages take like any other `Trajectory`.

    What nobody can know stands for what is: x is what was measured last, the scene has the believed
    robot twice, and V is that of the believed arm. The error is that of x to the target when x was
    taken, as `Measurement.t_x` tells; without it to the target of the same instant.

    Attributes:
        stop_distance: How far x went from the call for a controlled stop until the brake, NaN
            without one [length in the units of the task].
        stop_bound: How far it may go: the error then, the way of the target that comes to rest,
            and what is faster than that target for the 0.3 s that this takes.
        gap: Time from command to command in each period of the run, shape (K,) [s].
        work: Time from the measurement to the command in each, shape (K,) [s].
    """

    stop_distance: float = field(kw_only=True)
    stop_bound: float = field(kw_only=True)
    gap: Array = field(kw_only=True)
    work: Array = field(kw_only=True)
    _more_arrays: ClassVar[tuple[str, ...]] = ("gap", "work")
    _more_texts: ClassVar[tuple[str, ...]] = ("stop_distance", "stop_bound")

    @property
    def fault(self) -> Fault | None:
        """Return the fault that ended it, or None."""
        return Fault[self.fault_name] if self.fault_name else None

    def late(self, longest: float) -> int:
        """Return the number of commands that came later than a time after the one before [s]."""
        return int((self.gap > longest).sum())

    def _error_line(self) -> str:
        """Return in words how far the target went, which is eased in, and the error at the end."""
        error = f"error {self.error_norm[-1]:.3g} {self.task_unit} at the end"
        sensor = None if self.scene is None else self.scene.sensor
        if sensor is None:
            return error
        some = self.x_d[np.unique(np.linspace(0, len(self.t) - 1, _SOME).astype(int))]
        way = max(float(np.linalg.norm(sensor.error(x_d, self.x_d[0]))) for x_d in some)
        return f"target led {way:.3g} {self.task_unit} away from the start, {error}"

    def _figures(self) -> dict[str, str]:
        """Describe the run, with its stop and the times that commands took."""
        figures = super()._figures()
        if np.isfinite(self.stop_distance):
            figures["stop"] = (
                f"within {self.stop_distance:.3g} {self.task_unit} "
                f"(at most {self.stop_bound:.3g} was foreseen)"
            )
        if len(self.work):
            half, most, worst = 1e6 * np.percentile(self.work, [50.0, 99.0, 100.0])
            figures["work"] = (
                f"{half:.0f} µs in the median, 99 % within {most:.0f}, worst {worst:.0f}; "
                f"longest gap {1e3 * self.gap.max():.3g} ms"
            )
        return figures
