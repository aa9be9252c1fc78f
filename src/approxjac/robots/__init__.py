"""Robots: arms from URDF files, objects attached to them, errors applied to them."""

from approxjac.robots.dynamics import Dynamics
from approxjac.robots.kinematic_regressor import KinematicRegressor
from approxjac.robots.load import load_robot, robot_names
from approxjac.robots.perturbation import Perturbation
from approxjac.robots.robot import Robot
from approxjac.robots.torque_regressors import (
    DynamicsRegressor,
    Excitation,
    GravityRegressor,
    excitation,
)

__all__ = [
    "Dynamics",
    "DynamicsRegressor",
    "Excitation",
    "GravityRegressor",
    "KinematicRegressor",
    "Perturbation",
    "Robot",
    "excitation",
    "load_robot",
    "robot_names",
]
