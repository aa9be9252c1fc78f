"""Robots: arms from URDF files, attached objects and kinematic errors."""

from approxjac.robots.dynamics import Dynamics, DynamicsRegressor, GravityRegressor
from approxjac.robots.kinematic_regressor import KinematicRegressor
from approxjac.robots.load import load_robot, robot_names
from approxjac.robots.perturbation import Perturbation
from approxjac.robots.robot import Robot

__all__ = [
    "Dynamics",
    "DynamicsRegressor",
    "GravityRegressor",
    "KinematicRegressor",
    "Perturbation",
    "Robot",
    "load_robot",
    "robot_names",
]
