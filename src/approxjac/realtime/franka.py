"""`FrankaDriver`: a Franka FR3 by its makers' own client, pylibfranka."""

import ctypes
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np

from approxjac.controllers import Limits
from approxjac.errors import DriverError, InvalidInputError, package_of
from approxjac.interface import Measurement
from approxjac.robots import Dynamics, Robot
from approxjac.validation import Array, as_limits, require

_DT = 1e-3  # [s]
_LOW = np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196])
_HIGH = np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196])
_EFFORT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
_SPEED = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
# The robot takes 1000 N m/s, 10 rad/s² and 5000 rad/s³. It may have got a command late that counts
# as lost for its state: what is sent next then differs from it by two or three times these.
_TORQUE_RATE, _ACCELERATION, _JERK = 500.0, 7.0, 1000.0
# Speed at a distance d from a joint's end: √(2ad) less an offset, from the arm's URDF. There a is
# 17 of joints 5 and 7, more than commands may brake with. Speeds lag by a · _ACCELERATION / _JERK.
_BRAKING = np.array([6.0, 2.585, 3.5, 4.0, 6.0, 5.5, 6.0])
_OFFSET = np.array([0.3, 0.2, 0.2, 0.3, 0.35, 0.35, 0.35]) + _BRAKING * _ACCELERATION / _JERK
_INSIDE = 1e-3  # rad/s within these speeds, for what is lost in rounding

Sensor = Callable[[float, Array], "Array | tuple[Array, float]"]


class FrankaDriver:
    """A Franka FR3, by its makers' client and network protocol, at 1 kHz.

    The robot adds the gravity torque of its own model to commanded torques. Control begins with the
    first command; until then, and after `brake`, the robot holds itself.

    Commands are clipped safely below the robot's limits: torques to its efforts and 500 N m/s from
    the last one, velocities to 7 rad/s², 1000 rad/s³ and its speeds near joint ends. Any other
    limit that is exceeded causes a reflex, the robot's own stop: see `recover`.

    Args:
        address: Address of the robot's control unit.
        sensor: Function of the robot's time t [s] and q, shape (7,), that returns x, or x and the
            time t_x [s] at which it was taken; NaN where there is none. It is called once a period
            and must not wait.
        command: "torque", or "velocity" for a controller that commands velocities.
        gravity: The robot's own model, whose gravity torque is subtracted from commands: for
            controllers that compensate all gravity, such as the tracking law. None sends torques
            unchanged, for controllers that leave gravity to the robot.
        collision: Joint torques, and forces on the tip, above which a contact causes a reflex: a
            number or shape (7,) [N m], and a number or shape (6,) [N, N m]. None keeps the
            robot's setting.
        realtime: True to require a real-time kernel and priority, as a robot should have.

    Raises:
        DriverError: No connection, or the robot refuses.
        MissingPackageError: pylibfranka is not installed.
        InvalidInputError: An invalid argument.
    """

    dt: float = _DT

    def __init__(
        self,
        address: str,
        sensor: Sensor,
        *,
        command: Literal["torque", "velocity"] = "torque",
        gravity: Robot | None = None,
        collision: tuple[float | Sequence[float] | Array, float | Sequence[float] | Array]
        | None = None,
        realtime: bool = True,
    ) -> None:
        require("address", address, str, "a name or an IP address")
        require("sensor", sensor, Callable, "a function of t and q that returns x")
        if command not in ("torque", "velocity"):
            message = f'command must be "torque" or "velocity", got {command!r}'
            raise InvalidInputError(message, given=command)
        self.command: Literal["torque", "velocity"] = command
        require("gravity", gravity, Robot | None, "a Robot, such as the arm without its tool")
        self.adds_gravity = gravity is None
        self._gravity = None if gravity is None else Dynamics(gravity)
        self.limits = Limits(
            effort=_EFFORT,
            rate=_TORQUE_RATE if command == "torque" else None,
            position=(_LOW, _HIGH),
            velocity=_SPEED,
        )
        self._sensor = sensor
        self._franka: Any = package_of("franka", "pylibfranka")
        self._errors = (RuntimeError, ValueError, self._franka.FrankaException)
        self._lock, self._braked = threading.Lock(), False
        self._robot: Any
        self._state: Any  # that was read last
        self._control: Any = None  # what commands go to, while the robot takes some
        config = self._franka.RealtimeConfig
        self._address = address, config.kEnforce if realtime else config.kIgnore
        self._collision: tuple[list[float], ...] = ()
        if collision is not None:
            torques = as_limits("collision[0]", collision[0], 7, unit="N m").tolist()
            forces = as_limits("collision[1]", collision[1], 6, unit="N, N m").tolist()
            self._collision = torques, torques, forces, forces
        self._connect()

    def read(self) -> Measurement:
        """Wait for the state of the next period and return it, with the sensor's x.

        Raises:
            DriverError: A reflex, `brake` from another thread, or a lost connection, noticed after
                at most 1 s, during which no other Python thread runs.
        """
        control = self._control
        with self._named("read"):
            state = self._robot.read_once() if control is None else control.readOnce()[0]
        self._state = state
        t, q = state.time.to_sec(), np.array(state.q)
        x = self._sensor(t, q)
        x, t_x = x if isinstance(x, tuple) else (x, None)
        return Measurement(t, q, np.array(state.dq), x, t_x)

    def send(self, command: Array) -> None:
        """Send torques [N m] or velocities [rad/s], shape (7,); the first call starts control.

        Raises:
            DriverError: The robot refuses them, or it was braked.
        """
        with self._lock:
            if self._braked:
                message = "cannot send: the robot was braked; recover() lets it take commands again"
                raise DriverError(message, given=command)
            is_torque = self.command == "torque"
            with self._named("send"):
                if self._control is None and is_torque:
                    self._control = self._robot.start_torque_control()
                elif self._control is None:
                    impedance = self._franka.ControllerMode.JointImpedance
                    self._control = self._robot.start_joint_velocity_control(impedance)
                if is_torque:
                    if self._gravity is not None:
                        command = command - self._gravity.g(np.array(self._state.q))
                    before, change = np.array(self._state.tau_J_d), _TORQUE_RATE * _DT
                    within = np.clip(
                        np.clip(command, before - change, before + change), -_EFFORT, _EFFORT
                    )
                    sent = self._franka.Torques(within.tolist())
                else:
                    sent = self._franka.JointVelocities(self._within_jerk(command).tolist())
                self._control.writeOnce(sent)

    def brake(self) -> None:
        """End control: the robot stops and holds itself. Nothing is sent until `recover`.

        It may be called from any thread, repeatedly, and after a reflex.
        """
        self._braked = True
        with self._lock:
            control, self._control = self._control, None
            if control is None:
                return
            try:
                self._robot.stop()
            except self._errors:
                # Whoever lets go of it asks the robot to stop once more, and libfranka ends the
                # whole process where nobody answers: so it stays.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(control))
                self._is_lost = True

    def recover(self) -> None:
        """Accept commands again after `brake`, and clear the error of a reflex.

        Call it only after a person has checked why the robot stopped.

        Raises:
            DriverError: The robot cannot recover, such as while its stop is pressed.
        """
        self.brake()
        if self._is_lost:
            self._connect()
        with self._named("read"):
            state = self._robot.read_once()
        if state.robot_mode == self._franka.RobotMode.Reflex or state.current_errors:
            with self._named("recover"):
                self._robot.automatic_error_recovery()
        with self._named("read"):
            self._state = self._robot.read_once()
        self._braked = False

    def _connect(self) -> None:
        with self._named("connect"):
            self._robot = self._franka.Robot(*self._address)
        self._is_lost = False
        if self._collision:
            with self._named("set the collision thresholds"):
                self._robot.set_collision_behavior(*self._collision)
        with self._named("read"):
            self._state = self._robot.read_once()

    def _within_jerk(self, velocity: Array) -> Array:
        """Return velocities within speed, acceleration and jerk of the last that the robot got.

        Source: `limitRate` of libfranka, src/rate_limiting.cpp.
        """
        state = self._state
        q, before, a = np.array(state.q), np.array(state.dq_d), np.array(state.ddq_d)
        high = np.minimum(_SPEED, _towards(_HIGH - q)) - _INSIDE
        low = _INSIDE - np.minimum(_SPEED, _towards(q - _LOW))
        most = _JERK * _DT
        change = np.minimum(np.maximum((velocity - before) / _DT - a, -most), most)
        rate = _JERK / _ACCELERATION
        a = np.maximum(np.minimum(a + change, rate * (high - before)), rate * (low - before))
        return np.asarray(before + _DT * np.minimum(np.maximum(a, -_ACCELERATION), _ACCELERATION))

    @contextmanager
    def _named(self, what: str) -> Iterator[None]:
        try:
            yield
        except self._errors as error:
            raise DriverError(f"cannot {what}: {error}", given=what) from error


def _towards(left: Array) -> Array:
    """Return the speed that the robot allows at a distance from its joints' ends."""
    return np.asarray(np.maximum(np.sqrt(np.maximum(2.0 * _BRAKING * left, 0.0)) - _OFFSET, 0.0))
