"""`RunResult`: the record of a scenario's run, its verdict, text, pictures and files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.controllers import KinematicReport
from approxjac.files import together, write_text
from approxjac.formatting import display_unit, joined, numbers_of, plain, rows, shares, wrapped
from approxjac.interface import Condition, LimitStatus, Status
from approxjac.robots import Dynamics
from approxjac.scenario.build import BuiltScenario, build_scenario, recommended, sampling_time
from approxjac.scenario.convert import differences, typed_as
from approxjac.scenario.records import Belief, Object, Truth
from approxjac.scenario.scenario import Scenario
from approxjac.scenario.starts import too_far
from approxjac.simulation import Computation, Loop, Trajectory, simulate
from approxjac.tasks import ImageTask
from approxjac.tasks.analysis import FINE, fine_error, place_of
from approxjac.validation import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RECORDS, _CONTINUOUS_RECORDS = 2000, 2400  # of a run, about
_AT_LIMIT = 0.01  # a joint this near to its position limit counts as at it [rad or m]
_AT_REST = 0.1  # what moves no faster may be called at rest [rad/s or m/s]
_UNITS = dict.fromkeys(("length", "radius", "shifts", "shift", "position", "offset", "floor"), "m")
_UNITS |= dict.fromkeys(("rotations", "rotation", "roll", "tilt"), "rad") | {"mass": "kg"}
_UNITS |= {"friction": "N m s/rad", "coulomb": "N m"}
_STRAY = 0.05  # of how far a path leads from its start: farther beside it is not following it


@dataclass(frozen=True, eq=False)
class RunResult:
    """The record of a scenario's run, and the verdict.

    For an image in px, because of noise, errors are the distances of the points, a run has settled
    if they stay within three tolerances, and the final error is an RMS. A path is followed if the
    error reached and stayed within the tolerance, which is wider.
    """

    built: BuiltScenario
    run: Trajectory

    @property
    def in_pixels(self) -> bool:
        """True if the task is an image in px."""
        return "px" in self.run.task_units

    @property
    def on_path(self) -> bool:
        """True if the target is a path to follow."""
        return not isinstance(self.built.target, np.ndarray)

    @property
    def tolerance(self) -> float:
        """Error below which the task counts as done [m, and rad of a pose; px of an image]."""
        given, noise = self.built.scenario.run.tolerance, self.built.scenario.sensor.noise
        if given is not None:
            return given
        # of an image it is of an RMS of the last tenth
        least = max(FINE["px"], noise) if self.in_pixels else fine_error(self.run.task_units, noise)
        if not self.on_path:
            return least
        size = float(np.linalg.norm(self.run.x_d - self.run.x_d[0], axis=1).max())
        return max(least, _STRAY * size)

    @property
    def errors(self) -> Array:
        """True distance of each point of an image from its target [px], or ‖e‖; shape (N, k)."""
        if not self.in_pixels:
            return self.run.error_norm[:, np.newaxis]
        return np.asarray(np.linalg.norm(self.run.error.reshape(len(self.run.t), -1, 2), axis=2))

    def errors_at(self, k: int) -> dict[str, float]:
        """Return the size of the error of each unit at a recorded instant."""
        if self.in_pixels:
            return {"px": float(self.errors[k].max())}
        e, units = self.run.error[k], np.array(self.run.task_units)
        return {u: float(np.linalg.norm(e[units == u])) for u in dict.fromkeys(self.run.task_units)}

    @property
    def final_error(self) -> dict[str, float]:
        """Size of the error of each unit at the end; of an image, RMS of the last tenth's worst."""
        if not self.in_pixels:
            return self.errors_at(-1)
        last = self.run.error[-max(1, len(self.run.t) // 10) :]
        return {"px": float(np.sqrt((last**2).mean(axis=0)).max())}

    @property
    def settling_time(self) -> float:
        """First recorded time from which on the errors stay within the tolerance [s]; or NaN."""
        enough = (3.0 if self.in_pixels else 1.0) * self.tolerance
        outside = np.flatnonzero(~np.all(self.errors <= enough, axis=1))
        return float(np.append(self.run.t, math.nan)[outside.max(initial=-1) + 1])

    @property
    def converged(self) -> bool:
        """True if the error ended, and stayed for the last tenth, within the tolerance."""
        if self.in_pixels:
            return self.final_error["px"] <= self.tolerance
        return self.settling_time <= 0.9 * float(self.run.t[-1])

    @property
    def strayed(self) -> tuple[float, float, float]:
        """Largest, RMS, and last quarter's RMS error on a path [unit of the task]."""
        errors = self.errors
        last = errors[-max(1, len(errors) // 4) :]
        rms, of_last = (float(np.sqrt((part**2).mean())) for part in (errors, last))
        return float(errors.max()), rms, of_last

    @cached_property
    def kinematics(self) -> KinematicReport | None:
        """Report of the learnt kinematics; None if they are not learnt."""
        if not self.built.scenario.controller.unknown:
            return None
        return self.built.controller.kinematics_learnt(self.run.state[-1])

    @cached_property
    def motor_torque(self) -> Array:
        """Commanded motor torque with the gravity that the robot adds, (N, n_v) [N m or N]."""
        run, robot = self.run, self.built.plant.adds_gravity
        if robot is None:
            return run.tau
        own = Dynamics(robot)
        return np.array([tau + own.g(q) for tau, q in zip(run.tau, run.q, strict=True)])

    @property
    def peak_torque_ratio(self) -> float:
        """Largest commanded torque as a share of its motor's limit; NaN if unknown."""
        return _peak(self.motor_torque, self.built.plant.motor_limits)

    @property
    def peak_speed_ratio(self) -> float:
        """Largest abs(q̇) as a share of the joint's limit; NaN where no limit is known."""
        limits = self.built.limits
        known = self.built.plant.robot.velocity_limits if limits is None else limits.velocity
        return _peak(self.run.v, np.asarray(known))

    @property
    def joint_limit_excess(self) -> float:
        """Largest excess of a joint over its position limits [rad or m]; 0 if none."""
        return max(0.0, float(self.built.plant.robot.beyond_limits(self.run.q).max()))

    @property
    def verdict(self) -> str:
        """Converged, converged late, or not converged; for a path followed, or not followed.

        A run that was stopped before it began has none.
        """
        if float(self.run.t[-1]) == 0.0:
            return "stopped after 0 s"
        done = "followed" if self.on_path else "converged"
        if self.late:
            return f"{done} late"
        return f"not {done}" if self.failed else done

    @property
    def late(self) -> bool:
        """True if a target at rest was reached in the last tenth only, too late to judge."""
        reached = not (self.on_path or self.in_pixels or math.isnan(self.settling_time))
        return reached and not self.converged

    @property
    def failed(self) -> bool:
        """True if the task was not done; being too late to judge is no failure."""
        return bool(self.reason) and not self.late

    @property
    def reason(self) -> str:
        """The reason why the task was not done or cannot be judged; "" if it was done."""
        if float(self.run.t[-1]) == 0.0:
            return "nothing was simulated, so there is no verdict"
        far = too_far(self.built.plant.sensor, self.run.x_d if self.on_path else self.run.x_d[-1:])
        if self.converged and not (self.on_path and far):
            return ""
        if self.late:
            return f"within the tolerance since {self.settling_time:.3g} s only, too late to judge"
        run, size = self.run, np.nan_to_num(self.run.error_norm, nan=math.inf)  # behind the camera
        last = slice(-max(1, len(run.t) // 4), None)
        before = size[: -len(size[last])][-len(size[last]) :]

        def mostly(what: Any) -> bool:
            return bool(np.mean(what) > 0.5)

        stopped = run.status == Status.STOPPED
        if stopped[-1]:
            at = int(stopped.argmax())
            why = Status(int(run.status[max(at - 1, 0)])).label
            return f"stopped by its guard at {run.t[at]:.3g} s ({why}), and held there"
        if mostly(run.status[last] == Status.MEASUREMENT_LOST):
            return "the measurement of x is lost"
        if far:
            return far
        stands = bool(len(before) and size[last].max() > 0.9 * before.max())
        at_stop = (self.built.plant.robot.beyond_limits(run.q[last]) > 0.0).mean(axis=0) > 0.5
        if stands and at_stop.any():
            return f"stands at the joint stops of {', '.join(np.array(run.joint_names)[at_stop])}"
        most = self.built.plant.motor_limits * (1.0 + 1e-9)  # solvers round
        if mostly((np.abs(self.motor_torque[last]) > most).any(axis=1)):
            who = "the law asks"
            if self.built.plant.adds_gravity is not None:
                who = "the law and the gravity that the robot adds ask"
            return f"{who} for more torque than the motors deliver"
        if mostly(run.limit_status[last] > LimitStatus.FREE):
            beyond = self.built.plant.robot.beyond_limits(run.q[-1:])[0] > -_AT_LIMIT
            names = ", ".join(np.array(run.joint_names)[beyond])
            where = f" at the position limits of {names}" if names else ""
            return f"held back{where}: {LimitStatus(int(run.limit_status[-1])).message}"
        swings = [e for e in run.events if e.condition is Condition.OSCILLATES]
        if lasting := [f"{e.where} by {e.figure}" for e in swings if math.isinf(e.end)]:
            return f"swings without end: {', '.join(lasting)}"
        if self.on_path:
            far = f"strays up to {self.strayed[0]:.3g} {run.task_unit} from its path"
            return f"{far}, where at most {self.tolerance:.3g} {run.task_unit} is following it"
        if stands and mostly(run.status[last] == Status.NEAR_SINGULAR):
            return "stands where the believed Jacobian is singular along the error"
        moved = np.linalg.norm(run.x[last] - run.x[-1], axis=1).max()
        if moved < 0.1 * size[-1] and np.abs(run.v[-1]).max() < _AT_REST:
            if self._learns(last) and size[-1] < 0.99 * size[last][0]:
                return "still learning: the error shrinks as what lacks is learnt"
            learnt = self.built.scenario.controller.gravity in (None, "learnt", "learn_residual")
            weight = "" if learnt else ", or gravity is not compensated as it is"
            return f"came to rest away from its target: out of reach, blocked, friction{weight}"
        if not stands:
            return "still approaching its target at the end"
        if self._learns(last):
            return "still learning: the torque that it compensates still changes"
        return "moves on without approaching: too short a run, or not stable with these errors"

    def _learns(self, last: slice) -> bool:
        """Return True if 1 % of the position force at the end was learnt in the last quarter."""
        run, law, q = self.run, self.built.law, self.run.q[-1]
        first, end = (law.gravity_torque(run.state[last][k], q) for k in (0, -1))
        return np.linalg.norm(end - first) > 0.01 * np.linalg.norm(run.at("task_torque", [-1]))

    def summary(self) -> dict[str, Any]:
        """Return the contents of summary.json."""
        run, built, robot, learnt = self.run, self.built, self.built.plant.robot, self.kinematics
        sizes = {"final_error": self.final_error, "start_error": self.errors_at(0)}
        if self.on_path:
            names = ("largest_error", "rms_error", "last_quarter_rms_error")
            sizes |= {k: {run.task_unit: e} for k, e in zip(names, self.strayed, strict=True)}
        known, limits = run.slack[np.isfinite(run.slack)], None
        if built.limits is not None:
            beyond = (np.abs(run.tau) - built.limits.effort).max()
            limits = {
                "status_counts": {s.name: n for s, n in run.limit_status_counts().items()},
                "largest_slack_W": known.max() if known.size else None,
                "largest_torque_violation": beyond.clip(0.0),
                "peak_speed_ratio": self.peak_speed_ratio,
            }
        values = {
            "robot": run.robot_name,
            **{f"{name}_{unit}": e for name, errors in sizes.items() for unit, e in errors.items()},
            "tolerance": self.tolerance,
            "settling_time_s": self.settling_time,
            "peak_torque_ratio": self.peak_torque_ratio,
            "verdict": self.verdict,
            "reason": self.reason,
            "warning": built.warning,
            "at_joint_stops_s": run.at_stops,
            "joint_limit_excess": self.joint_limit_excess,
            "limits": limits,
            "start": run.x[0],
            "target": run.target,
            "end": run.x[-1],
            "q_start": robot.angles(built.q0),
            "q_end": robot.angles(run.q[-1]),
            "controller": repr(built.law),
            "gains": built.law.gain_values,
            "kinematics": learnt
            and {"chi_squared": learnt.chi_squared} | {r.name: r._asdict() for r in learnt.rows},
            "status_counts": {status.name: n for status, n in run.status_counts().items()},
            "events": [str(event) for event in run.events],
            "scenario": asdict(built.scenario),
        }
        return {name: plain(value) for name, value in values.items()}


def run_scenario(
    scenario: Scenario | BuiltScenario,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[Loop], None] | None = None,
) -> RunResult:
    """Simulate a scenario and judge the run.

    Args:
        scenario: The scenario, or the result of `build_scenario`.
        progress: As for `simulate`.
        observer: As for `simulate`.
    """
    built = build_scenario(recommended(scenario)) if isinstance(scenario, Scenario) else scenario
    run, dt = built.scenario.run, sampling_time(built.scenario)
    options: dict[str, Any] = {"dt": None, "record_every": run.duration / _CONTINUOUS_RECORDS}
    duration, integrator = run.duration, "rk4"
    if dt > 0.0:
        every = max(1, round(duration / (dt * _RECORDS)))
        duration = max(1, round(duration / (dt * every))) * dt * every
        options = {"dt": dt, "record_every": every * dt, "seed": run.seed}
        integrator = "semi_implicit_euler"
    record = simulate(
        built.plant, built.controller, built.target, built.q0, duration, observer=observer,
        computation=Computation(integrator, progress=progress), **options,
    )  # fmt: skip
    return RunResult(built, record)


def _peak(values: Array, limits: Array) -> float:
    return float((np.abs(values) / limits).max()) if np.isfinite(limits).any() else math.nan


def write(result: RunResult, out: Path) -> None:
    """Write run.png, .svg and .npz, summary.json, scenario.toml, and kinematics.txt if learnt."""
    from approxjac import view

    with together(out) as folder:
        view.save_figure(draw(result), folder / "run")
        result.run.save(folder / "run.npz")
        if result.kinematics is not None:
            write_text(folder / "kinematics.txt", f"{result.kinematics}\n")
        result.built.scenario.save(folder / "scenario.toml")
        write_text(folder / "summary.json", json.dumps(result.summary(), indent=2) + "\n")


def text(result: RunResult) -> str:
    """Return the verdict and the figures of the run, a line each."""
    run, built, torque = result.run, result.built, result.peak_torque_ratio
    law, robot, scenario = built.law, built.plant.robot, built.scenario
    asks = "asks for up to" if built.limits is None else "up to"
    with_own = "" if built.plant.adds_gravity is None else ", with the gravity that the robot adds"
    true, belief = scenario.true, scenario.believed
    right = Belief(true.object, true.shifts, true.rotations)
    belief = replace(belief, object=belief.object.like(true.object))
    unit = f" {run.task_unit}" * (run.x.shape == run.error.shape)  # a quaternion has none
    lines = {
        "robot": f"{robot.name}, {robot.nv} joints, {robot.mass:.3g} kg with the object",
        "true": _different(true, Truth(object=Object())) or "as in the URDF",
        "believed": _different(belief, right)
        or ("what is true" if true.calibration is None else "as calibrated"),
        "law": law.describe()[0],
        "q at start": f"{numbers_of(robot.angles(run.q[0]))} {joined(run.joint_units)}",
        "q at end": f"{numbers_of(robot.angles(run.q[-1]))} {joined(run.joint_units)}",
        "x at start": f"{numbers_of(run.x[0])}{unit}",
        "x at end": f"{numbers_of(run.x[-1])}{unit} after {run.t[-1]:g} s",
        "target": f"{numbers_of(run.target)}{unit}",
        "settled": "not" if math.isnan(result.settling_time) else f"{result.settling_time:.3g} s",
        "torque": "no limit known"
        if math.isnan(torque)
        else f"{asks} {100.0 * torque:.0f} % of the limits{with_own}",
        "law's status": shares(run.status_counts()),
    }
    if run.command_kind == "velocity":
        lines["velocity"] = run.describe_largest("command")
    if learnt := law.describe_learnt(run.state[-1]):
        lines["learnt"] = learnt
    if (kinematics := result.kinematics) is not None:
        tool = [row.value for row in kinematics.rows if row.name.startswith("tool.")]
        where = f"tool at {numbers_of(np.round(tool, 3))} m, " if tool else ""
        lines["kinematics"] = (
            f"{where}chi squared {kinematics.chi_squared:.2f} per degree of freedom"
            f"{'' if kinematics.is_explained else ', which does not explain x'}: kinematics.txt"
        )
    if built.limits is not None:
        lines["limits' status"] = shares(run.limit_status_counts())
    if run.at_stops:
        lines["stops"] = f"{run.describe_stops()}; up to {result.joint_limit_excess:.2g} beyond"
    if not result.on_path and (run.x_d != run.x_d[0]).any():
        lines["shown"] = "the target was moved while it ran: errors are to the target then"
    lines |= run.describe_events()
    if built.warning:
        lines["warning"] = built.warning
    verdict = wrapped(": ".join(filter(None, (result.verdict, result.reason))))
    return "\n".join([*verdict, *wrapped(_error(result)), "", *rows(lines, 2)])


def _error(result: RunResult) -> str:
    """Return the error from start to end, or of a path, which begins at the arm, all along it."""
    unit, factor = display_unit(result.run.task_unit)
    within = f"{factor * result.tolerance:.3g} {unit}"
    if not result.on_path:
        size = f"error {_size(result.errors_at(0))} -> {_size(result.final_error)}"
        if math.isnan(result.settling_time):
            return f"{size}, where {within} is wanted"
        return f"{size}, within {within} from {result.settling_time:.3g} s on"
    largest, rms, last = (_size({result.run.task_unit: error}) for error in result.strayed)
    sizes = f"up to {largest} from the path, {rms} RMS, {last} in the last quarter"
    return f"{sizes}, where {within} is wanted"


def _different(record: Any, usual: Any) -> str:
    """Return the values of a record that differ from another's, by key."""
    parts = []
    for name, value in differences(record, usual).items():
        for key, each in (value if isinstance(value, dict) else {"": value}).items():
            words = name, key, typed_as(each), _UNITS.get(key) or _UNITS.get(name)
            parts.append(" ".join(filter(None, words)))
    return ", ".join(parts)


def draw(result: RunResult) -> Figure:
    """Draw error, torque, the path of the tip or through the image, and the effect of limits."""
    from approxjac import view

    run, built, sensor = result.run, result.built, result.built.plant.sensor
    limited = bool((run.limit_status > LimitStatus.FREE).any())  # or there is nothing to see
    title = f"{run.robot_name}: {result.verdict}"
    figure, axes = view.new_figure(*((2, 2) if limited else (3, 1)), title=title)
    view.plot_error(run, axes[0])
    asked = run if built.plant.adds_gravity is None else replace(run, tau=result.motor_torque)
    view.plot_torque(asked, axes[1], limits=built.plant.motor_limits)
    if isinstance(sensor, ImageTask):
        view.plot_image(run, sensor.camera, axes[2])
    else:
        target = None if result.on_path else place_of(sensor, run.target)
        truth, belief = built.plant.robot, built.law.task.robot
        view.plot_path(run, truth, plane=_plane(result), ax=axes[2], believed=belief, target=target)
    if limited:
        view.plot_slack(run, axes[3])
    return figure


def _plane(result: RunResult) -> str:
    """Return the world axes that a path spreads along most, or else "xz"."""
    run = result.run
    if not result.on_path or run.task_labels[:3] != ("x", "y", "z"):
        return "xz"
    chosen = np.argsort(-np.ptp(run.x_d[:, :3], axis=0), kind="stable")[:2]
    return "".join("xyz"[i] for i in sorted(chosen))


def _size(errors: dict[str, float]) -> str:
    """Return errors to three digits: of lengths in mm below a metre, and not below 1 µm."""
    parts = []
    for unit, value in errors.items():
        shown, factor = (unit, 1.0) if unit == "m" and value >= 1.0 else display_unit(unit)
        size = "< 0.001" if factor * value < 1e-3 else f"{factor * value:.3g}"
        parts.append(f"{size} {shown}")
    return " and ".join(parts)
