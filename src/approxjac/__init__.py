"""Torque control of any URDF arm whose kinematics are not exactly known.

The plant owns the true robot, the controller the believed one; only measurements and torques
pass between them. Import as `import approxjac as aj`.

The names most programs need are here. Returned types and rarely used classes are in the
modules that define them: `aj.stability.RegularPart`, `aj.cameras.Camera`, `aj.view.plot_run`.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from approxjac import law as law
    from approxjac import realtime as realtime
    from approxjac import stability as stability
    from approxjac import view as view
    from approxjac.calibration.calibrate import calibrate as calibrate
    from approxjac.calibration.recording import Recording as Recording
    from approxjac.cameras import PinholeCamera as PinholeCamera
    from approxjac.codegen.backends.c_files import export_c as export_c
    from approxjac.controllers import AdaptiveGravity as AdaptiveGravity
    from approxjac.controllers import AdaptiveKinematics as AdaptiveKinematics
    from approxjac.controllers import Controller as Controller
    from approxjac.controllers import Gains as Gains
    from approxjac.controllers import HeldMeasurement as HeldMeasurement
    from approxjac.controllers import Latency as Latency
    from approxjac.controllers import Limits as Limits
    from approxjac.controllers import NoGravity as NoGravity
    from approxjac.controllers import SetpointController as SetpointController
    from approxjac.controllers import TorqueLimited as TorqueLimited
    from approxjac.controllers import TrackingController as TrackingController
    from approxjac.controllers import default_gains as default_gains
    from approxjac.errors import InvalidInputError as InvalidInputError
    from approxjac.interface import Evaluation as Evaluation
    from approxjac.interface import LimitStatus as LimitStatus
    from approxjac.interface import Measurement as Measurement
    from approxjac.interface import Status as Status
    from approxjac.interface import Target as Target
    from approxjac.paths import Circle as Circle
    from approxjac.paths import Line as Line
    from approxjac.paths import Waypoints as Waypoints
    from approxjac.realtime.control import control as control
    from approxjac.robots import Robot as Robot
    from approxjac.robots import load_robot as load_robot
    from approxjac.scenario import Scenario as Scenario
    from approxjac.simulation import MujocoPlant as MujocoPlant
    from approxjac.simulation import Plant as Plant
    from approxjac.simulation import Sensing as Sensing
    from approxjac.simulation import Trajectory as Trajectory
    from approxjac.simulation.simulate import simulate as simulate
    from approxjac.stability.errors.region import JointBox as JointBox
    from approxjac.stability.errors.uncertainty import Uncertainty as Uncertainty
    from approxjac.stability.loop.linearization import local_stability as local_stability
    from approxjac.stability.study import Study as Study
    from approxjac.tasks import ImageTask as ImageTask
    from approxjac.tasks import PoseTask as PoseTask
    from approxjac.tasks import PositionTask as PositionTask
    from approxjac.tasks import StackedTask as StackedTask
    from approxjac.tasks import Task as Task

__version__ = "0.1.0"

# Names and modules are loaded when they are asked for: Ctrl-C may end a command before that.
_FROM = {
    "calibration": ("Recording", "calibrate"),
    "cameras": ("PinholeCamera",),
    "codegen": ("export_c",),
    "controllers": (
        "AdaptiveGravity",
        "AdaptiveKinematics",
        "Controller",
        "Gains",
        "HeldMeasurement",
        "Latency",
        "Limits",
        "NoGravity",
        "SetpointController",
        "TorqueLimited",
        "TrackingController",
        "default_gains",
    ),
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
_SUBPACKAGES = ("law", "stability", "view")
_MODULES = (
    "calibration",
    "cameras",
    "controllers",
    "errors",
    "robots",
    "simulation",
    "tasks",
)  # of further names

__all__ = sorted([*_SUBPACKAGES, *(name for names in _FROM.values() for name in names)])


if not TYPE_CHECKING:  # or no name would be unknown to type checkers

    def __getattr__(name: str) -> object:
        """Load a module, or the name of one."""
        import importlib.util
        import sys

        where = next((each for each, names in _FROM.items() if name in names), None)
        if where is not None:
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
