"""The loop on a robot: drivers, `control`, and the faults that it looks for."""

from approxjac.realtime.accuracy import Accuracy, Tolerances
from approxjac.realtime.control import control
from approxjac.realtime.driver import Driver
from approxjac.realtime.faults import Fault
from approxjac.realtime.franka import FrankaDriver
from approxjac.realtime.robot_run import RobotRun
from approxjac.realtime.scheduling import Pace, Scheduling
from approxjac.realtime.simulated_driver import SimulatedDriver

__all__ = [
    "Accuracy", "Driver", "Fault", "FrankaDriver", "Pace", "RobotRun", "Scheduling",
    "SimulatedDriver", "Tolerances", "control",
]  # fmt: skip
