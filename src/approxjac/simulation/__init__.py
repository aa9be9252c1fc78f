"""Simulation: plants that are the truth, integrators, runs and their records."""

from approxjac.simulation.loop import Loop
from approxjac.simulation.mujoco_plant import MujocoPlant
from approxjac.simulation.plant import Plant
from approxjac.simulation.sensing import Sensing
from approxjac.simulation.simulate import simulate
from approxjac.simulation.trajectory import Trajectory
from approxjac.simulation.velocity_servo import VelocityServo

__all__ = [
    "Loop",
    "MujocoPlant",
    "Plant",
    "Sensing",
    "Trajectory",
    "VelocityServo",
    "simulate",
]  # fmt: skip
