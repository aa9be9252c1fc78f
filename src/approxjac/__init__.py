"""Torque control of any URDF arm whose kinematics are not exactly known.

The plant owns the true robot, the controller the believed one; only measurements and torques
pass between them. Import as `import approxjac as aj`.

The names most programs need are here. Returned types and rarely used classes are in the
modules that define them: `aj.stability.RegularPart`, `aj.cameras.Camera`, `aj.view.plot_run`.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from approxjac import law
from approxjac.cameras import PinholeCamera
from approxjac.controllers import (
    AdaptiveGravity,
    AdaptiveKinematics,
    Controller,
    Gains,
    HeldMeasurement,
    Latency,
    Limits,
    NoGravity,
    SetpointController,
    TorqueLimited,
    TrackingController,
    default_gains,
)
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.paths import Circle, Line, Waypoints
from approxjac.robots import Robot, load_robot
from approxjac.simulation import MujocoPlant, Plant, Sensing, Trajectory, simulate
from approxjac.tasks import ImageTask, PoseTask, PositionTask, StackedTask, Task

if TYPE_CHECKING:
    from approxjac import codegen as codegen
    from approxjac import realtime as realtime
    from approxjac import stability, view
    from approxjac.codegen.backends.c_files import export_c
    from approxjac.realtime.control import control
    from approxjac.scenario import Scenario
    from approxjac.stability.errors.region import JointBox
    from approxjac.stability.errors.uncertainty import Uncertainty
    from approxjac.stability.loop.linearization import local_stability
    from approxjac.stability.study import Study

__version__ = "0.1.0"

_LAZY = ("codegen", "realtime", "stability", "view")  # modules that many programs never need
_FROM = {"Scenario": "scenario", "control": "realtime", "export_c": "codegen"}
_MODULES = ("cameras", "controllers", "errors", "robots", "simulation", "tasks")  # of further names

__all__ = [
    "AdaptiveGravity",
    "AdaptiveKinematics",
    "Circle",
    "Controller",
    "Evaluation",
    "Gains",
    "HeldMeasurement",
    "ImageTask",
    "InvalidInputError",
    "JointBox",
    "Latency",
    "LimitStatus",
    "Limits",
    "Line",
    "Measurement",
    "MujocoPlant",
    "NoGravity",
    "PinholeCamera",
    "Plant",
    "PoseTask",
    "PositionTask",
    "Robot",
    "Scenario",
    "Sensing",
    "SetpointController",
    "StackedTask",
    "Status",
    "Study",
    "Target",
    "Task",
    "TorqueLimited",
    "TrackingController",
    "Trajectory",
    "Uncertainty",
    "Waypoints",
    "control",
    "default_gains",
    "export_c",
    "law",
    "load_robot",
    "local_stability",
    "simulate",
    "stability",
    "view",
]


if not TYPE_CHECKING:  # or no name would be unknown to type checkers

    def __getattr__(name: str) -> Any:
        """Load modules of `_LAZY` and the names of `_FROM` and `stability` when asked for."""
        if name in _LAZY:
            value = importlib.import_module(f"approxjac.{name}")
        elif name in __all__:
            module = _FROM.get(name, "stability")
            value = getattr(importlib.import_module(f"approxjac.{module}"), name)
        else:
            # with these Python adds what was meant
            where = {"name": name, "obj": sys.modules[__name__]}
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}", **where)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES, "__version__", "__doc__", "__file__", "__path__"})
