"""One reach of any arm whose controller believes a wrong robot: settings → run → verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_array, as_number
from approxjac.controllers import (
    AdaptiveGravity,
    Gains,
    Gravity,
    ModelGravity,
    NoGravity,
    Posture,
    RegressorGravity,
    SetpointController,
    default_gains,
)
from approxjac.errors import InvalidInputError
from approxjac.interface import Status
from approxjac.law import Linear, Sine
from approxjac.robots import Dynamics, GravityRegressor, Robot, load_robot
from approxjac.simulation import MujocoPlant, Plant, Sensing, Trajectory, simulate
from approxjac.tasks import PoseTask, PositionTask, Task

_REGULAR = 0.1  # starts and targets have σ_min of J and of Ĵ above this share of σ_max
_HOLDABLE = 0.7  # of the effort limits
_TRIES = 1000


@dataclass(frozen=True)
class Settings:
    """What to simulate. Lengths in m, masses in kg, angles in rad, times in s.

    Attributes:
        tip: End-effector frame that holds the object; the robot's own by default.
        base: Link that the chain to the tip starts from.
        free: Joints that are not locked although the tip does not need them.
        object_length: True length of the object.
        object_mass: True mass of the object.
        object_axis: Axis of the tip's frame that the object points along, such as "z" or "-x"; the
            one that leads on from the arm by default.
        believed_length: Length of the object that the controller believes.
        believed_mass: Mass of the object that the controller believes.
        joint_shifts: Errors of the believed joint origins, such as panda_joint4 0 0.01 0.
        joint_rotations: Errors of the believed joint axes, as rotation vectors.
        task: Bring the object's tip to a position, or to a pose.
        axes: World axes of a position; those that the arm commands best by default.
        start: Joint positions at the start, one a joint; a posture of the seed by default.
        target: Position (one number for each of axes) or pose (x y z qx qy qz qw); that of a
            posture of the seed by default.
        target_offset: Target of a position relative to where the tip starts.
        gravity: "learnt" (the law (28), (29)), "exact" (the parameters with which the believed
            robot's regressor fits the true gravity, which wrong joint axes keep it from doing
            exactly), "believed" (the believed robot's), or "none".
        settling_time: Wanted by the default gains.
        kp: K_p instead of the default gains' one; one number, or one a task coordinate.
        kv: K_v instead of the default gains' one; one number, or one a task coordinate.
        damping: Added joint damping instead of the default gains' one; one number, or one a joint.
        gamma: Saturation of the error by γ sin(e/γ); none by default.
        posture_stiffness: Draws the self-motion back to the start posture, N m/rad; 0 does not.
        duration: Of the run.
        rate: Of control, Hz.
        tolerance: Error below which the task counts as done, m (and rad of a pose).
        seed: Of start, target, noise and dropouts.
        friction: Viscous friction of every true joint, N m s/rad, unknown to the controller.
        coulomb: Coulomb friction of every true joint, N m, unknown to the controller.
        x_noise: Standard deviation of noise on x.
        x_quantum: Steps that x is rounded to.
        x_delay: Age of x when it arrives.
        x_dropout: Probability that a sample of x is lost.
        q_noise: Standard deviation of noise on the encoders.
        q_quantum: Steps of the encoders.
        velocity_filter: Time constant of q̇ from differences of q; an exact tachometer by default.
        actuator_delay: From a torque to its effect.
        engine: What simulates the true robot.
        floor: Height of a floor, for the engine mujoco.
    """

    tip: str | None = None
    base: str | None = None
    free: tuple[str, ...] = ()
    object_length: float = 0.2
    object_mass: float = 0.5
    object_axis: str | None = None
    believed_length: float = 0.0
    believed_mass: float = 0.0
    joint_shifts: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    joint_rotations: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    task: Literal["position", "pose"] = "position"
    axes: str | None = None
    start: tuple[float, ...] | None = None
    target: tuple[float, ...] | None = None
    target_offset: tuple[float, ...] | None = None
    gravity: Literal["learnt", "exact", "believed", "none"] = "learnt"
    settling_time: float = 1.0
    kp: tuple[float, ...] | None = None
    kv: tuple[float, ...] | None = None
    damping: tuple[float, ...] | None = None
    gamma: float | None = None
    posture_stiffness: float = 0.0
    duration: float = 20.0
    rate: float = 1000.0
    tolerance: float = 1e-3
    seed: int = 0
    friction: float = 0.0
    coulomb: float = 0.0
    x_noise: float = 0.0
    x_quantum: float = 0.0
    x_delay: float = 0.0
    x_dropout: float = 0.0
    q_noise: float = 0.0
    q_quantum: float = 0.0
    velocity_filter: float | None = None
    actuator_delay: float = 0.0
    engine: Literal["pinocchio", "mujoco"] = "pinocchio"
    floor: float | None = None


@dataclass(frozen=True, eq=False)
class Reach:
    """A reach ready to run: the truth, the controller with its belief, start and target."""

    settings: Settings
    plant: Plant
    controller: SetpointController
    q0: Array
    target: Array


@dataclass(frozen=True, eq=False)
class Result:
    """What became of a reach.

    Attributes:
        reach: What was run.
        run: The record.
        settling_time: First recorded time from which on the error is within the tolerance at
            every recorded instant [s]; NaN if it is not at the end.
        peak_torque_ratio: Largest torque asked for at these instants, as a share of the joint's
            effort limit; NaN where no limit is known.
    """

    reach: Reach
    run: Trajectory
    settling_time: float
    peak_torque_ratio: float

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
        beyond = np.abs(run.tau[last]) > self.reach.plant.robot.effort_limits
        if beyond.any(axis=1).mean() > 0.5:
            return "the law asks for more torque than the motors deliver"
        singular = float((run.status[last] == Status.NEAR_SINGULAR).mean())
        stands = norm[last].max() > 0.9 * before.max() if len(before) else False
        if singular > 0.5 and stands:
            return "stands where the believed Jacobian is singular along the error"
        moved = float(np.linalg.norm(run.x[last] - run.x[-1], axis=1).max())
        if moved < 0.1 * norm[-1]:
            learnt = settings.gravity == "learnt"
            weight = "" if learnt else ", or gravity is not compensated as it is"
            return f"came to rest away from its target: out of reach, blocked, friction{weight}"
        if not stands:
            return "still approaching its target at the end"
        return "moves on without approaching: too short a run, or not stable with these errors"

    @property
    def joint_limit_excess(self) -> float:
        """How far a joint was beyond its position limits at most [rad or m]; 0 if none was."""
        robot = self.reach.plant.robot
        low, high = robot.position_limits
        motions = [pin.difference(robot.model, robot.neutral(), q) for q in self.run.q]
        beyond = np.maximum(np.array(motions) - high, low - np.array(motions))
        # continuous joints have no limits, the others one coordinate each
        return max(0.0, float(beyond.max()))

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


def prepare(robot: str, settings: Settings) -> Reach:
    """Build the truth, the belief and what stands between them.

    Raises:
        ApproxJacError: Settings that are out of range or do not fit the robot.
    """
    arm = load_robot(robot, tip=settings.tip, base=settings.base, free=settings.free)
    axis = settings.object_axis or outward_axis(arm)
    truth = arm.with_object(settings.object_length, settings.object_mass, axis=axis)
    belief = arm.with_object(settings.believed_length, settings.believed_mass, axis=axis)
    if settings.joint_shifts or settings.joint_rotations:
        belief = belief.with_kinematic_error(settings.joint_shifts, settings.joint_rotations)
    sensor, task = _task(truth, settings), _task(belief, settings)
    as_number("rate", settings.rate, unit="Hz", above=0.0)
    as_number("tolerance", settings.tolerance, above=0.0)
    as_number("duration", settings.duration, unit="s", minimum=1.0 / settings.rate)
    if settings.seed < 0:
        raise InvalidInputError(f"seed must be >= 0, got {settings.seed}", given=settings.seed)
    plant = _plant(truth, sensor, settings)
    rng = np.random.default_rng(settings.seed)
    if settings.start is None:
        q0 = regular_posture(sensor, task, rng)
    else:
        q0 = _posture(truth, settings.start)
    target = _target(sensor, task, q0, settings, rng)
    controller = SetpointController(
        task,
        _gains(task, settings),
        gravity=_gravity(truth, belief, settings),
        saturation=Linear() if settings.gamma is None else Sine(settings.gamma),
        posture=Posture(q0, settings.posture_stiffness) if settings.posture_stiffness else None,
    )
    return Reach(settings, plant, controller, q0, target)


def run(reach: Reach, progress: Callable[[float], None] | None = None) -> Result:
    """Simulate a reach and judge it.

    Raises:
        SimulationError: The closed loop diverged.
    """
    settings = reach.settings
    dt = 1.0 / settings.rate
    every = max(1, round(settings.rate * settings.duration / 2000.0))
    record = simulate(
        reach.plant,
        reach.controller,
        reach.target,
        reach.q0,
        max(1, round(settings.duration / (dt * every))) * dt * every,
        dt=dt,
        record_every=every * dt,
        integrator="semi_implicit_euler",
        seed=settings.seed,
        progress=progress,
    )
    above = np.nonzero(record.error_norm > settings.tolerance)[0]
    if len(above) == 0:
        settling = 0.0
    elif above[-1] == len(record.t) - 1:
        settling = math.nan
    else:
        settling = float(record.t[above[-1] + 1])
    limits = reach.plant.robot.effort_limits
    ratio = math.nan
    if np.isfinite(limits).any():
        ratio = float((np.abs(record.tau) / limits).max())
    return Result(reach, record, settling, ratio)


def regular_posture(sensor: Task, task: Task, rng: np.random.Generator) -> Array:
    """Random posture that can be a start or a target.

    Within the joint limits, neither J nor Ĵ is near singular, and holding it takes at most 70 % of
    the effort limits.

    Raises:
        InvalidInputError: None was found.
    """
    dynamics, limits = Dynamics(sensor.robot), _HOLDABLE * sensor.robot.effort_limits
    for _ in range(_TRIES):
        q = sensor.robot.random_configuration(rng)
        if (np.abs(dynamics.g(q)) > limits).any():
            continue
        values = [np.linalg.svd(t.jacobian(q), compute_uv=False) for t in (sensor, task)]
        if all(v[-1] > _REGULAR * v[0] for v in values):
            return q
    raise InvalidInputError(
        f"no posture of {sensor.robot.name} was found that its motors can hold and where the task "
        f"is not near singular: give a lighter object, or other axes than those of {sensor!r}",
        given=sensor,
    )


def best_axes(robot: Robot) -> str:
    """World axes of a position that an arm commands: all three, or of two joints the best two."""
    if robot.nv >= 3:
        return "xyz"
    rng = np.random.default_rng(0)
    speeds = np.zeros(3)
    for i, axis in enumerate("xyz"):
        task = PositionTask(robot, axes=axis)
        speeds[i] = sum(
            np.linalg.norm(task.jacobian(robot.random_configuration(rng))) for _ in range(20)
        )
    best = sorted(np.argsort(-speeds)[: robot.nv])
    return "".join("xyz"[i] for i in best)


def outward_axis(robot: Robot) -> str:
    """Axis of the tip's frame along which the last three joints lead to the tip."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.neutral())
    tip = data.oMf[robot.frame_id(robot.tip_or(None))]
    wrist = max(1, robot.model.njoints - 3)
    lever = -tip.actInv(data.oMi[wrist].translation)
    k = int(np.abs(lever).argmax())
    return ("" if lever[k] >= 0.0 else "-") + "xyz"[k]


def _task(robot: Robot, settings: Settings) -> Task:
    if settings.task == "pose":
        if settings.axes is not None:
            raise InvalidInputError(
                f"axes are those of a position, not of a pose, got {settings.axes!r}",
                given=settings.axes,
            )
        return PoseTask(robot)
    return PositionTask(robot, axes=settings.axes or best_axes(robot))


def _posture(robot: Robot, joints: tuple[float, ...]) -> Array:
    """Configuration from one number a joint, continuous joints included."""
    motion = as_array("start", joints, (robot.nv,), "rad or m")
    low, high = robot.position_limits
    for name, value, a, b in zip(robot.joint_names, motion, low, high, strict=True):
        if not a <= value <= b:
            raise InvalidInputError(
                f"start must be within the joint limits, got {value:g} for {name} "
                f"({a:.4g} to {b:.4g})",
                given=joints,
            )
    return np.array(pin.integrate(robot.model, robot.neutral(), motion))


def _target(
    sensor: Task, task: Task, q0: Array, settings: Settings, rng: np.random.Generator
) -> Array:
    if settings.target is not None and settings.target_offset is not None:
        raise InvalidInputError(
            "target and target_offset must not both be given",
            given=(settings.target, settings.target_offset),
        )
    if settings.target is not None:
        return sensor.target(settings.target)
    if settings.target_offset is not None:
        offset = as_array("target_offset", settings.target_offset, (sensor.m,), sensor.unit)
        return sensor.displaced(sensor.value(q0), offset)
    return sensor.value(regular_posture(sensor, task, rng))


def _gains(task: Task, settings: Settings) -> Gains:
    lag = 1.0 / settings.rate + (settings.velocity_filter or 0.0) + settings.actuator_delay
    gains = default_gains(task, settings.settling_time, bandwidth=1.0 / lag)
    return Gains(
        kp=_given(settings.kp, gains.kp),
        kv=_given(settings.kv, gains.kv),
        damping=_given(settings.damping, gains.damping),
    )


def _given(values: tuple[float, ...] | None, default: Any) -> Any:
    """Return numbers that were given, a single one as it is, or the default."""
    if values is None:
        return default
    return values[0] if len(values) == 1 else values


def _gravity(truth: Robot, belief: Robot, settings: Settings) -> Gravity:
    if settings.gravity == "none":
        return NoGravity(belief)
    if settings.gravity == "believed":
        return ModelGravity(belief)
    regressor = GravityRegressor(belief)
    if settings.gravity == "learnt":
        return AdaptiveGravity(regressor)
    return RegressorGravity(regressor, regressor.fit(truth)[0])


def _plant(truth: Robot, sensor: Task, settings: Settings) -> Plant:
    sensing = Sensing(
        x_noise=settings.x_noise,
        x_quantum=settings.x_quantum,
        x_delay=settings.x_delay,
        x_dropout=settings.x_dropout,
        q_noise=settings.q_noise,
        q_quantum=settings.q_quantum,
        velocity_filter=settings.velocity_filter,
    )
    options: Mapping[str, Any] = {
        "coulomb": settings.coulomb,
        "sensing": sensing,
        "actuator_delay": settings.actuator_delay,
        "torque_limits": truth.effort_limits,
    }
    if settings.engine == "mujoco":
        return MujocoPlant(truth, sensor, settings.friction, floor=settings.floor, **options)
    if settings.floor is not None:
        raise InvalidInputError(
            "a floor needs the engine mujoco (--engine mujoco), got pinocchio", given=settings.floor
        )
    return Plant(truth, sensor, settings.friction, **options)


def _number(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if math.isfinite(value) else None
