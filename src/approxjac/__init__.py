"""Torque control of any URDF arm whose kinematics are not exactly known.

The plant owns the true robot, the controller the believed one; only measurements and torques
pass between them. Import as `import approxjac as aj`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from approxjac import law
from approxjac.controllers import (
    AdaptiveGravity,
    BoundedController,
    BoundedGains,
    DifferentiatedVelocity,
    Gains,
    HeldMeasurement,
    Limits,
    ModelGravity,
    NoGravity,
    Posture,
    RegressorGravity,
    SetpointController,
    TaskTorqueScaled,
    TorqueClipped,
    TorqueLimited,
    VelocityServo,
    bounded_gains,
    default_adaptation,
    default_gains,
)
from approxjac.errors import (
    ApproxJacError,
    InvalidInputError,
    MeasurementError,
    MissingPackageError,
    SimulationError,
    TrajectoryFileError,
    UnknownNameError,
    UrdfError,
)
from approxjac.interface import Controller, Evaluation, LimitStatus, Measurement, Status
from approxjac.law import Linear, Sine, Tanh
from approxjac.robots import (
    Dynamics,
    Excitation,
    GravityRegressor,
    Robot,
    excitation,
    load_robot,
    robot_names,
)
from approxjac.simulation import MujocoPlant, Plant, Sensing, Trajectory, simulate
from approxjac.tasks import (
    Camera,
    CombinedTask,
    ImageTask,
    NonsingularTask,
    PinholeCamera,
    PlanarCamera,
    PoseTask,
    PositionTask,
    StackedTask,
    Task,
)

if TYPE_CHECKING:
    from approxjac.stability import (  # type: ignore[no-redef]  # of functions named as modules
        JointBox,
        LocalStability,
        LyapunovValue,
        Region,
        RegularPart,
        Rollout,
        Rollouts,
        StabilityMap,
        StabilityReport,
        SublevelSet,
        Suggestion,
        Tolerance,
        Tube,
        Uncertainty,
        local_stability,
        lyapunov,
        rollouts,
        stability_map,
        stability_report,
        suggest_gains,
        tolerance,
    )

__version__ = "0.1.0"

__all__ = [
    "AdaptiveGravity",
    "ApproxJacError",
    "BoundedController",
    "BoundedGains",
    "Camera",
    "CombinedTask",
    "Controller",
    "DifferentiatedVelocity",
    "Dynamics",
    "Evaluation",
    "Excitation",
    "Gains",
    "GravityRegressor",
    "HeldMeasurement",
    "ImageTask",
    "InvalidInputError",
    "JointBox",
    "LimitStatus",
    "Limits",
    "Linear",
    "LocalStability",
    "LyapunovValue",
    "Measurement",
    "MeasurementError",
    "MissingPackageError",
    "ModelGravity",
    "MujocoPlant",
    "NoGravity",
    "NonsingularTask",
    "PinholeCamera",
    "PlanarCamera",
    "Plant",
    "PoseTask",
    "PositionTask",
    "Posture",
    "Region",
    "RegressorGravity",
    "RegularPart",
    "Robot",
    "Rollout",
    "Rollouts",
    "Sensing",
    "SetpointController",
    "SimulationError",
    "Sine",
    "StabilityMap",
    "StabilityReport",
    "StackedTask",
    "Status",
    "SublevelSet",
    "Suggestion",
    "Tanh",
    "Task",
    "TaskTorqueScaled",
    "Tolerance",
    "TorqueClipped",
    "TorqueLimited",
    "Trajectory",
    "TrajectoryFileError",
    "Tube",
    "Uncertainty",
    "UnknownNameError",
    "UrdfError",
    "VelocityServo",
    "bounded_gains",
    "default_adaptation",
    "default_gains",
    "excitation",
    "law",
    "load_robot",
    "local_stability",
    "lyapunov",
    "robot_names",
    "rollouts",
    "simulate",
    "stability_map",
    "stability_report",
    "suggest_gains",
    "tolerance",
]


def __getattr__(name: str) -> Any:
    """Load `approxjac.stability` when one of its names is asked for: many programs never do."""
    if name == "stability" or name in __all__:
        module = importlib.import_module("approxjac.stability")
        found = globals()[name] = module if name == "stability" else getattr(module, name)
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
