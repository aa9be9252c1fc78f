"""A scenario that is run, and what became of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.interface import LimitStatus, Status
from approxjac.robots.joint_limits import beyond_positions, reach_bound
from approxjac.scenario.build import BuiltScenario
from approxjac.scenario.tables import plain
from approxjac.scenario.tally import Tally
from approxjac.simulation import Trajectory
from approxjac.tasks import PoseTask, PositionTask
from approxjac.validation import Array

Mask = np.ndarray[Any, np.dtype[np.bool_]]

AT_LIMIT = 0.01  # a joint this near to its position limit counts as at it [rad or m]
_AT_REST = 0.1  # what moves no faster may be called at rest [rad/s or m/s]
_TOLERANCE = 1e-3  # [m and rad]


@dataclass(frozen=True, eq=False)
class Result:
    """What became of a scenario.

    Attributes:
        built: What was run.
        run: The record.
        tally: What limits did in all steps; None where the controller knows none.
    """

    built: BuiltScenario
    run: Trajectory
    tally: Tally | None = None

    @property
    def tolerance(self) -> float:
        """Error below which the task counts as done [m, and rad of a pose]."""
        given = self.built.scenario.run.tolerance
        return _TOLERANCE if given is None else given

    @property
    def settling_time(self) -> float:
        """First recorded time from which on the error stays within the tolerance [s]; or NaN."""
        return self._settled(np.asarray(self.run.error_norm <= self.tolerance))

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

    def _settled(self, within: Mask) -> float:
        """First recorded time from which on something is so, shape (N,) [s]; NaN if never."""
        outside = np.nonzero(~within)[0]
        if len(outside) == 0:
            return 0.0
        if outside[-1] == len(self.run.t) - 1:
            return math.nan
        return float(self.run.t[outside[-1] + 1])

    # -- limits -------------------------------------------------------------------------

    @property
    def peak_torque_ratio(self) -> float:
        """Largest torque asked for, as a share of what its motor delivers; NaN if not known."""
        return self._peak(self.run.tau, self.built.motor_limits)

    @property
    def peak_speed_ratio(self) -> float:
        """Largest recorded |q̇| as a share of the joint's limit; NaN where no limit is known."""
        return self._peak(self.run.v, self.speed_limits)

    @property
    def speed_limits(self) -> Array:
        """What |q̇| should not exceed, shape (n_v,) [rad/s or m/s]; infinite where not known."""
        limits = self.built.limits
        if limits is None:
            return self.built.plant.robot.velocity_limits
        return np.asarray(limits.velocity)

    @property
    def joint_limit_excess(self) -> float:
        """How far a joint was beyond its position limits at most [rad or m]; 0 if none was."""
        # continuous joints have no limits, the others one coordinate each
        return max(0.0, float(beyond_positions(self.built.plant.robot, self.run.q).max()))

    def _peak(self, values: Array, limits: Array) -> float:
        return float((np.abs(values) / limits).max()) if np.isfinite(limits).any() else math.nan

    # -- why not ------------------------------------------------------------------------

    @property
    def reason(self) -> str:
        """What kept the task from being done, in words; nothing if it was done."""
        if self.converged:
            return ""
        run = self.run
        norm, last = run.error_norm, self._end
        before = norm[: len(norm) - len(norm[last])][-len(norm[last]) :]
        if float((run.status[last] == Status.MEASUREMENT_LOST).mean()) > 0.5:
            return "the measurement of x is lost"
        if not math.isnan(self.settling_time):
            return f"within the tolerance since {self.settling_time:.3g} s only, too late to judge"
        away, most = self._distance()
        if away > most:
            return (
                f"out of reach: {away:.3g} m from the first joint, where {most:.3g} m is the most"
            )
        if self._asks_too_much(0.5):
            return "the law asks for more torque than the motors deliver"
        moved = float(np.linalg.norm(run.x[last] - run.x[-1], axis=1).max())
        rests = moved < 0.1 * norm[-1] and float(np.abs(run.v[-1]).max()) < _AT_REST
        free = (LimitStatus.UNLIMITED, LimitStatus.FREE)
        if float(np.isin(run.limit_status[last], free).mean()) < 0.5:
            return self._what_limits_did(last, rests)
        stands = norm[last].max() > 0.9 * before.max() if len(before) else False
        if self._near_singular and stands:
            return "stands where the believed Jacobian is singular along the error"
        if rests:
            learnt = self.built.scenario.controller.gravity == "learnt"
            weight = "" if learnt else ", or gravity is not compensated as it is"
            return f"came to rest away from its target: out of reach, blocked, friction{weight}"
        if not stands:
            return "still approaching its target at the end"
        return "moves on without approaching: too short a run, or not stable with these errors"

    @property
    def _end(self) -> slice:
        """The last quarter of the records."""
        return slice(-max(1, len(self.run.t) // 4), None)

    @property
    def _near_singular(self) -> bool:
        return float((self.run.status[self._end] == Status.NEAR_SINGULAR).mean()) > 0.5

    def _asks_too_much(self, share: float) -> bool:
        """Whether torques are beyond the motors' for more than a share of the end."""
        beyond = np.abs(self.run.tau[self._end]) > self.built.motor_limits * (1.0 + 1e-9)
        return bool(beyond.any(axis=1).mean() > share)  # solvers round, hence the 1e-9

    def _distance(self) -> tuple[float, float]:
        """How far the target is from the first joint at least, and the tip at most [m]."""
        sensor = self.built.plant.sensor
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
        beyond = beyond_positions(self.built.plant.robot, run.q)[-1]
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
        weak = np.abs(run.tau[-1]) > 0.999 * self.built.motor_limits
        if weak.any():
            return f"came to rest at the torque limits: those of {_listed(names[weak])}"
        return "came to rest away from its target, held back by its limits"

    # -- summary ------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """What goes into summary.json."""
        run, built = self.run, self.built
        return {
            "robot": run.robot_name,
            **self._errors_summary(),
            "settling_time_s": number(self.settling_time),
            "peak_torque_ratio": number(self.peak_torque_ratio),
            "verdict": "converged" if self.converged else "not converged",
            "reason": self.reason,
            "joint_limit_excess": self.joint_limit_excess,
            "limits": self._limits_summary(),
            "start": run.x[0].tolist(),
            "target": run.target.tolist(),
            "end": [number(value) for value in run.x[-1].tolist()],
            "q_start": built.q0.tolist(),
            "q_end": run.q[-1].tolist(),
            "controller": repr(built.law),
            "gains": gains_of(built.law),
            "status_counts": {status.name: n for status, n in run.status_counts().items()},
            "scenario": plain(built.scenario),
        }

    def _errors_summary(self) -> dict[str, Any]:
        finals = self.errors_at(-1)
        return {
            "final_error_m": finals.get("m"),
            **({"final_error_rad": finals["rad"]} if "rad" in finals else {}),
            "start_error_m": self.errors_at(0).get("m"),
        }

    def _limits_summary(self) -> dict[str, Any] | None:
        """What limits did, counted in every step; speeds at the recorded instants."""
        tally = self.tally
        if tally is None:
            return None
        return {
            "steps": tally.steps,
            "status_counts": {s.name: n for s, n in sorted(tally.counts.items())},
            "largest_slack_W": number(tally.largest_slack),
            "largest_torque_violation": tally.torque_violation,
            "peak_speed_ratio": number(self.peak_speed_ratio),
        }


def gains_of(law: SetpointController) -> dict[str, list[float]]:
    """Return the gains of a law as plain numbers."""
    return {name: value.tolist() for name, value in law.diagonals._asdict().items()}


def number(value: float) -> float | None:
    """Return a number as JSON knows it: None where it is not finite."""
    return value if math.isfinite(value) else None


def _listed(names: Array) -> str:
    *most, last = names.tolist()
    return f"{', '.join(most)} and {last}" if most else str(last)
