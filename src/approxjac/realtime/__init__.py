"""The loop on a robot: drivers, `control`, and the faults that it detects."""

from approxjac.realtime.control import RobotRun as RobotRun
from approxjac.realtime.control import control as control
from approxjac.realtime.driver import Driver as Driver
from approxjac.realtime.driver import SimulatedDriver as SimulatedDriver
from approxjac.realtime.faults import Accuracy as Accuracy
from approxjac.realtime.faults import Fault as Fault
from approxjac.realtime.faults import Tolerances as Tolerances
from approxjac.realtime.franka import FrankaDriver as FrankaDriver
from approxjac.realtime.scheduling import Pace as Pace
from approxjac.realtime.scheduling import Scheduling as Scheduling
