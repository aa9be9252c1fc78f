"""Torque control of any URDF arm whose kinematics are not exactly known.

The plant owns the true robot, the controller the believed one; only measurements and torques
pass between them. Import as `import approxjac as aj`.
"""

from approxjac import law
from approxjac.controllers import (
    AdaptiveGravity,
    DifferentiatedVelocity,
    Gains,
    ModelGravity,
    NoGravity,
    Posture,
    RegressorGravity,
    SetpointController,
    default_adaptation,
    default_gains,
)
from approxjac.errors import (
    ApproxJacError,
    InvalidInputError,
    MeasurementError,
    SimulationError,
    TrajectoryFileError,
    UnknownNameError,
    UrdfError,
)
from approxjac.interface import Controller, Evaluation, Measurement, Status
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
from approxjac.stability import (
    LocalStability,
    LyapunovValue,
    Rollout,
    Rollouts,
    Uncertainty,
    local_stability,
    lyapunov,
    rollouts,
)
from approxjac.tasks import (
    Camera,
    ImageTask,
    NonsingularTask,
    PlanarCamera,
    PoseTask,
    PositionTask,
    StackedTask,
    Task,
)

__version__ = "0.1.0"

__all__ = [
    "AdaptiveGravity",
    "ApproxJacError",
    "Camera",
    "Controller",
    "DifferentiatedVelocity",
    "Dynamics",
    "Evaluation",
    "Excitation",
    "Gains",
    "GravityRegressor",
    "ImageTask",
    "InvalidInputError",
    "Linear",
    "LocalStability",
    "LyapunovValue",
    "Measurement",
    "MeasurementError",
    "ModelGravity",
    "MujocoPlant",
    "NoGravity",
    "NonsingularTask",
    "PlanarCamera",
    "Plant",
    "PoseTask",
    "PositionTask",
    "Posture",
    "RegressorGravity",
    "Robot",
    "Rollout",
    "Rollouts",
    "Sensing",
    "SetpointController",
    "SimulationError",
    "Sine",
    "StackedTask",
    "Status",
    "Tanh",
    "Task",
    "Trajectory",
    "TrajectoryFileError",
    "Uncertainty",
    "UnknownNameError",
    "UrdfError",
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
]
