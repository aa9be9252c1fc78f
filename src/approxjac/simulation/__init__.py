"""Simulation: the true plant, its sensors, runs and their records."""

from approxjac.interface import Condition
from approxjac.simulation.monitor import Event, Monitor
from approxjac.simulation.mujoco_plant import MujocoPlant
from approxjac.simulation.plant import Friction, Plant, VelocityServo
from approxjac.simulation.sensing import Sensing
from approxjac.simulation.simulate import Computation, InitialState, Loop, simulate
from approxjac.simulation.trajectory import Trajectory

__all__ = [
    "Computation",
    "Condition",
    "Event",
    "Friction",
    "InitialState",
    "Loop",
    "Monitor",
    "MujocoPlant",
    "Plant",
    "Sensing",
    "Trajectory",
    "VelocityServo",
    "simulate",
]
