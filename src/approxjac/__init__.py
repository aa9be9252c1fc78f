"""Torque control of any URDF arm whose kinematics are not exactly known.

The plant owns the true robot, the controller the believed one; only measurements and torques
pass between them. Import as `import approxjac as aj`.

The names most programs need are here. Returned types and rarely used classes are in the
modules that define them: `aj.stability.RegularPart`, `aj.cameras.Camera`, `aj.view.plot_run`.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from approxjac import law, stability, view
    from approxjac import realtime as realtime
    from approxjac.cameras import PinholeCamera
    from approxjac.codegen.backends.c_files import export_c
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
    from approxjac.realtime.control import control
    from approxjac.robots import Robot, load_robot
    from approxjac.scenario import Scenario
    from approxjac.simulation import MujocoPlant, Plant, Sensing, Trajectory
    from approxjac.simulation.simulate import simulate
    from approxjac.stability.errors.region import JointBox
    from approxjac.stability.errors.uncertainty import Uncertainty
    from approxjac.stability.loop.linearization import local_stability
    from approxjac.stability.study import Study
    from approxjac.tasks import ImageTask, PoseTask, PositionTask, StackedTask, Task

__version__ = "0.1.0"

# Names and modules are loaded when they are asked for: Ctrl-C may end a command before that.
_FROM = {
    "cameras": ("PinholeCamera",),
    "codegen": ("export_c",),
    "errors": ("InvalidInputError",),
    "interface": ("Evaluation", "LimitStatus", "Measurement", "Status", "Target"),
    "paths": ("Circle", "Line", "Waypoints"),
    "realtime": ("control",),
    "robots": ("Robot", "load_robot"),
    "scenario": ("Scenario",),
    "simulation": ("MujocoPlant", "Plant", "Sensing", "Trajectory", "simulate"),
    "stability": ("JointBox", "Study", "Uncertainty", "local_stability"),
    "tasks": ("ImageTask", "PoseTask", "PositionTask", "StackedTask", "Task"),
}
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

    def __getattr__(name: str) -> object:
        """Load a module, or the name of one; all others of `__all__` are of `controllers`."""
        import importlib.util
        import sys

        if name in __all__ and name not in ("law", "stability", "view"):
            where = next((each for each, names in _FROM.items() if name in names), "controllers")
            value = getattr(importlib.import_module(f"approxjac.{where}"), name)
        elif not name.startswith("_") and importlib.util.find_spec(f"approxjac.{name}"):
            value = importlib.import_module(f"approxjac.{name}")
        else:
            # with these Python adds what was meant
            known = {"name": name, "obj": sys.modules[__name__]}
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}", **known)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_MODULES, "__version__", "__doc__", "__file__", "__path__"})
