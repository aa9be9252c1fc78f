"""Certified moves: the runs of adversarial robots stay within the bounds, sampled as they run."""

import functools

import numpy as np
import pytest
from beliefs import belief_of  # noqa: F401

import approxjac as aj
from approxjac.controllers import Latency
from approxjac.paths import Line as Path
from approxjac.stability.certificates.moves import Line
from approxjac.stability.search.moves import between, slow_path


def worst_run(study, start, move, values, dt):
    """The largest |e| and distances of joints from the slow path, of a run, as shares of bounds."""
    loop, errors, length = study.loop(), study.uncertainty, np.linalg.norm(move.displacement)
    plant, robot = errors.plant(values), study.controller.task.robot
    x0 = plant.sensor.value(start)
    duration = dt * round((move.duration + 1.0) / dt)
    way = Path(x0, x0 + move.displacement, move.duration)
    run = aj.simulate(plant, study.controller, way, start, duration, dt=dt)
    other, truths = loop.of_values(np.asarray(values)[None])
    line = Line(move.displacement / length, length, move.speed)
    path, _ = slow_path(other, truths, start, line)
    r = np.minimum(run.t / move.duration, 1.0)
    motion = between(np.repeat(path, len(r), 1), r**3 * (10.0 - 15.0 * r + 6.0 * r * r))
    moved = np.array([robot.motion(start, q) for q in run.q]) if False else run.q - start
    away = np.abs(moved - motion).max(axis=0)
    return np.linalg.norm(run.error, axis=1).max() / move.error, (away / move.deviation).max()
