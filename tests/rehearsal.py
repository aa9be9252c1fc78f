"""Rehearsals of the loop on a robot, with drivers that tests break."""

import gc
import math

import numpy as np

import approxjac as aj
from approxjac.realtime import SimulatedDriver, Tolerances, control

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
SLOW = 2.0  # s: a busy machine is no fault here


class Wrapped:
    """A driver around another one; tests change what they break."""

    def __init__(self, driver):
        self.driver = driver
        self.dt, self.command, self.limits = driver.dt, driver.command, driver.limits
        self.adds_gravity = driver.adds_gravity
        self.sent, self.brakes = [], 0

    def read(self):
        return self.driver.read()

    def send(self, command):
        self.sent.append(command.copy())
        self.driver.send(command)

    def brake(self):
        self.brakes += 1
        self.driver.brake()


def driver_of(plant, kind=Wrapped, **options):
    return kind(SimulatedDriver(plant, START, pace=math.inf, **options))


def goal(plant, way=(0.05, -0.05, 0.05)):
    return plant.sensor.value(START) + way


def tolerating(**options):
    return Tolerances(**{"max_period": SLOW} | options)


def run(driver, controller, duration=1.0, **options):
    plant = driver.driver.plant
    options = {"tolerances": tolerating(), **options}
    gc.freeze()  # or collecting what other tests loaded takes longer than many a run
    return control(driver, controller, goal(plant), duration, **options)


class Around(aj.controllers.ControllerWrapper):
    """A controller of somebody's own, which says nothing of itself."""

    _memory = 0

    def __init__(self, controller):
        self.controller = controller

    def begin(self, measurement):
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        return self.controller.advance(state, measurement, target, dt)
