"""Setups of the tracking studies: tool, joint origins and tracker are other than believed.

Truth: an object of 20 cm and 1 kg, each joint origin 3 cm off in a direction of its own, and a
tracker that is turned and moved. Belief: the bare arm of the drawing, and no tracker. The tracker
has 2 mm of noise, 60 Hz, and is 30 ms late.
"""

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac.simulation import Sensing
from approxjac.tasks import TrackerTask

DT = 1e-3
NOISE, RATE, DELAY = 2e-3, 60.0, 0.03  # of the tracker [m], [Hz], [s]
OFFSET = (0.10, -0.05, 0.05)  # of the tracker [m]
START = {
    "panda": (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7),
    "ur5": (0.0, -1.2, 1.6, -1.9, -1.57, 0.0),
    "xarm7": (0.0, -0.4, 0.0, 1.2, 0.0, 1.6, 0.0),
    "so101": (0.2, -0.3, 0.3, 0.7, 0.0),
}  # others where they are well away from singular
AXIS = {"ur5": "y", "ur10": "y", "kinova": "z", "so101": "z"}  # of the tip along the object, or x


@dataclass(frozen=True)
class Setup:
    """What is true, and what of it is measured; see this module."""

    robot: str = "panda"
    yaw: float = math.radians(60.0)  # of the tracker [rad]
    tilt: tuple[float, float] = (0.0, 0.0)  # of it about x and y, before the yaw [rad]
    seed: int = 0  # of the joint origins and the noise
    shift: float = 0.03  # of each joint origin [m]
    axes: float = 0.0  # tilt of each joint axis [rad]
    length: float = 0.2  # of the object [m]
    mass: float = 1.0  # of it [kg]
    way: tuple[float, float, float] = (0.10, -0.15, 0.12)  # to the target or centre, in the world
    plane: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0, 0.0, 0.0), (0.0, 0.6, 0.8))
    delay: float = DELAY  # of the tracker [s]
    sensing: dict = field(default_factory=dict)  # further errors, as of `Sensing`

    @property
    def rotation(self):
        """R of the tracker."""
        return pin.exp3(np.array([0.0, 0.0, self.yaw])) @ pin.exp3(np.array([*self.tilt, 0.0]))

    @property
    def belief(self):
        """The arm of the drawing."""
        return aj.load_robot(self.robot)

    @property
    def truth(self):
        """The arm as it is, with the object."""
        belief, rng = self.belief, np.random.default_rng(self.seed)
        shifts, turns = {}, {}
        for joint in belief.joint_names:
            for errors, size in ((shifts, self.shift), (turns, self.axes)):
                way = rng.normal(size=3)
                errors[joint] = size * way / np.linalg.norm(way)
        held = belief.with_object(self.length, self.mass, axis=AXIS.get(self.robot, "x"))
        return held.with_kinematic_error(shifts, turns if self.axes else None)

    def plant(self, **options):
        """Return the plant; motors deliver what they can."""
        truth = self.truth
        sensor = TrackerTask(truth, pin.log3(self.rotation), OFFSET)
        sensing = Sensing(x_noise=NOISE, x_rate=RATE, x_delay=self.delay, **self.sensing)
        kind = options.pop("kind", aj.Plant)
        return kind(truth, sensor, sensing=sensing, torque_limits=truth.effort_limits, **options)

    @property
    def q0(self):
        """Where the arm starts."""
        start = START.get(self.robot)
        return np.array(ready(self.robot) if start is None else start)

    def target(self, plant):
        """Return the set-point, in the tracker's axes."""
        return plant.sensor.value(self.q0) + self.rotation @ self.way

    def circle(self, plant, radius=0.1, period=4.0):
        """Return a circle about the set-point that begins slowly, in the tracker's axes."""
        u, w = (self.rotation @ np.array(side) for side in self.plane)
        return Circle(self.target(plant), radius * u, radius * w, period)


@cache
def ready(robot):
    """Return a configuration to start from."""
    return aj.Plant(aj.load_robot(robot)).ready_configuration()


class Circle:
    """A circle in any plane, whose phase is eased in over the first second."""

    def __init__(self, center, u, w, period):
        self.center, self.u, self.w, self.rate = center, u, w, 2.0 * math.pi / period

    def at(self, t):
        """Return the target at t [s]."""
        r = min(max(t, 0.0), 1.0)
        s = self.rate * (r**3 - 0.5 * r**4 + max(t - 1.0, 0.0))
        v, a = self.rate * (3.0 * r**2 - 2.0 * r**3), self.rate * 6.0 * (r - r**2)
        c, s = math.cos(s), math.sin(s)
        out, along = c * self.u + s * self.w, c * self.w - s * self.u
        return aj.Target(self.center + out, v * along, a * along - v**2 * out)


def rms(run, start, end):
    """Return the RMS of the true error in a time [mm]."""
    part = run.error_norm[(run.t >= start) & (run.t <= end)]
    return 1e3 * float(np.sqrt(np.mean(part**2)))
