"""The loop on a robot: drivers, `control`, and the faults that it detects."""

from approxjac.realtime.control import RobotRun, control
from approxjac.realtime.driver import Driver
from approxjac.realtime.faults import Accuracy, Fault, Tolerances
from approxjac.realtime.franka import FrankaDriver
from approxjac.realtime.scheduling import Pace, Scheduling
from approxjac.realtime.simulated_driver import SimulatedDriver

__all__ = [
    "Accuracy", "Driver", "Fault", "FrankaDriver", "Pace", "RobotRun", "Scheduling",
    "SimulatedDriver", "Tolerances", "control",
]  # fmt: skip
