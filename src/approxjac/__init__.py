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
    RegressorGravity,
    SetpointController,
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
from approxjac.robots import Dynamics, GravityRegressor, Robot, load_robot, robot_names
from approxjac.simulation import Plant, Trajectory, simulate
from approxjac.stability import LocalStability, LyapunovValue, local_stability, lyapunov
from approxjac.tasks import Camera, ImageTask, PlanarCamera, PositionTask, Task

__version__ = "0.1.0"

__all__ = [
    "AdaptiveGravity",
    "ApproxJacError",
    "Camera",
    "Controller",
    "DifferentiatedVelocity",
    "Dynamics",
    "Evaluation",
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
    "NoGravity",
    "PlanarCamera",
    "Plant",
    "PositionTask",
    "RegressorGravity",
    "Robot",
    "SetpointController",
    "SimulationError",
    "Sine",
    "Status",
    "Tanh",
    "Task",
    "Trajectory",
    "TrajectoryFileError",
    "UnknownNameError",
    "UrdfError",
    "law",
    "load_robot",
    "local_stability",
    "lyapunov",
    "robot_names",
    "simulate",
]
