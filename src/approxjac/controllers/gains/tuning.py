"""Rules that choose gains: `default_gains` by inertia, `tuned` also by motors and latency."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Diagonals, Gains, Latency
from approxjac.controllers.gains.motors import least_rotors, motor_damping
from approxjac.controllers.gains.sample_configurations import (
    SampleConfigurations,
    sample_configurations,
)
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed
from approxjac.robots import Drives, Dynamics, GravityRegressor, Robot
from approxjac.robots.urdf import as_size, direction
from approxjac.tasks import Task
from approxjac.tasks.analysis import FINE, require_controllable
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array, as_number, as_vector

UNKNOWN_TOOL = 0.18  # length of an unmodelled tool, as a share of the arm's reach

_SETTLED = 4.0  # time constants until 2 % are left
_DAMPING_SHARE = 0.03
_NO_TIME = 1e-50  # settling times below it have gains that overflow [s]
_RATES = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0)  # [1/s]
_LAG = 0.3  # rate times lag of x at most: a quarter of what makes a delayed integrator ring
_SHARES = (1.0, 0.7, 0.49, 0.34, 0.24, 0.17, 0.12)  # of the learning that inertia alone allows
_TORQUE, _HOLDABLE, _SPEED = 0.755, 0.7, 0.8  # shares of the limits
_RIDGE = 0.03  # of the natural metric: hardly observable directions are learnt slowly
_MARGIN = 1.5  # gains and learning may be larger by it
_DAMPED = 0.15  # least damping ratio, in nine of ten cases
_QUICK = 0.15  # r times the lag of x below which y is small along the way: it is slow enough
_LATE = 0.36  # more of it, times r and the lag of x: frames are never as regular as thought
_CHECKED = 20  # postures
_SLOWER, _STEPS = 0.8, 12  # rates that are tried, as a share of the one before, and how many
_LIGHTER, _HEAVIER = 0.7, 1.3  # true inertia as a multiple of the believed one
_IDEAL = 1e-4  # period of a loop without latency [s]
_ROUND_OFF = 1e-7  # of multipliers
_NO_GROWTH = 1e-11  # of those of a loop without latency
_NEARLY = 0.95  # of the damping that a loop without latency has
_ROTORS = 3.0  # times the least ones, that learning takes account of
_JOINTS = 0.5  # share of what motors may damp that is the joints' own
_HELD = 0.1  # of the arm's mass, which motors have to hold if no payload is given
_STANDARD_GRAVITY = 9.81  # [m/s²]
_STILL = 1e-3  # slower modes, as a share of the rate, are self-motion and what no joint feels

Flags = np.ndarray[Any, np.dtype[np.bool_]]


def default_gains(task: Task, settling_time: float = 1.0, bandwidth: float = 1000.0) -> Gains:
    """Return gains with which the believed arm settles to 2 % in about `settling_time`.

    With r = 4 / settling_time, Λ = 1 / (Ĵ M⁻¹ Ĵᵀ)ᵢᵢ the inertia along a task coordinate and
    K_b = 1 / (Ĵ B_c⁻¹ Ĵᵀ)ᵢᵢ the damping that B_c adds along it, medians over seeded configurations,

        K_v = 4 r Λ,   B_c = r Mᵢᵢ + b,   b = 0.03 λ_max[Ĵᵀ K_v Ĵ],   K_p = r (K_v + K_b),

    so that the slow pole of Λë + (K_v + K_b) ė + K_p e = 0 is at about −r. Coordinates of one unit
    get the same gain; orientations get K_v ≥ 2 b. B_c satisfies the paper's condition (21) along a
    self-motion, which decays like exp(−r t), and b damps the wrist if the tool is longer than
    believed, where Ĵ has no lever arm. K_v (and K_p with it) of each unit and B_c of each joint are
    reduced until λ_max[M⁻¹ĴᵀK_vĴ] and (M⁻¹)ᵢᵢ B_c, each alone, are at most half of `bandwidth`:
    faster damping is unstable in sampled control.

    Args:
        task: The task of the believed robot.
        settling_time: > 0 [s].
        bandwidth: Fastest damping rate > 0 [1/s]: 1/dt for sampled control with an exact q̇,
            1/(dt + T) with q̇ from a filter of time constant T.

    Raises:
        InvalidInputError: Numbers that are not positive, or a task that is singular in every
            configuration.
    """
    require_controllable(task)
    return _gains_at(
        _SETTLED / as_number("settling_time", settling_time, unit="s", above=_NO_TIME),
        task,
        sample_configurations(task),
        0.5 * as_number("bandwidth", bandwidth, unit="1/s", above=0.0),
    )


def _gains_at(
    rate: float,
    task: Task,
    postures: SampleConfigurations,
    fastest: float,
    motors: Array | None = None,
    unknown: bool = False,
) -> Gains:
    """Return the gains of `default_gains` at a rate r and half a bandwidth [1/s].

    `motors` is the largest damping of each motor, (n_v,), half of it for K_v in nearly all postures
    and half for B_c, which is all of that where rotors are unknown, as inertia may be more.
    """
    kv = 4.0 * rate * postures.inertia
    quieting = _DAMPING_SHARE * 4.0 * rate * postures.inertia_in_joints
    angles = np.array(task.units) == "rad"
    kv[angles] = np.maximum(kv[angles], 2.0 * quieting)
    for group, mobility in zip(postures.groups, postures.largest_mobility, strict=True):
        # M⁻¹JᵀK_vJ has the eigenvalues of K_v times the mobility
        kv[group] = np.minimum(kv[group], fastest / mobility)
    most = fastest / np.diagonal(postures.M_inv, axis1=1, axis2=2).max(axis=0)
    damping = np.minimum(rate * postures.joint_inertia + quieting, most)
    if motors is not None:
        lever = np.linalg.norm(postures.J_hat / np.sqrt(motors), 2, axis=(1, 2)) ** 2
        kv = np.minimum(kv, (1.0 - _JOINTS) / float(np.quantile(lever, _NEARLY)))
        damping = np.minimum(_JOINTS * motors, most if unknown else damping)
    return Gains(kp=rate * (kv + postures.felt_damping(damping)), kv=kv, damping=damping)


def require_damping(gains: Gains, diagonals: Diagonals, task: Task) -> None:
    """Raise an InvalidInputError if a redundant arm has no added damping; suggest some."""
    robot, m = task.robot, task.m
    if robot.nv > m and not (diagonals.damping > 0.0).all():
        would_do = f"damping={listed(np.round(default_gains(task).damping, 2))} would do"
        raise InvalidInputError(
            f"damping must be > 0 [N m s/rad] for {robot.name}: it has {robot.nv} joints for {m} "
            f"task coordinates, and nothing else damps its self-motion; got "
            f"{diagonals.damping.tolist()}; {would_do}",
            given=gains,
        )


def position_gains(task: Task, kv: Array, damping: Array, settling_time: float) -> Array:
    """Return the K_p (m,) of `default_gains` for a given K_v (m,) and B_c (n_v,)."""
    return _SETTLED / settling_time * (kv + sample_configurations(task).felt_damping(damping))


def slow_rate(task: Task, gains: Diagonals) -> float:
    """Return the rate of the slow pole, min k_p / (k_v + K_b), K_b as in `default_gains` [1/s]."""
    felt = sample_configurations(task).felt_damping(gains.damping)
    return float((gains.kp / (gains.kv + felt)).min())


def with_unknown_tool(robot: Robot, length: float | None = None) -> Robot:
    """Return a robot with its tip moved outwards, by the usual length of an unmodelled tool."""
    if robot.tip is None:
        return robot
    joint = next(each for each in robot.tree.joints.values() if each.child == robot.tip)
    neutral = robot.neutral()
    of_parent, of_tip = (
        FrameKinematics(robot, frame).placement(neutral)[0] for frame in (joint.parent, robot.tip)
    )
    _, reach = robot.reach_bound(robot.tip)
    usual = UNKNOWN_TOOL * reach if math.isfinite(reach) else 0.0
    along = np.asarray(direction(robot.outward_axis()))
    shift = (usual if length is None else length) * of_parent.T @ of_tip @ along
    return robot.with_kinematic_error({joint.name: shift.tolist()})


class Learning(NamedTuple):
    """Rates and bounds of learning θ̂ = (θ̂_g, d̂, ŵ), see `AdaptiveGravity`.

    Attributes:
        alpha: α of eq. (10) [1/s].
        gravity: L of the gravity parameters, shape (p, p).
        task_force: L_d, diagonal, shape (m,).
        joint_torque: L_w, diagonal, shape (n_v,).
        largest: Largest change of each parameter from its initial value, shape (p + m + n_v,).
        pinv_weight: Weight of Ĵ⁺ in y of (10): B_c over its geometric mean, shape (n_v,); None
            if B_c has zeros, or x is late.
    """

    alpha: float
    gravity: Array
    task_force: Array
    joint_torque: Array
    largest: Array
    pinv_weight: Array | None


@dataclass(frozen=True, eq=False)
class Tuning:
    """Gains, saturation and learning rates chosen for a task, with the reasons.

    Attributes:
        gains: K_p, K_v, B_c.
        gamma: Saturation γ of tanh, shape (m,) [unit of the task].
        learning: L, L_d, L_w, α and bounds; None without learning.
        latency: Latency of the loop that they were chosen for.
        rate: r, rate of the task's slow pole [1/s].
        share: π, learning rate as a share of the largest that inertia allows.
        stable: True if the check by the sampled, delayed linearisation passed.
        reasons: Reasons of the choice, a line each.
    """

    gains: Gains
    gamma: Array
    learning: Learning | None
    latency: Latency
    rate: float
    share: float
    stable: bool
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.reasons)


class _Arm:
    """The believed arm at its sample configurations."""

    def __init__(
        self,
        task: Task,
        regressor: GravityRegressor | None,
        latency: Latency,
        drives: Drives | None,
        payload: tuple[float, float] | None,
    ) -> None:
        robot = task.robot
        self.task, self.robot, self.payload = task, robot, payload
        self.postures, self.motors = sample_configurations(task), None
        self.heavy = self.postures  # with the rotors that there may be
        if drives is not None or latency.is_felt_by_motors:
            motors = motor_damping(robot, latency, drives)
            self.motors = motors if np.isfinite(motors).any() else None
            if drives is None:  # learning must not ring with heavier rotors
                self.heavy = self.postures.with_rotors(_ROTORS * least_rotors(robot))
            else:
                self.heavy = self.postures.with_rotors(np.asarray(drives.rotor_inertia))
                self.postures = self.heavy
        q = self.postures.q
        self.g = np.array([*map(Dynamics(robot).g, q)])
        self.Z = None if regressor is None else np.array([*map(regressor.Z, q)])
        x = [task.value(each) for each in q]
        between = np.array([task.error(a, b) for a, b in zip(x, [*x[1:], x[0]], strict=True)])
        self.distance = [
            float(np.median(np.linalg.norm(between[:, group], axis=1))) or math.inf  # of one
            for group in self.postures.groups
        ]

    @functools.cached_property
    def with_tool(self) -> Array:
        """Jacobians of the arm with an unmodelled tool at its tip, shape (k, m, n_v)."""
        length = None if self.payload is None else self.payload[1]
        task = self.task.on(with_unknown_tool(self.robot, length))
        return np.array([task.jacobian(q) for q in self.postures.q[:_CHECKED]])

    def motion(self, gains: Diagonals) -> tuple[Array, Array]:
        """Return D = ĴᵀK_vĴ + B_c and ĴᵀK_p at each posture."""
        J, (kp, kv, damping) = self.postures.J_hat, gains
        return J.mT * kv @ J + np.diag(damping), J.mT * kp

    def damped_rate(self, gains: Gains) -> float:
        """Return the largest rate r that K_v and B_c damp, where motors bound them."""
        if self.motors is None:
            return math.inf
        kv, damping = gains.diagonals(self.task.m, self.robot.nv)[1:]
        felt = kv + self.postures.felt_damping(damping)
        return float((0.5 * felt / self.postures.inertia).min())

    def saturation(self, gains: Diagonals, latency: Latency) -> Array:
        """Return γ (m,), which keeps torques and speeds within their limits."""
        (D, force), rate = self.motion(gains), slow_rate(self.task, gains)
        effort, fastest = self.robot.effort_limits, self.robot.velocity_limits
        speed = np.linalg.solve(D, force)
        holdable = (np.abs(self.g) <= _HOLDABLE * effort).all(axis=1)
        at = holdable if holdable.any() else np.ones_like(holdable)
        share = _TORQUE / (1.0 + rate * latency.of_position)  # what is late overshoots
        left = np.maximum(share * effort - np.abs(self.g[at]), (1.0 - _HOLDABLE) * effort)
        gamma = np.empty(self.task.m)
        for group, distance in zip(self.postures.groups, self.distance, strict=True):
            with np.errstate(divide="ignore"):
                motors = (left / np.linalg.norm(force[at][:, :, group], axis=2)).min(axis=1)
                speeds = (_SPEED * fastest / np.linalg.norm(speed[:, :, group], axis=2)).min(axis=1)
            held = 0.0  # what holds a payload, even if that is fast
            is_felt = self.motors is not None or self.payload is not None
            if is_felt and np.array(self.task.units)[group][0] == "m":
                mass = _HELD * self.robot.mass if self.payload is None else self.payload[0]
                held = mass * _STANDARD_GRAVITY / float(gains.kp[group].min())
            most = max(float(np.median(speeds)), held)
            most = min(float(np.quantile(motors, 0.25, method="lower")), most)
            gamma[group] = min(max(distance / 8.0, held), most / len(self.distance))
        return gamma

    def time(self, gamma: Array, rate: float, alpha: float) -> float:
        """Return the time that a usual distance takes until hardly any error is left [s]."""
        times = []
        for group, distance in zip(self.postures.groups, self.distance, strict=True):
            unit, g = np.array(self.task.units)[group][0], float(gamma[group][0])
            fine = min(FINE.get(unit, math.inf), 0.01 * distance)
            far = max(0.0, distance - g) / (alpha * g)
            times.append(far + 2.0 * math.log(max(g / fine, 1.0)) / rate)
        return max(times)

    def learning(
        self, gains: Diagonals, share: float, latency: Latency, alpha: float | None
    ) -> Learning:
        """Return learning that is a share π of the fastest."""
        assert self.Z is not None
        (D, _), slow = self.motion(gains), slow_rate(self.task, gains)
        J, Z = self.postures.J_hat, self.Z
        # W = D⁻¹ M D⁻¹: learning at a rate P and motion make an oscillator, damped where WP is
        # small. Its root turns products into symmetric matrices.
        try:
            root = np.linalg.solve(D, np.linalg.cholesky(self.heavy.M))
        except np.linalg.LinAlgError:
            message = f"damping must be > 0 for gravity to be learnt, got {listed(gains.damping)}"
            raise InvalidInputError(message, given=gains) from None

        def largest(P: Array) -> float:
            values = np.linalg.eigvalsh(root.mT @ P @ root)[:, -1]
            return max(float(np.quantile(values, 0.95)), 1e-300)  # 0 without damping

        most = 0.6 * max(share, 0.35)
        task_force = 0.5 * gains.kp
        task_force = task_force * min(1.0, most / largest(J.mT * task_force @ J))
        felt = root.mT @ Z
        C = np.mean(felt.mT @ felt, axis=0)
        S = 1.0 / np.sqrt(np.maximum(np.diag(C), 1e-8 * np.diag(C).max()))
        L = S[:, None] * np.linalg.inv(S[:, None] * C * S + _RIDGE * np.eye(len(S))) * S
        L *= 0.5 * share / largest(Z @ L @ Z.mT)
        joint_torque = 0.25 * gains.damping**2 / self.heavy.joint_inertia
        joint_torque = joint_torque * min(1.0, 0.5 * share / largest(np.diag(joint_torque)))
        # of each parameter, the size whose torque alone is what a motor has, RMS
        usual = np.sqrt((np.concatenate([Z, J.mT], axis=2) ** 2).mean(axis=0))
        effort = self.robot.effort_limits
        weight: Array | None = None
        with np.errstate(divide="ignore"):
            largest_of = np.concatenate([(effort[:, None] / usual).min(axis=0), effort])
        if slow * latency.of_position < _QUICK and (gains.damping > 0.0).all():
            weight = gains.damping / np.exp(np.log(gains.damping).mean())  # so Ĵ keeps its size
        alpha = slow if alpha is None else alpha
        return Learning(alpha, 0.5 * (L + L.T), task_force, joint_torque, largest_of, weight)

    def cases(self, gains: Diagonals, learning: Learning | None) -> law.LinearLaw:
        """Return the linearised loop at some postures, of arms that differ from the believed."""
        J_hat = self.postures.J_hat[:_CHECKED]
        D, force = (each[:_CHECKED] for each in self.motion(gains))
        rate, pull = np.zeros_like(D), np.zeros_like(force)
        if learning is not None:
            assert self.Z is not None
            Z = self.Z[:_CHECKED]
            rate = rate + Z @ learning.gravity @ Z.mT
            rate = rate + J_hat.mT * learning.task_force @ J_hat + np.diag(learning.joint_torque)
            root = 1.0 if learning.pinv_weight is None else np.sqrt(learning.pinv_weight)
            pinv = np.linalg.pinv(J_hat / root).mT / root
            pull = pull + learning.alpha * pinv.mT
        light, most = (each.M_inv[:_CHECKED] for each in (self.postures, self.heavy))
        truths = [
            (M_inv, J)
            for J, heavier in ((J_hat, 1.0), (self.with_tool, _HEAVIER))
            for M_inv in (most / heavier, light / _LIGHTER)
        ]
        each = [(M, J, force, D, rate, pull) for M, J in truths]
        return law.LinearLaw(*(np.concatenate(parts) for parts in zip(*each, strict=True)))

    def fastest(
        self, gains: Diagonals, latency: Latency, alpha: float | None
    ) -> tuple[float, Learning | None, bool]:
        """Return the largest π that passes the check, its learning, and whether any passes."""
        choices: list[tuple[float, Learning | None]] = [(0.0, None)]
        if self.Z is not None:
            choices = [(share, self.learning(gains, share, latency, alpha)) for share in _SHARES]
        counted, attainable = self.without_latency(gains, choices[-1][1])
        for choice in choices:
            if self.passes(gains, choice[1], latency, counted, attainable):
                return (*choice, True)
        return (*choices[-1], False)

    def without_latency(self, gains: Diagonals, learning: Learning | None) -> tuple[Flags, float]:
        """Return the cases in which a loop without latency is stable, and their damping.

        More is not asked for of one with latency: what is left is a believed Jacobian that is too
        far from the true one for any gains, or that makes any of them ring.
        """
        multipliers = np.linalg.eigvals(law.frame_map(self.cases(gains, learning), _IDEAL, 1, 0))
        curable = np.abs(multipliers).max(axis=1) <= 1.0 + _NO_GROWTH
        return np.asarray(curable), self.damping_ratio(gains, multipliers[curable], _IDEAL, _IDEAL)

    def passes(
        self,
        gains: Diagonals,
        learning: Learning | None,
        latency: Latency,
        counted: Flags,
        attainable: float,
    ) -> bool:
        """Return True if the sampled, delayed linearisation is stable with a margin, and damped."""
        loop = law.LinearLaw(*(part[counted] for part in self.cases(gains, learning)))
        timing = latency.in_samples()
        larger = loop._replace(
            stiffness=_MARGIN * loop.stiffness,
            damping=_MARGIN * loop.damping,
            learning=_MARGIN * loop.learning,
        )
        if not counted.any():
            return False
        with np.errstate(over="ignore", invalid="ignore"):
            maps = [law.frame_map(each, *timing) for each in (loop, larger)]
        if not np.isfinite(maps).all():  # it grows beyond all numbers from one frame to the next
            return False
        multipliers, of_larger = np.linalg.eigvals(maps)
        if max(np.abs(multipliers).max(), np.abs(of_larger).max()) > 1.0 + _ROUND_OFF:
            return False
        lag = latency.of_position
        wanted = min(_DAMPED + _LATE * slow_rate(self.task, gains) * lag, _NEARLY * attainable)
        return self.damping_ratio(gains, multipliers, timing.frame, lag) >= wanted

    def damping_ratio(self, gains: Diagonals, multipliers: Array, dt: float, lag: float) -> float:
        """Return the damping ratio that nine of ten cases have, of multipliers (k, n) over dt [s].

        Of modes that are slower than what the lag of x makes, and no self-motion.
        """
        if not len(multipliers):
            return math.inf
        dead = multipliers == 0.0  # what is left of a delay
        poles = np.log(np.where(dead, 1e-300, multipliers).astype(complex)) / dt
        size, rate = np.abs(poles), slow_rate(self.task, gains)
        slow = (size > _STILL * rate) & (size < 2.3 / lag)
        ratios = np.where(slow, -poles.real / np.maximum(size, 1e-300), 1.0)
        return float(np.quantile(ratios.min(axis=1), 0.1))


def tuned(
    task: Task,
    latency: Latency | None = None,
    *,
    settling_time: float | None = None,
    regressor: GravityRegressor | None = None,
    gains: Gains | None = None,
    alpha: float | None = None,
    drives: Drives | None = None,
    payload: tuple[float, float] | None = None,
) -> Tuning:
    """Return gains, saturation and learning rates for fast and robust motion to targets.

    The rate r (settling time 4/r) minimizes the time for a usual distance, γ keeps motor torques
    and joint speeds within shares of their limits, and learning is a share π of the rate that
    inertia allows. The choice has to pass a check: the loop's sampled, delayed linearisation at
    twenty configurations, for arms lighter and heavier than believed and with an unmodelled tool,
    is stable with 1.5 times all of these, and in nine of ten cases its damping ratio is at least
    0.15 + 0.36 r times the lag of x, or nearly that of a loop without latency. Otherwise π is
    reduced, then r.

    Args:
        task: The task of the believed robot.
        latency: Latency of the loop; by default that of 1 kHz with ideal sensors.
        settling_time: Desired settling time [s]; 4/r by default. The check may make it longer.
        regressor: Regressor of the gravity to learn; None is no learning.
        gains: Given gains, for which only the learning rates are chosen.
        alpha: Given α [1/s].
        drives: Rotors and gears, as far as they are known. With them, or if q̇ or torques are late,
            K_v and B_c are at most what motors behind elastic gears stand (`motor_damping`) in 95 %
            of postures, r ≤ (K_v + K_b)/2Λ, and γ holds a tenth of the arm's weight.
        payload: Largest mass [kg] and length [m] of an object that is not in the model: γ holds its
            weight if motors do, and the tool of the check is as long. By default a tenth of the
            arm's mass where motors are counted, and 18 % of its reach.

    Raises:
        InvalidInputError: As `default_gains`.
    """
    latency = Latency() if latency is None else latency
    drives = None if drives is None else drives.of(task.robot)
    if payload is not None:
        mass, length = as_vector("payload", payload, 2).tolist()
        payload = as_size("mass of payload", mass, "kg"), as_size("length of payload", length)
    arm, m, nv = _Arm(task, regressor, latency, drives, payload), task.m, task.robot.nv
    rates, of_rate, why = _rates(arm, latency, settling_time, gains)
    for rate in rates:
        diagonals = of_rate(rate).diagonals(m, nv)
        share, learning, stable = arm.fastest(diagonals, latency, alpha)
        if stable:
            break
    gamma = arm.saturation(diagonals, latency)
    if rate < rates[0]:
        why += f"; slower by the check, {_SETTLED / rate:.3g} s"
    if arm.motors is not None:
        most = ", ".join(f"{each:.3g}" for each in arm.motors)
        why += f"; damping at most {most} N m s/rad, for motors behind elastic gears"
    if payload is not None:
        why += f"; for payloads up to {payload[0]:g} kg on {payload[1]:g} m"
    if not stable:
        why += "; no gains passed the check: x is too late, or Ĵ too far off"
    reasons = [why]
    if learning is not None:
        reasons.append(f"learns at {100.0 * share:.0f} % of what inertia allows")
    return Tuning(of_rate(rate), gamma, learning, latency, rate, share, stable, tuple(reasons))


def _rates(
    arm: _Arm, latency: Latency, settling_time: float | None, gains: Gains | None
) -> tuple[list[float], Callable[[float], Gains], str]:
    """Return rates to try, each slower than the one before, the gains of a rate, and why."""
    m, nv = arm.task.m, arm.robot.nv
    if gains is not None:
        rate = slow_rate(arm.task, gains.diagonals(m, nv))
        return [rate], lambda _: gains, f"settling time {_SETTLED / rate:.3g} s by given gains"

    require_controllable(arm.task)

    @functools.cache
    def of_rate(rate: float) -> Gains:
        fastest, unknown = 0.5 / latency.of_velocity, arm.heavy is not arm.postures
        return _gains_at(rate, arm.task, arm.postures, fastest, arm.motors, unknown)

    @functools.cache
    def time(rate: float) -> float:
        diagonals = of_rate(rate).diagonals(m, nv)
        return arm.time(arm.saturation(diagonals, latency), rate, slow_rate(arm.task, diagonals))

    if settling_time is None:
        most = min(_LAG / latency.of_position, arm.damped_rate(of_rate(_RATES[-1])))
        allowed = [rate for rate in _RATES if rate <= most] or [most]
        first = min(allowed, key=time)
        why = f"settling time {_SETTLED / first:.3g} s: a usual reach takes {time(first):.3g} s"
        if first == allowed[-1] != _RATES[-1]:
            why += f", as x is {1e3 * latency.of_position:.3g} ms late"
    else:
        first = _SETTLED / as_number("settling_time", settling_time, unit="s", above=_NO_TIME)
        why = f"settling time {settling_time:g} s as asked"
    # the same steps whatever is first, so that what is later is never faster
    step = math.floor(math.log(first / _RATES[-1]) / math.log(_SLOWER)) + 1
    slower = [_RATES[-1] * _SLOWER**k for k in range(step, step + _STEPS)]
    return [first, *slower], of_rate, why
