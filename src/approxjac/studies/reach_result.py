"""A reach that is ready to run, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from approxjac.controllers import Limits, SetpointController
from approxjac.interface import Controller, LimitStatus, Status
from approxjac.robots import Robot
from approxjac.robots.joint_limits import beyond_positions, reach_bound
from approxjac.simulation import Plant, Trajectory
from approxjac.studies.reach_settings import Settings
from approxjac.studies.watch import Tally
from approxjac.tasks import PoseTask, PositionTask
from approxjac.validation import Array

AT_LIMIT = 0.01  # a joint this near to its position limit counts as at it [rad or m]
_AT_REST = 0.1  # what moves no faster may be called at rest [rad/s or m/s]


@dataclass(frozen=True, eq=False)
class Reach:
    """A reach ready to run: the truth, the controller with its belief, start and target.

    Attributes:
        settings: What was asked for.
        plant: The truth; its torque limits are those of the motors.
        controller: The law with its belief.
        q0: Start, shape (nq,).
        target: x_d, shape (n_x,).
        limiter: What acts in the controller's place, most often a limiter of its torque; None
            where the controller knows no limits.
        limits: What the limiter has to keep, with an entry for each joint.
        believe: Makes the believed robot from the length that is believed of the object [m]; None
            where that does not change.
    """

    settings: Settings
    plant: Plant
    controller: SetpointController
    q0: Array
    target: Array
    limiter: Controller | None = None
    limits: Limits | None = None
    believe: Callable[[float], Robot] | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """What became of a reach.

    Attributes:
        reach: What was run.
        run: The record.
        settling_time: First recorded time from which on the error is within the tolerance at
            every recorded instant [s]; NaN if it is not at the end.
        peak_torque_ratio: Largest torque asked for at these instants, as a share of what the
            joint's motor delivers; NaN where no limit is known.
        tally: What limits did in all steps; None where the controller knows none.
    """

    reach: Reach
    run: Trajectory
    settling_time: float
    peak_torque_ratio: float
    tally: Tally | None = None

    @property
    def converged(self) -> bool:
        """Whether the error ended, and stayed for the last tenth, within the tolerance."""
        return self.settling_time <= 0.9 * float(self.run.t[-1])

    def errors_at(self, k: int) -> dict[str, float]:
        """Norm of the error of each unit at a recorded instant."""
        units = np.array(self.run.task_units)
        return {
            unit: float(np.linalg.norm(self.run.error[k][units == unit]))
            for unit in dict.fromkeys(self.run.task_units)
        }

    @property
    def reason(self) -> str:
        """What kept the task from being done, in words; nothing if it was done."""
        if self.converged:
            return ""
        run, settings = self.run, self.reach.settings
        norm, quarter = run.error_norm, max(1, len(run.t) // 4)
        last, before = slice(-quarter, None), norm[: len(norm) - quarter][-quarter:]
        if float((run.status[last] == Status.MEASUREMENT_LOST).mean()) > 0.5:
            return "the measurement of x is lost"
        if not math.isnan(self.settling_time):
            return f"within the tolerance since {self.settling_time:.3g} s only, too late to judge"
        away, most = self._distance()
        if away > most:
            return (
                f"out of reach: {away:.3g} m from the first joint, where {most:.3g} m is the most"
            )
        beyond = np.abs(run.tau[last]) > self.motor_limits * (1.0 + 1e-9)  # solvers round
        if beyond.any(axis=1).mean() > 0.5:
            return "the law asks for more torque than the motors deliver"
        moved = float(np.linalg.norm(run.x[last] - run.x[-1], axis=1).max())
        rests = moved < 0.1 * norm[-1] and float(np.abs(run.v[-1]).max()) < _AT_REST
        free = (LimitStatus.UNLIMITED, LimitStatus.FREE)
        if float(np.isin(run.limit_status[last], free).mean()) < 0.5:
            return self._what_limits_did(last, rests)
        singular = float((run.status[last] == Status.NEAR_SINGULAR).mean())
        stands = norm[last].max() > 0.9 * before.max() if len(before) else False
        if singular > 0.5 and stands:
            return "stands where the believed Jacobian is singular along the error"
        if rests:
            learnt = settings.gravity == "learnt"
            weight = "" if learnt else ", or gravity is not compensated as it is"
            return f"came to rest away from its target: out of reach, blocked, friction{weight}"
        if not stands:
            return "still approaching its target at the end"
        return "moves on without approaching: too short a run, or not stable with these errors"

    def _distance(self) -> tuple[float, float]:
        """How far the target is from the first joint at least, and the tip at most [m]."""
        sensor = self.reach.plant.sensor
        if not isinstance(sensor, PositionTask | PoseTask):
            return 0.0, math.inf
        first, most = reach_bound(sensor.robot, sensor.frame)
        axes = ["xyz".index(axis) for axis in sensor.labels[:3]]
        return float(np.linalg.norm(self.run.target[: len(axes)] - first[axes])), most

    def _what_limits_did(self, last: slice, rests: bool) -> str:
        """The reason where limits were at work for most of the end."""
        run, names = self.run, np.array(self.run.joint_names)
        statuses, counts = np.unique(run.limit_status[last], return_counts=True)
        most = LimitStatus(int(statuses[counts.argmax()]))
        beyond = self._beyond_positions()[-1]
        outside, there = beyond > AT_LIMIT, beyond > -AT_LIMIT
        if most is LimitStatus.INFEASIBLE and outside.any():
            what = "stands still" if rests else "moves on"
            joints = _listed(names[outside])
            return f"no torque keeps all limits at once: {what} with {joints} beyond its limits"
        if most in (LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED):
            return most.message
        if not rests:
            return "moves on at its limits without settling"
        if there.any():
            return f"a dead end: came to rest at the position limits of {_listed(names[there])}"
        weak = np.abs(run.tau[-1]) > 0.999 * self.motor_limits
        if weak.any():
            return f"came to rest at the torque limits: those of {_listed(names[weak])}"
        return "came to rest away from its target, held back by its limits"

    @property
    def motor_limits(self) -> Array:
        """What the true motors deliver, shape (n_v,) [N m or N]."""
        limits = self.reach.plant.torque_limits
        return self.reach.plant.robot.effort_limits if limits is None else limits

    @property
    def joint_limit_excess(self) -> float:
        """How far a joint was beyond its position limits at most [rad or m]; 0 if none was."""
        # continuous joints have no limits, the others one coordinate each
        return max(0.0, float(self._beyond_positions().max()))

    def _beyond_positions(self) -> Array:
        """How far each joint is beyond its position limits, shape (N, n_v); negative within."""
        return beyond_positions(self.reach.plant.robot, self.run.q)

    @property
    def speed_limits(self) -> Array:
        """What |q̇| should not exceed, shape (n_v,) [rad/s or m/s]; infinite where not known."""
        limits = self.reach.limits
        if limits is None:
            return self.reach.plant.robot.velocity_limits
        return np.asarray(limits.velocity)

    @property
    def peak_speed_ratio(self) -> float:
        """Largest recorded |q̇| as a share of the joint's limit; NaN where no limit is known."""
        speeds = self.speed_limits
        if not np.isfinite(speeds).any():
            return math.nan
        return float((np.abs(self.run.v) / speeds).max())

    def summary(self) -> dict[str, Any]:
        """What goes into summary.json."""
        run, reach = self.run, self.reach
        finals = self.errors_at(-1)
        counts = {status.name: count for status, count in run.status_counts().items()}
        return {
            "robot": run.robot_name,
            "final_error_m": finals.get("m"),
            **({"final_error_rad": finals["rad"]} if "rad" in finals else {}),
            "settling_time_s": _number(self.settling_time),
            "peak_torque_ratio": _number(self.peak_torque_ratio),
            "verdict": "converged" if self.converged else "not converged",
            "reason": self.reason,
            "joint_limit_excess": self.joint_limit_excess,
            "limits": self._limits_summary(),
            "start_error_m": self.errors_at(0).get("m"),
            "start": run.x[0].tolist(),
            "target": run.target.tolist(),
            "end": run.x[-1].tolist(),
            "q_start": reach.q0.tolist(),
            "q_end": run.q[-1].tolist(),
            "gains": {
                name: value.tolist() for name, value in reach.controller.diagonals._asdict().items()
            },
            "status_counts": counts,
            "settings": {f.name: getattr(reach.settings, f.name) for f in fields(Settings)},
        }

    def _limits_summary(self) -> dict[str, Any] | None:
        """What limits did, counted in every step; speeds at the recorded instants."""
        tally = self.tally
        if tally is None:
            return None
        return {
            "steps": tally.steps,
            "status_counts": {s.name: n for s, n in sorted(tally.counts.items())},
            "largest_slack_W": _number(tally.largest_slack),
            "largest_torque_violation": tally.torque_violation,
            "peak_speed_ratio": _number(self.peak_speed_ratio),
        }


def _listed(names: Array) -> str:
    *most, last = names.tolist()
    return f"{', '.join(most)} and {last}" if most else str(last)


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if math.isfinite(value) else None
