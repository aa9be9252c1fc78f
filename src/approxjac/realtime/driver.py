"""`Driver`: the interface of a robot to the loop; `read`, which checks it; `SimulatedDriver`."""

import math
from collections.abc import Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import pinocchio as pin

from approxjac.controllers import Limits
from approxjac.controllers.arguments import FLOAT64, from_another_clock, time_of_x
from approxjac.errors import InvalidInputError
from approxjac.formatting import one_line
from approxjac.interface import Measurement
from approxjac.realtime.scheduling import Pace
from approxjac.simulation.plant import Plant
from approxjac.simulation.simulate import MovingArm
from approxjac.tasks import Task
from approxjac.validation import Array, as_integer, as_number, read_only, require

_AHEAD = 0.01  # s, and a period: by which x may be stamped later than the state it comes with
_CATCH_UP = 50  # periods for which an arm moves on without a command


@runtime_checkable
class Driver(Protocol):
    """The interface of a robot. One thread calls `read` and `send`; any may call `brake`.

    Attributes:
        dt: Period of the loop [s].
        command: Kind of commands for `send`: joint torques, or joint velocities.
        adds_gravity: True if the robot adds the gravity torque of its own model to commands.
        limits: Limits that the robot enforces itself, by refusing a command or stopping.
    """

    dt: float
    command: Literal["torque", "velocity"]
    adds_gravity: bool
    limits: Limits

    def read(self) -> Measurement:
        """Wait for the state of the next period and return it.

        t is the robot's clock [s]; q and v are in the order of `Robot.joint_names`; q has one
        number per joint, or (cos, sin) for continuous ones as in `Robot.neutral`; x is the sensor's
        last value, taken at t_x of the same clock, or NaN if there is none.
        """

    def send(self, command: Array) -> None:
        """Send joint torques or velocities, shape (n_v,), for this period."""

    def brake(self) -> None:
        """End control and hold the arm by the robot's own means; do nothing the second time."""


def read(driver: Driver, task: Task) -> Measurement:
    """Return the next measurement with read-only copies, as drivers may reuse their arrays.

    Masked entries become NaN, angles of continuous joints (cos, sin), a t_x of −inf None.

    Raises:
        InvalidInputError: No `Measurement`; a t or t_x that is no finite number; q, q̇ or x that are
            no real numbers, or another number of them.
    """
    given = driver.read()
    wanted = "a Measurement(t, q, v, x, t_x)"
    require("what read() of the driver returns", given, Measurement, wanted)
    t, t_x = as_number("t of a measurement", given.t, unit="s"), time_of_x(given.t_x)
    t_x = None if t_x is None else float(t_x)
    q, v, x = (_copied(name, getattr(given, name)) for name in "qvx")
    robot = task.robot
    if q.shape == (robot.nv,) and robot.nq != robot.nv:
        q = read_only(np.array(pin.integrate(robot.model, robot.neutral(), q)))
    measured = Measurement(t, q, v, x, t_x)
    if (q.shape, v.shape, x.shape) != ((robot.nq,), (robot.nv,), (task.n_x,)):
        raise InvalidInputError(
            f"driver must read q, q̇ and x with {robot.nq}, {robot.nv} and {task.n_x} numbers, "
            f"got shapes {q.shape}, {v.shape}, {x.shape}",
            given=measured,
        )
    return measured


def two_clocks(measurement: Measurement, dt: float) -> str:
    """Return an error text if x was taken after t, which proves two clocks, else ""."""
    return from_another_clock(measurement.t, measurement.t_x, dt + _AHEAD)


def _copied(name: str, values: Any) -> Array:
    if type(values) is not np.ndarray or values.dtype is not FLOAT64:
        try:
            given = np.ma.asarray(values)
        except ValueError:  # a ragged list
            given = np.ma.asarray(None)
        if given.dtype.kind not in "fiu":
            message = f"{name} of a measurement must be an array of real numbers, NaN where unknown"
            raise InvalidInputError(f"{message}, got {one_line(values)}", given=values)
        values = np.ma.filled(given.astype(np.float64), np.nan)
    return read_only(np.array(values))


class SimulatedDriver(MovingArm):
    """A plant as a robot: with its sensors, its delays, a clock, and a brake.

    In real time the arm does not wait: if a command is late, the last one continues.

    Args:
        plant: The true robot: a `Plant`, or a `MujocoPlant` with friction and a floor.
        q0: Start configuration, shape (nq,); `plant.ready_configuration()` by default.
        dt: Period [s].
        pace: Simulated seconds per second of real time; infinite for as fast as possible.
        seed: Seed of the sensors' noise, ≥ 0.

    Attributes:
        t: Simulated time [s].
        q: True configuration, shape (nq,).
        v: True joint velocity, shape (n_v,).
        braked: True if the brake is closed, so that the arm is at rest.
    """

    def __init__(
        self,
        plant: Plant,
        q0: Sequence[float] | Array | None = None,
        *,
        dt: float = 1e-3,
        pace: float = 1.0,
        seed: int = 0,
    ) -> None:
        require("plant", plant, Plant, "a Plant")
        dt, seed = as_number("dt", dt, unit="s", above=0.0), as_integer("seed", seed, 0)
        robot = plant.robot
        q = robot.configuration(plant.ready_configuration() if q0 is None else q0, "q0")
        rest = np.zeros(robot.nv)
        super().__init__(plant, np.array(q), rest, dt, "semi_implicit_euler", seed)
        self.command: Literal["torque", "velocity"] = plant.command
        self.limits = Limits(effort=plant.motor_limits)
        self.adds_gravity = plant.adds_gravity is not None
        self._pace = None
        if pace != math.inf:
            self._pace = Pace(dt / as_number("pace", pace, above=0.0))
        self._command: Array | None = None  # until the first one the arm stands on its brake
        self.braked = False

    def read(self) -> Measurement:
        """Wait for the next period and return its measurement."""
        periods = 1 if self._pace is None else min(self._pace.wait(), _CATCH_UP)
        for _ in range(periods):
            measured = self._period()
        return measured

    def advance(self, duration: float) -> None:
        """Simulate for a duration [s] with the last command, as while the loop does not read."""
        for _ in range(round(duration / self.dt)):
            self._period()

    def send(self, command: Array) -> None:
        """Accept a command, which acts until the next one."""
        self._command = np.array(command, dtype=float)

    def brake(self) -> None:
        """Hold the arm where it is."""
        self.braked = True

    def _period(self) -> Measurement:
        if self.braked or self._command is None:
            self.v = np.zeros_like(self.v)
            if self.motors is not None:
                self.motors = self.motors._replace(rate=self.v)
            self.move([])
        else:
            self.move(self.take(self._command))
        return self.sense()[1]
