"""Simulation: the true plant, its sensors, runs and their records."""

from approxjac.interface import Condition as Condition
from approxjac.simulation.monitor import Event as Event
from approxjac.simulation.monitor import Monitor as Monitor
from approxjac.simulation.mujoco_plant import MujocoPlant as MujocoPlant
from approxjac.simulation.plant import Plant as Plant
from approxjac.simulation.plant import VelocityServo as VelocityServo
from approxjac.simulation.sensing import Sensing as Sensing
from approxjac.simulation.simulate import Computation as Computation
from approxjac.simulation.simulate import InitialState as InitialState
from approxjac.simulation.simulate import Loop as Loop
from approxjac.simulation.simulate import simulate as simulate
from approxjac.simulation.trajectory import Trajectory as Trajectory
