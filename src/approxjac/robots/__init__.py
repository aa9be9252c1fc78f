"""Robots: arms from URDF files, attached objects and kinematic errors."""

from approxjac.robots.drives import Drives as Drives
from approxjac.robots.drives import Friction as Friction
from approxjac.robots.dynamics import Dynamics as Dynamics
from approxjac.robots.dynamics import DynamicsRegressor as DynamicsRegressor
from approxjac.robots.dynamics import GravityRegressor as GravityRegressor
from approxjac.robots.dynamics_fit import FittedDynamics as FittedDynamics
from approxjac.robots.dynamics_fit import fit_dynamics as fit_dynamics
from approxjac.robots.kinematic_regressor import KinematicBelief as KinematicBelief
from approxjac.robots.kinematic_regressor import KinematicRegressor as KinematicRegressor
from approxjac.robots.load import load_robot as load_robot
from approxjac.robots.load import robot_names as robot_names
from approxjac.robots.perturbation import Perturbation as Perturbation
from approxjac.robots.robot import Robot as Robot
