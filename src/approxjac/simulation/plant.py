"""The plant: the true robot, its friction, stops and servo, and the sensor that watches it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any, Literal, Self

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.errors import InvalidInputError
from approxjac.formatting import short, short_fields
from approxjac.interface import Measurement
from approxjac.law.factors import Factors
from approxjac.robots import Dynamics, Robot
from approxjac.robots.drives import Drives, Friction, usual_effort, usual_inertia
from approxjac.robots.dynamics import COULOMB_SPEED
from approxjac.robots.traced import motion_between, moved
from approxjac.simulation.sensing import Sensing, lost_entries
from approxjac.simulation.transmission import Motors, Transmission
from approxjac.tasks import PositionTask, Task
from approxjac.tasks.analysis import sees
from approxjac.validation import (
    Array,
    Immutable,
    as_delay,
    as_diagonal,
    as_limits,
    as_number,
    as_vector,
    changed_copy,
    require,
)

_DRAWN = 300  # configurations, to find one to start from
_INNER = 0.8  # share of each joint's range that they are drawn from
_HOLDABLE = 0.7  # of the effort limits
_SHORTEST = 1e-3  # lag of a servo; a run goes on in steps of at most that [s]
_RATE = 200.0  # natural frequency of a joint on its stop, critically damped [rad/s]
_PIVOTS = 1000
_LONGEST = 2e-3  # step of real joints [s]
_TINY = 1e-6  # of a step
_ENDLESS = (-math.inf, math.inf)
_GUESSES = 3  # which joints press on their stops, of symbols
_GIVES_WAY = 0.01  # at most under the whole torque of its motor [rad or m]

_TWO = np.array(2.0)

Acceleration = Callable[[Array, Array, Array], Array]
Motion = Callable[[Array, Array], Array]
Integrator = Callable[[Acceleration, Motion, Array, Array, Array, float], tuple[Array, Array]]


def rk4(
    acceleration: Acceleration, moved: Motion, q: Array, v: Array, tau: Array, dt: float
) -> tuple[Array, Array]:
    """Return (q, v) after dt [s] by the classical Runge–Kutta method, order 4.

    The acceleration may alias scratch memory; `moved(q, motion)` adds a motion (n_v,) to q (nq,).
    """
    # arrays, which NumPy multiplies with in less time than with numbers
    whole, half, sixth = np.array(dt), np.array(0.5 * dt), np.array(dt / 6.0)
    a1 = acceleration(q, v, tau).copy()
    v2 = v + half * a1
    a2 = acceleration(moved(q, half * v), v2, tau).copy()
    v3 = v + half * a2
    a3 = acceleration(moved(q, half * v2), v3, tau).copy()
    v4 = v + whole * a3
    a4 = acceleration(moved(q, whole * v3), v4, tau)
    q_new = moved(q, sixth * (v + _TWO * v2 + _TWO * v3 + v4))
    return q_new, v + sixth * (a1 + _TWO * a2 + _TWO * a3 + a4)


def semi_implicit_euler(
    acceleration: Acceleration, moved: Motion, q: Array, v: Array, tau: Array, dt: float
) -> tuple[Array, Array]:
    """Return (q, v) after dt [s]: velocity first, then position with it; order 1."""
    v_new = v + dt * acceleration(q, v, tau)
    return moved(q, dt * v_new), v_new


INTEGRATORS: Mapping[str, Integrator] = {"rk4": rk4, "semi_implicit_euler": semi_implicit_euler}


@dataclass(frozen=True, repr=False)
class VelocityServo:
    """The robot's own velocity loop, for a controller that commands q̇ instead of torques.

    It reads a command every `period`, acts on it `delay` later, and makes q̇ follow it with a
    first-order lag, lag · q̈ = q̇_cmd − q̇, by the torque

        τ = M(q)(q̇_cmd − q̇)/lag + C(q, q̇)q̇ + g(q) + friction

    of the true arm, clipped at `Plant.motor_limits`. Until the first command takes effect it holds
    the arm at rest. Keeping speed limits is up to the controller. Away from obstacles it also
    models a position-controlled robot that is sent ∫q̇_cmd dt.

    Attributes:
        lag: Time constant, ≥ 1 ms [s].
        delay: Time from reading a command to its effect [s].
        period: Time between commands that are read [s]; others are ignored.

    Raises:
        InvalidInputError: A number is negative, not finite or too small.
    """

    lag: float = 0.03
    delay: float = 0.008
    period: float = 0.008
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("lag", self.lag, unit="s", minimum=_SHORTEST)
        as_number("delay", self.delay, unit="s", minimum=0.0)
        as_number("period", self.period, unit="s", above=0.0)


class JointStops:
    """Stops at `Robot.position_limits`: torque p = max(0, kδ + dδ̇) for a joint δ > 0 beyond one.

    A stop pushes back and never pulls, so it never adds energy to T + ½kδ², T the kinetic energy.
    With the joint's usual inertia 1/mean (M⁻¹)_ii, k gives 200 rad/s, or more where the motor could
    press the joint further than 0.01 rad or m beyond the limit; d = 2k / 200 rad/s. A joint that
    hits its stop at v sinks in by about v/(e·200 rad/s), 2 mrad at 1 rad/s.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self._limits = robot, robot.position_limits
        # of each coordinate of q, infinite of continuous joints
        self.ends = [_ENDLESS] * robot.nq
        for name, low, high in zip(robot.joint_names, *self._limits, strict=True):
            joint = robot.model.joints[robot.model.getJointId(name)]
            self.ends[joint.idx_q] = float(low), float(high)

    @cached_property
    def stiffness(self) -> Array:
        """k, shape (n_v,) [N m/rad or N/m]."""
        effort = usual_effort(self._robot)
        return np.asarray(np.maximum(usual_inertia(self._robot) * _RATE**2, effort / _GIVES_WAY))

    @cached_property
    def damping(self) -> Array:
        """d, shape (n_v,) [N m s/rad or N s/m]."""
        return 2.0 / _RATE * self.stiffness

    def touched(self, q: Array) -> Any:
        """Return True if any joint is beyond its limits."""
        pairs = zip(q.tolist(), self.ends)  # noqa: B905
        if type(q) is not np.ndarray:  # symbols
            known = [(value, ends) for value, ends in pairs if ends != _ENDLESS]
            return law.any_of(law.array([(x < low) | (x > high) for x, (low, high) in known]))
        for value, (low, high) in pairs:  # noqa: SIM110 (it is quick)
            if value < low or value > high:  # one that is NaN is not
                return True
        return False

    def depth(self, q: Array) -> tuple[Array, Array]:
        """Return δ (−∞ without limits) and the side of the nearer limit, ±1; shape (n_v,) each."""
        motion = motion_between(self._robot, self._robot.neutral(), q)
        low, high = self._limits
        above, below = motion - high, low - motion
        return np.maximum(above, below), np.where(above > below, 1.0, -1.0)

    def torque(self, q: Array, v: Array) -> Array:
        """Return −p at upper limits and p at lower ones, shape (n_v,) [N m or N]."""
        depth, side = self.depth(q)
        push = self.stiffness * np.maximum(depth, 0.0) + self.damping * side * v
        return np.where(depth > 0.0, -side * np.maximum(push, 0.0), 0.0)

    def held_torque(self, q: Array, v: Array, M_inv: Array, dt: float) -> tuple[Array, Any]:
        """Return the stops' constant torque (n_v,) over a step dt [s] of semi-implicit Euler.

        p has δ and δ̇ of the end of the step (implicit Euler), so that no step adds energy. v is
        the velocity (n_v,) that the step would end with without stops. With symbols, which joints
        press on their stops is guessed; the second result is 1 where that went wrong, else 0.
        """
        depth, side = self.depth(q)
        # v outwards, what a unit of each push takes of that, (n_v, n_v), and p by δ̇
        v, slowed = side * v, dt * side[:, np.newaxis] * M_inv * side
        per_speed = self.stiffness * dt + self.damping
        if type(v) is not np.ndarray:
            push, wrong = self._guessed(depth, v, slowed, per_speed, dt)
            return -side * push, wrong
        push = np.zeros(len(v))
        touching = np.zeros(len(v), dtype=bool)
        while True:
            # what pushes one joint back may push another one beyond its limit
            reached = depth + dt * (v - slowed @ push) > 0.0
            if not (reached & ~touching).any():
                return -side * push, 0.0
            touching |= reached
            there = np.flatnonzero(touching)
            push[there] = _complementary(
                np.diag(1.0 / per_speed[there]) + slowed[np.ix_(there, there)],
                (self.stiffness * depth)[there] / per_speed[there] + v[there],
            )

    def _guessed(
        self, depth: Array, v: Array, slowed: Array, per_speed: Array, dt: float
    ) -> tuple[Array, Any]:
        """Return the pushes of `held_torque` by a few guesses, each from the last one."""
        b, nothing = self.stiffness / per_speed * depth + v, np.zeros(len(v))

        def guess(_: Any, values: tuple[Any, ...]) -> tuple[Any, ...]:
            # left is what is left of b without its own push
            push, left, touches, presses, _ = values
            touches = touches | (depth + dt * (v - slowed @ push) > 0.0)
            presses = touches & np.where(presses, push > 0.0, left > 0.0)
            A = np.where(presses[:, np.newaxis] & presses, slowed, 0.0)
            A = A + np.diag(np.where(presses, 1.0 / per_speed, 1.0))
            push = np.where(presses, Factors(A).solve(np.where(presses, b, 0.0)), 0.0)
            left = b - slowed @ push
            newly = ~touches & (depth + dt * (v - slowed @ push) > 0.0)
            wrong = newly | (presses & (push < 0.0)) | (touches & ~presses & (left > 0.0))
            return push, left, touches, presses, law.any_of(wrong)

        start = nothing, b, nothing < 0.0, nothing < 0.0, False
        push, *_, wrong = law.repeat(_GUESSES, guess, start)
        return push, law.select(wrong, 1.0, 0.0)


def _complementary(A: Array, b: Array) -> Array:
    """Return p ≥ 0 with Ap ≥ b, one of them an equality in each entry, by Murty's pivoting."""
    held = np.zeros(len(b), dtype=bool)
    rounding = 1e-12 * np.abs(b).max()
    for _ in range(_PIVOTS):  # without end where a diverging run makes rounding decide
        p = np.zeros(len(b))
        p[held] = np.linalg.solve(A[np.ix_(held, held)], b[held])
        wrong = np.where(held, p < 0.0, A @ p < b - rounding)
        if not wrong.any():
            return p
        held[wrong.argmax()] ^= True
    return np.maximum(p, 0.0)


class Plant(Immutable):
    """M(q) q̈ + C(q, q̇)q̇ + friction + g(q) = τ of the true robot, eq. (1).

    It gives measurements and takes torques, or velocities if it has a servo. Statements on
    eq. (1) hold strictly within the joint limits, where the joint stops have no effect. It owns
    scratch memory: one instance per thread.

    Args:
        robot: The true robot.
        sensor: Task of the true robot that measures X; by default the position of its tip,
            `PositionTask(robot)`.
        friction: A `robots.Friction`, or the viscous one alone: B ≥ 0, a number or shape (n_v,)
            [N m s/rad or N s/m]. Damping in the URDF is not used. Dry friction sticks in sampled
            runs; with a servo, or in continuous time, it is the smooth law of `Friction`.
        drives: Rotors, elastic gears and encoders of the joints, `robots.Drives`; by default
            rigid joints without rotors. Needs dt; steps beyond 2 ms are divided.
        sensing: Sensor errors, such as noise and delay; none by default. Needs dt in `simulate`.
        actuator_delay: Time from a command to its effect [s], beside that of a servo, rounded to
            whole samples, or beside a servo to whole steps of it; until the first one takes effect
            the robot is held. Needs dt.
        torque_limits: Largest motor torque, a number or shape (n_v,) [N m or N], at which commands
            are clipped; infinite is no limit. Nothing is clipped by default.
        joint_limits: True if the joints stop at `Robot.position_limits`, see `JointStops`. A
            sampled step that ends beyond a limit is one of semi-implicit Euler.
        servo: The robot's own velocity loop, for a controller that commands joint velocities:
            `simulation.VelocityServo`. None takes torques. Needs dt.
        adds_gravity: Robot whose g(q) the plant adds to each torque itself, as a Franka does for
            its arm without a tool; the motors deliver the sum. None adds none.

    Raises:
        InvalidInputError: A sensor of another robot, numbers that are negative or of the wrong
            shape, or `adds_gravity` with a servo, which has its own gravity torque.
    """

    def __init__(
        self,
        robot: Robot,
        sensor: Task | None = None,
        friction: float | Sequence[float] | Array | Friction = 0.0,
        *,
        sensing: Sensing | None = None,
        actuator_delay: float = 0.0,
        torque_limits: float | Sequence[float] | Array | None = None,
        joint_limits: bool = True,
        servo: VelocityServo | None = None,
        adds_gravity: Robot | None = None,
        drives: Drives | None = None,
    ) -> None:
        require("robot", robot, Robot, "the true Robot")
        sensor = PositionTask(robot) if sensor is None else sensor
        _require_own(robot, sensor)
        require("drives", drives, Drives | None, "Drives(...) or None")
        require("servo", servo, VelocityServo | None, "simulation.VelocityServo(...) or None")
        require("sensing", sensing, Sensing | None, "Sensing(...) or None")
        if sensing is not None:
            sensing.sizes(sensor)  # refuses wrong lengths, and parts that are not there
            lost_entries(sensing, sensor)
        nv = robot.nv
        self.robot, self.sensor, self.servo, self.sensing = robot, sensor, servo, sensing
        if not isinstance(friction, Friction):
            unit = "N m s/rad"
            friction = Friction(as_diagonal("friction", friction, nv, unit=unit, positive=False))
        rubs = friction.of(nv)
        self.friction, self.coulomb = np.asarray(rubs.viscous), np.asarray(rubs.coulomb)
        self.transmission = Transmission(robot, rubs, (drives or Drives()).of(robot))
        self.drives = self.transmission.drives
        if servo is not None and self.transmission.moves:
            message = "drives must be None beside a servo, whose loop is around rigid joints"
            raise InvalidInputError(f"{message}, got {drives!r}", given=drives)
        self.actuator_delay = as_delay("actuator_delay", actuator_delay)
        self.adds_gravity = adds_gravity
        self._added = None if adds_gravity is None else _added(adds_gravity, robot, servo)
        if torque_limits is not None:
            torque_limits = as_limits("torque_limits", torque_limits, nv, unit="N m or N")
        self.torque_limits = torque_limits
        require("joint_limits", joint_limits, bool, "True or False")
        self.joint_limits = joint_limits
        self._has_coulomb = max(self.coulomb.tolist()) > 0.0
        self._has_friction = self._has_coulomb or max(self.friction.tolist()) > 0.0
        # a servo compensates friction, so that it does not stick
        self.is_ideal = self.transmission.is_ideal or servo is not None
        self._is_vector = robot.nq == robot.nv  # a motion is then added to a configuration

    def _of(self, robot: Robot, sensor: Task) -> Self:
        """Return this plant of another robot with the same joints, in a fifth of the time."""
        _require_own(robot, sensor)
        _ = self.stops  # those of the arm, whatever it holds
        plant = self._with(robot=robot, sensor=sensor)
        vars(plant).pop("dynamics", None)
        return plant

    def _sensed(self, sensing: Sensing | None, actuator_delay: float) -> Self:
        """Return this plant with other sensing and lateness; itself where there are none."""
        if sensing is None and actuator_delay == 0.0:
            return self
        return self._with(sensing=sensing, actuator_delay=actuator_delay)

    def _with(self, **changes: Any) -> Self:
        return changed_copy(self, **changes, _changes={**self._changes, **changes})

    @property
    def command(self) -> Literal["torque", "velocity"]:
        """Kind of command that it takes."""
        return "torque" if self.servo is None else "velocity"

    @property
    def motor_limits(self) -> Array:
        """Largest motor torques, shape (n_v,) [N m or N]."""
        return self.robot.effort_limits if self.torque_limits is None else self.torque_limits

    @cached_property
    def stops(self) -> JointStops | None:
        """The joint stops, or None."""
        return JointStops(self.robot) if self.joint_limits else None

    @cached_property
    def dynamics(self) -> Dynamics:
        """M, C and g of the true robot."""
        return Dynamics(self.robot)

    def ready_configuration(self) -> Array:
        """Return the default start configuration (nq,) of `simulate`; the same each time.

        It has the largest σ_min of the sensor's Jacobian among 300 random ones in the middle of
        `Robot.usual_range` in which the sensor sees x, the motors hold the arm with ease and
        nothing is in contact. Raises an InvalidInputError if there is none.
        """
        robot, sensor, rng = self.robot, self.sensor, np.random.default_rng(0)
        effort = np.minimum(robot.effort_limits, self.motor_limits)
        low, high = robot.usual_range
        middle, half = 0.5 * (low + high), 0.5 * _INNER * (high - low)
        motions = (middle + half * rng.uniform(-1.0, 1.0, robot.nv) for _ in range(_DRAWN))
        drawn = (np.array(pin.integrate(robot.model, robot.neutral(), each)) for each in motions)
        usable = [
            q
            for q in drawn
            if sees(sensor, q) and holdable(self.dynamics, q, effort) and self._is_free(q)
        ]
        if not usable:
            raise InvalidInputError(
                f"q0 must be given for {robot.name}: no configuration was found that its motors "
                f"can hold and that {sensor!r} sees; a lighter object may help",
                given=None,
            )
        return max(usable, key=lambda q: np.linalg.norm(sensor.jacobian(q, sensor.value(q)), -2))

    def _is_free(self, q: Array) -> bool:
        return True

    @property
    def needs_sampling(self) -> bool:
        """Return True if measurements or commands are late, which needs sampled control."""
        late = self.sensing is not None or self.actuator_delay > 0.0
        return late or self.servo is not None

    def require_ideal(self, what: str, *, late: bool = False) -> None:
        """Raise an InvalidInputError if the plant has more than eq. (1) and joint stops.

        `late` allows delays and a filter of q̇.
        """
        sensing, rough = self.sensing, self.needs_sampling
        if late:
            rough = self.servo is not None or (sensing is not None and not sensing.is_linear)
        more = self.torque_limits is not None or self.adds_gravity is not None
        if rough or more or not self.transmission.is_ideal:
            but = ", but for delays and velocity_filter" if late else ""
            raise InvalidInputError(
                f"{what} is for a plant without dry friction, drives, torque limits, gravity that "
                f"it adds, servo, errors or delays of sensing and of actuators{but}, got {self!r}",
                given=self,
            )

    def require_task(self, task: Task) -> None:
        """Raise an InvalidInputError if a task's errors are not in the sensor's coordinates."""
        self._require_same(task, self.sensor, task)
        origin = self.sensor.origin
        for unit in np.eye(task.m):
            x = self.sensor.displaced(origin, unit)
            ours, theirs = self.sensor.error(x, origin), task.error(x, origin)
            if not np.allclose(ours, theirs, rtol=1e-6, atol=1e-6):
                raise InvalidInputError(
                    f"the controller's task must combine its coordinates as the plant's sensor "
                    f"{self.sensor!r} does, got {task!r}",
                    given=task,
                )

    def require_measured(self, task: Task) -> None:
        """Raise an InvalidInputError if a task is for another x than the sensor measures."""
        self._require_same(task, self.sensor.measured, task.measured)

    def _require_same(self, task: Task, sensor: Task, wanted: Task) -> None:
        if self.robot.nv != task.robot.nv:
            raise InvalidInputError(
                f"the controller's robot must have the {self.robot.nv} joints of the plant's, "
                f"{self.robot.name}, got {task.robot.name} with {task.robot.nv}",
                given=task,
            )
        if sensor.labels != wanted.labels or sensor.n_x != wanted.n_x:
            raise InvalidInputError(
                f"the controller's task must have the coordinates of the plant's sensor "
                f"{self.sensor!r}, got {task!r}; Plant(robot, sensor=...) takes such a task of "
                "the true robot",
                given=task,
            )

    def acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        """Return q̈ under a torque, with the smooth law of friction, shape (n_v,) [rad/s² or m/s²].

        Raises an InvalidInputError for a plant with drives, whose motors move on their own.
        """
        if self.is_stepped:
            message = f"acceleration is for a plant without drives, got {self!r}"
            raise InvalidInputError(message, given=self)
        nv = self.robot.nv
        q, v = self.robot.configuration(q), as_vector("v", v, nv)
        tau = self._delivered(q, as_vector("tau", tau, nv))
        if self.stops is not None and self.stops.touched(q):
            tau = tau + self.stops.torque(q, v)
        return self._acceleration(q, v, tau).copy()

    def advance(
        self,
        q: Array,
        v: Array,
        tau: Array,
        dt: float,
        integrate: Integrator,
        motors: Motors | None = None,
    ) -> tuple[Array, Array, Motors | None]:
        """Return (q, v, motors) after dt [s] under a constant command; arguments are not checked.

        `motors` is that of the step before, at first of `motors_at`; None of ideal joints. It runs
        on symbols, too, and leaves the step where the torque of stops is not found.
        """
        if not self.is_ideal:
            motors = motors or self.transmission.at_rest(self.dynamics.g(q))
            tau, (count, h) = self._delivered(q, tau), self.substeps(dt)
            for _ in range(count):
                q, v, motors = self._transmitted(q, v, motors, tau, h)
            return q, v, motors
        accelerate: Acceleration = self._driven
        if self.servo is None:
            accelerate, tau = self._acceleration, self._delivered(q, tau)
        stops, end = self.stops, (*integrate(accelerate, self._moved, q, v, tau, dt), 0.0)
        if stops is None or (touched := stops.touched(end[0])) is False:
            return *end[:2], None

        def stopped() -> tuple[Array, Array, Any]:
            free = v + dt * accelerate(q, v, tau)
            M_inv = self.dynamics.M_inv(q)
            push, wrong = stops.held_torque(q, free, M_inv, dt)
            v_end = free + dt * M_inv @ push
            return self._moved(q, dt * v_end), v_end, wrong

        q_end, v_end, wrong = law.choose(touched, stopped, lambda: end)
        law.leave(wrong > 0.0)
        return q_end, v_end, None

    @property
    def is_stepped(self) -> bool:
        """True if it has no acceleration by q, q̇ and τ alone."""
        return self.transmission.moves

    def substeps(self, dt: float) -> tuple[int, float]:
        """Return number and length [s] of the steps of joints that are not ideal, within dt."""
        count = max(1, math.ceil(dt / _LONGEST - _TINY))
        return count, dt / count

    def motors_at(self, q: Array) -> Motors | None:
        """Return the motors of the arm held at rest; None of ideal joints."""
        return None if self.is_ideal else self.transmission.at_rest(self.dynamics.g(q))

    def _transmitted(
        self, q: Array, v: Array, motors: Motors, tau: Array, h: float
    ) -> tuple[Array, Array, Motors]:
        """Return (q, v, motors) after a step h [s] of `Transmission`, at stops, too."""
        mid, dynamics, angle = self._moved(q, 0.5 * h * v), self.dynamics, None
        if np.any(self.drives.ripple):
            angle = motion_between(self.robot, self.robot.neutral(), q)
        ahead = v + 0.5 * motors.change
        terms = dynamics.M(mid), dynamics.inverse(mid, ahead, np.zeros(self.robot.nv))
        after = self.transmission.step(v, motors, tau, h, terms, angle)
        stops, twist, held = self.stops, after.motors.twist, after.motors.held
        end = self._moved(mid, 0.5 * h * after.v), after.v, *after.motors[1::2], 0.0
        if stops is None or (touched := stops.touched(end[0])) is False:
            return *end[:2], after.motors

        def stopped() -> tuple[Any, ...]:
            push, wrong = stops.held_torque(q, after.v, after.M_inv, h)
            v_end, motors, _ = self.transmission.pushed(after, h * push)
            return self._moved(q, h * v_end), v_end, *motors[1::2], wrong

        q_end, v_end, rate, change, wrong = law.choose(touched, stopped, lambda: end)
        law.leave(wrong > 0.0)
        return q_end, v_end, Motors(twist, rate, held, change)

    def encoded(self, truth: Measurement, motors: Motors | None) -> Measurement:
        """Return a measurement with q and q̇ of the motors, where the encoders are there."""
        if motors is None or not self.transmission.is_elastic or self.drives.encoders == "joint":
            return truth
        return truth._replace(q=moved(self.robot, truth.q, motors.twist), v=motors.rate)

    def _moved(self, q: Array, motion: Array) -> Array:
        return q + motion if self._is_vector else moved(self.robot, q, motion)

    def holding_torque(self, q: Array) -> Array:
        """Return the torque to send to hold the arm at rest, shape (n_v,) [N m or N]."""
        g = self.dynamics.g(q)
        return g if self._added is None else g - self._added.g(q)

    def _delivered(self, q: Array, tau: Array) -> Array:
        if self._added is not None:
            tau = tau + self._added.g(q)
        if self.torque_limits is None:
            return tau
        return np.minimum(np.maximum(tau, -self.torque_limits), self.torque_limits)

    def _acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        if self._has_friction:
            tau = tau - self.friction_torque(v)
        return self._forward(q, v, tau)

    def friction_torque(self, v: Array) -> Array:
        """Return the smooth law Bq̇ + F_c tanh(q̇/v_c), v_c = 0.05 rad/s or m/s; shape (n_v,)."""
        viscous: Array = self.friction * v
        if not self._has_coulomb:
            return viscous
        return viscous + self.coulomb * np.tanh(v / COULOMB_SPEED)

    def applied(self, q: Array, v: Array, command: Array) -> Array:
        """Return a torque command itself, or the servo's torque for a velocity; shape (n_v,)."""
        if self.servo is None:
            return command
        a = (command - v) / self.servo.lag
        tau = self.dynamics.inverse(q, v, a)
        if self._has_friction:
            tau += self.friction_torque(v)
        limits = self.motor_limits
        return np.asarray(np.minimum(np.maximum(tau, -limits), limits))

    def _driven(self, q: Array, v: Array, command: Array) -> Array:
        return self._acceleration(q, v, self.applied(q, v, command))

    def _forward(self, q: Array, v: Array, tau: Array) -> Array:
        return self.dynamics.forward(q, v, tau)

    @property
    def is_exact(self) -> bool:
        """True if its sensors are ideal: then a guard has nothing to do, and rests."""
        return self.sensing is None and type(self).measure is Plant.measure

    def measure(self, t: float, q: Array, v: Array) -> Measurement:
        """Return the measurement of ideal sensors at t [s]; x is NaN where it is not seen."""
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        return Measurement(t, q, v, self.sensor.visible(self.sensor.value(q)), t)

    def __repr__(self) -> str:
        shown = [repr(self.robot.name), repr(self.sensor)]
        usual = {**signature(Plant).parameters, **signature(type(self)).parameters}
        for name, value in self._arguments.items():
            if name not in ("robot", "sensor") and repr(value) != repr(usual[name].default):
                are_numbers = isinstance(value, float | list | np.ndarray)
                shown.append(f"{name}={short(value) if are_numbers else repr(value)}")
        return f"{type(self).__name__}({', '.join(shown)})"


def _require_own(robot: Robot, sensor: Task) -> None:
    require("sensor", sensor, Task, "a task of the true robot, such as PositionTask(robot)")
    if sensor.robot != robot:
        raise InvalidInputError(
            f"sensor must be a task of the plant's own robot, the true one, such as "
            f"PositionTask(truth), got {sensor!r} of another (the believed one?)",
            given=sensor,
        )


def _added(other: Robot, robot: Robot, servo: VelocityServo | None) -> Dynamics:
    require("adds_gravity", other, Robot, "the Robot whose gravity it adds, or None")
    if other.joint_names != robot.joint_names or other.nq != robot.nq or servo is not None:
        raise InvalidInputError(
            f"adds_gravity must be of a robot with the joints of {robot.name}, and without a "
            f"servo, got {other.name} with {', '.join(other.joint_names)} and servo={servo!r}",
            given=other,
        )
    return Dynamics(other)


def holdable(dynamics: Dynamics, q: Array, effort: Array) -> bool:
    """Return True if holding a configuration takes at most 70 % of the effort limits."""
    return not (np.abs(dynamics.g(q)) > _HOLDABLE * effort).any()
