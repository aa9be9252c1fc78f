"""Simulation: plants that are the truth, integrators, runs and their records."""

from approxjac.simulation.plant import Plant
from approxjac.simulation.simulate import simulate
from approxjac.simulation.trajectory import Trajectory

__all__ = ["Plant", "Trajectory", "simulate"]
