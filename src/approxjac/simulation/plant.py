"""The plant: the true robot, its friction and the sensor that watches it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.formatting import short
from approxjac.interface import Measurement
from approxjac.robots import Dynamics, Robot
from approxjac.robots.model import WORLD
from approxjac.simulation.integrators import Acceleration, Integrator
from approxjac.simulation.joint_stops import JointStops
from approxjac.simulation.sensing import Sensing, SensorReadings
from approxjac.simulation.velocity_servo import VelocityServo
from approxjac.tasks import PositionTask, Task
from approxjac.tasks.analysis import sees
from approxjac.validation import (
    Array,
    Immutable,
    as_diagonal,
    as_limits,
    as_number,
    as_vector,
    require,
)

_DRAWN = 300  # configurations, to find one to start from
_INNER = 0.8  # share of each joint's range that they are drawn from
_HOLDABLE = 0.7  # of the effort limits


class Plant(Immutable):
    """M(q) q̈ + C(q, q̇)q̇ + B q̇ + τ_c tanh(q̇/v_c) + g(q) = τ of the true robot, eq. (1).

    It yields measurements and takes torques, or velocities if it has a servo; nothing else of it
    reaches a controller. The
    direction of gravity is the robot's: see `Robot.with_gravity`. The term with τ_c is Coulomb
    friction, which eq. (1) does not have. Nor has it joint stops: what is claimed of eq. (1) is
    claimed of arms strictly within their joint limits, where stops do nothing.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The true robot.
        sensor: What measures X: a task of the true robot; by default the position of its tip,
            `PositionTask(robot)`.
        friction: Natural viscous friction B ≥ 0, a number or shape (n_v,) [N m s/rad or N s/m].
            Damping that the URDF mentions is not used.
        coulomb: Coulomb friction τ_c ≥ 0, a number or shape (n_v,) [N m or N].
        coulomb_velocity: v_c > 0 within which it passes from −τ_c to τ_c [rad/s or m/s]. So that
            joints creep rather than stick; a τ_c dt much above M v_c makes a sampled run unstable.
        sensing: How measurements differ from the truth; not at all by default. Needs dt.
        actuator_delay: Time from a torque to its effect [s], rounded to whole samples; until the
            first one takes effect the robot is held by g(q). Needs dt.
        torque_limits: What the motors deliver at most, a number or shape (n_v,) [N m or N]; more
            is clipped, infinite is no limit. Nothing is clipped by default.
        joint_limits: Whether the joints stop at `Robot.position_limits`, as `JointStops` says. A
            sampled step that ends beyond a limit is one of semi-implicit Euler.
        servo: The robot's own loop, for a controller that commands velocities of the joints:
            `simulation.VelocityServo`. None takes torques. Needs dt.
        adds_gravity: The robot whose g(q) it adds to each torque by itself, such as that of a
            Franka without a tool; the motors deliver the sum. None adds none.

    Raises:
        InvalidInputError: A sensor on another robot, numbers that are negative or of the wrong
            shape, or an actuator delay or own gravity beside a servo, which has its own.
    """

    def __init__(
        self,
        robot: Robot,
        sensor: Task | None = None,
        friction: float | Sequence[float] | Array = 0.0,
        *,
        coulomb: float | Sequence[float] | Array = 0.0,
        coulomb_velocity: float = 0.05,
        sensing: Sensing | None = None,
        actuator_delay: float = 0.0,
        torque_limits: float | Sequence[float] | Array | None = None,
        joint_limits: bool = True,
        servo: VelocityServo | None = None,
        adds_gravity: Robot | None = None,
    ) -> None:
        self._remember(locals())
        require("robot", robot, Robot, "the true Robot")
        sensor = PositionTask(robot) if sensor is None else sensor
        _require_own(robot, sensor)
        if servo is not None:
            require("servo", servo, VelocityServo, "simulation.VelocityServo(...) or None")
        if sensing is not None:
            require("sensing", sensing, Sensing, "Sensing(...) or None")
            SensorReadings(sensing, sensor, dt=1.0, seed=0)  # refuses wrong lengths
        nv = robot.nv
        self.robot = robot
        self.sensor = sensor
        self.friction = as_diagonal("friction", friction, nv, unit="N m s/rad", positive=False)
        self.coulomb = as_diagonal("coulomb", coulomb, nv, unit="N m", positive=False)
        self.coulomb_velocity = as_number("coulomb_velocity", coulomb_velocity, above=0.0)
        self.servo = servo
        self.sensing = sensing if servo is None else servo.sensed(sensing)
        self.actuator_delay = as_number("actuator_delay", actuator_delay, unit="s", minimum=0.0)
        if servo is not None and self.actuator_delay > 0.0:
            raise InvalidInputError(
                f"actuator_delay must be 0 where there is a servo, whose delay is its own, got "
                f"{self.actuator_delay:g} beside {servo!r}",
                given=actuator_delay,
            )
        self.adds_gravity = adds_gravity
        self._added = None if adds_gravity is None else _added(adds_gravity, robot, servo)
        if torque_limits is not None:
            torque_limits = as_limits("torque_limits", torque_limits, nv, unit="N m or N")
        self.torque_limits = torque_limits
        require("joint_limits", joint_limits, bool, "True or False")
        self.joint_limits = joint_limits
        self._has_coulomb = max(self.coulomb.tolist()) > 0.0
        self._has_friction = self._has_coulomb or max(self.friction.tolist()) > 0.0
        self._is_vector = robot.nq == robot.nv  # a motion is then added to a configuration

    def _of(self, robot: Robot, sensor: Task) -> Self:
        """Return this plant of another robot with the same joints, in a fifth of the time."""
        _require_own(robot, sensor)
        _ = self.stops  # those of the arm, whatever it holds
        plant, arguments = object.__new__(type(self)), {"robot": robot, "sensor": sensor}
        vars(plant).update(vars(self), **arguments, _arguments=self._arguments | arguments)
        for name in ("dynamics", "_data"):
            vars(plant).pop(name, None)
        return plant

    def _sensed(self, sensing: Sensing | None, actuator_delay: float) -> Self:
        """Return this plant with sensing and lateness that were checked, without building it."""
        if sensing is None and actuator_delay == 0.0:
            return self
        changed: dict[str, Any] = {"sensing": sensing, "actuator_delay": actuator_delay}
        plant = object.__new__(type(self))
        vars(plant).update(vars(self), **changed, _arguments=self._arguments | changed)
        return plant

    @property
    def command(self) -> Literal["torque", "velocity"]:
        """Return "torque" or "velocity"."""
        return "torque" if self.servo is None else "velocity"

    @property
    def motor_limits(self) -> Array:
        """Torques that the motors deliver at most, shape (n_v,) [N m or N]."""
        return self.robot.effort_limits if self.torque_limits is None else self.torque_limits

    @cached_property
    def stops(self) -> JointStops | None:
        """The stops of its joints, or None."""
        return JointStops(self.robot) if self.joint_limits else None

    @cached_property
    def dynamics(self) -> Dynamics:
        """M, C and g of the true robot."""
        return Dynamics(self.robot)

    @cached_property
    def _data(self) -> pin.Data:
        return self.robot.model.createData()

    def ready_configuration(self) -> Array:
        """Return a configuration to start from, the same each time, as `simulate` does by default.

        Of 300 seeded configurations in the middle 80 % of each joint's range
        (`Robot.usual_range`), the one farthest from singular, with the largest σ_min of the
        sensor's Jacobian; among those that the sensor sees, that the motors hold with at most 70 %
        of their limits, and in which the arm touches nothing.

        Returns:
            Shape (nq,).

        Raises:
            InvalidInputError: There is none.
        """
        robot, sensor, rng = self.robot, self.sensor, np.random.default_rng(0)
        effort = np.minimum(robot.effort_limits, self.motor_limits)
        low, high = robot.usual_range()
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
        """Return True where the arm touches nothing."""
        return True

    @property
    def needs_sampling(self) -> bool:
        """Return True if measurements or commands are late, which needs sampled control."""
        late = self.sensing is not None or self.actuator_delay > 0.0
        return late or self.servo is not None

    def require_ideal(self, what: str) -> None:
        """Raise an InvalidInputError if there is more than eq. (1) and joint stops."""
        unknown = self.torque_limits is not None or self.adds_gravity is not None
        if self.coulomb.any() or self.needs_sampling or unknown:
            raise InvalidInputError(
                f"{what} is for a plant without Coulomb friction, sensing, actuator delay, "
                f"torque limits, gravity that it adds and servo, got {self!r}",
                given=self,
            )

    def require_linear(self, what: str) -> None:
        """Raise an InvalidInputError if no linearisation has it; delays, a filter of q̇ it has."""
        rough = self.sensing is not None and not self.sensing.is_linear
        rough = rough or self.servo is not None or self.adds_gravity is not None
        if self.coulomb.any() or rough or self.torque_limits is not None:
            raise InvalidInputError(
                f"{what} is for a plant without Coulomb friction, torque limits, gravity that it "
                f"adds, servo, x_rate, x_lost, x_frozen, noise, rounding and dropouts (delays and "
                f"velocity_filter may be there), got {self!r}",
                given=self,
            )

    def require_task(self, task: Task) -> None:
        """Raise an InvalidInputError if a task's errors are not in the sensor's coordinates."""
        self._require_same(task, self.sensor, task)
        origin = self.sensor._origin
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
        """Raise an InvalidInputError if a task takes another x than the sensor measures."""
        self._require_same(task, self.sensor._measured, task._measured)

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
        """Return q̈ under a torque, shape (n_v,) [rad/s² or m/s²]."""
        nv = self.robot.nv
        q, v = self.robot.configuration(q), as_vector("v", v, nv)
        tau = self._delivered(q, as_vector("tau", tau, nv))
        if self.stops is not None and self.stops.touched(q):
            tau = tau + self.stops.torque(q, v)
        return self._acceleration(q, v, tau).copy()

    def advance(
        self, q: Array, v: Array, tau: Array, dt: float, integrate: Integrator
    ) -> tuple[Array, Array]:
        """Return (q, v) after dt [s] under a torque, or a command of the servo, that is held.

        Its arguments are not checked: a loop that calls it checks what comes out, once a step.
        """
        accelerate: Acceleration = self._driven
        if self.servo is None:
            accelerate, tau = self._acceleration, self._delivered(q, tau)
        q_end, v_end = integrate(accelerate, self._moved, q, v, tau, dt)
        if self.stops is None or not self.stops.touched(q_end):
            return q_end, v_end
        free = v + dt * accelerate(q, v, tau)
        M_inv = self.dynamics.M_inv(q)
        v_end = free + dt * M_inv @ self.stops.held_torque(q, free, M_inv, dt)
        return self._moved(q, dt * v_end), v_end

    def _moved(self, q: Array, motion: Array) -> Array:
        """Return the configuration after a motion (n_v,) from q (nq,)."""
        if self._is_vector:
            return q + motion
        return np.asarray(pin.integrate(self.robot.model, q, motion))

    def holding_torque(self, q: Array) -> Array:
        """Return the torque to send so that it stands, shape (n_v,) [N m or N]."""
        g = self.dynamics.g(q)
        return g if self._added is None else g - self._added.g(q)

    def _delivered(self, q: Array, tau: Array) -> Array:
        """Return the motors' torque for a command, with the gravity that the robot adds."""
        if self._added is not None:
            tau = tau + self._added.g(q)
        if self.torque_limits is None:
            return tau
        return np.minimum(np.maximum(tau, -self.torque_limits), self.torque_limits)

    def _acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        """Return q̈ under a torque that the motors deliver, for arguments that are checked."""
        if self._has_friction:
            tau = tau - self.friction_torque(v)
        return self._forward(q, v, tau)

    def friction_torque(self, v: Array) -> Array:
        """Return Bq̇ + τ_c tanh(q̇/v_c), shape (n_v,)."""
        viscous: Array = self.friction * v
        if not self._has_coulomb:
            return viscous
        return viscous + self.coulomb * np.tanh(v / self.coulomb_velocity)

    def applied(self, q: Array, v: Array, command: Array) -> Array:
        """Return the torque for a command: itself, or that of the servo for a velocity, (n_v,)."""
        if self.servo is None:
            return command
        a = (command - v) / self.servo.lag
        tau: Array = np.array(pin.rnea(self.robot.model, self._data, q, v, a))
        if self._has_friction:
            tau += self.friction_torque(v)
        limits = self.motor_limits
        return np.asarray(np.minimum(np.maximum(tau, -limits), limits))

    def _driven(self, q: Array, v: Array, command: Array) -> Array:
        """Return q̈ under a command of the servo, for arguments that are checked."""
        return self._acceleration(q, v, self.applied(q, v, command))

    def _forward(self, q: Array, v: Array, tau: Array) -> Array:
        """Return q̈ under a torque at the joints, for arguments that are checked."""
        if self.robot.mimic_joints.G is not None:
            return self.dynamics.forward(q, v, tau)
        return np.asarray(pin.aba(self.robot.model, self._data, q, v, tau, WORLD))

    def measure(self, t: float, q: Array, v: Array) -> Measurement:
        """Return the measurement of ideal sensors at t [s]; NaN for what the sensor cannot see."""
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        return Measurement(t, q, v, self.sensor._seen(self.sensor.value(q)), t)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._shown())})"

    def _shown(self) -> list[str]:
        """Return the robot, the sensor, and what differs from an ideal plant."""
        shown = [repr(self.robot.name), repr(self.sensor)]
        if self.friction.any():
            shown.append(f"friction={short(self.friction)}")
        if self.coulomb.any():
            shown.append(f"coulomb={short(self.coulomb)}")
        if self.sensing is not None:
            shown.append(repr(self.sensing))
        if self.actuator_delay > 0.0:
            shown.append(f"actuator_delay={self.actuator_delay:g}")
        if self.torque_limits is not None:
            shown.append(f"torque_limits={short(self.torque_limits)}")
        if not self.joint_limits:
            shown.append("joint_limits=False")
        if self.servo is not None:
            shown.append(repr(self.servo))
        if self.adds_gravity is not None:
            shown.append(f"adds_gravity={self.adds_gravity.name!r}")
        return shown


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
    """Return True where holding a configuration takes at most 70 % of the effort limits."""
    return not (np.abs(dynamics.g(q)) > _HOLDABLE * effort).any()
