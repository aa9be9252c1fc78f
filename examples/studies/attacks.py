"""Runs and samples that a certificate of the sampled loop is held against."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import uneven
from certify import lyapunov

import approxjac as aj
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.rollouts.setting import with_engine

OF_EACH = 5  # linearisations of a true robot
STEPS = 600  # of a recorded run [periods]
MOVING = (0.3, 0.9)  # V at the start of an arm that moves, over c
LONGEST, DURATION = 2000, 2.0  # of rollouts, whichever is less [periods, s]


def linearised(controller, plant, region, latency, rng):
    """Return by what errors of a true robot grow from frame to frame, shape (OF_EACH,)."""
    loop = ClosedLoop(controller, plant, region)
    return radii(loop, loop.draw(OF_EACH, rng), latency)


def radii(loop, samples, latency):
    """Return the spectral radii of the maps from frame to frame of samples as targets, (N,)."""
    timing = latency.in_samples()
    return np.exp(timing.frame * loop.growth(samples, timing))


def start(plant, controller, region, test, rng, level):
    """Return a configuration and a target of the region with V ≤ level at rest."""
    q, end = region.sample(2, rng)
    target = plant.sensor.value(end)
    model, share = plant.robot.model, 1.0
    while True:
        there = np.array(pin.interpolate(model, end, q, share))
        e = plant.sensor.error(plant.sensor.value(there), target)
        if float(test.weights.at_rest(e, controller.saturation)) <= level:
            return there, target
        share *= 0.8


def as_sensed(latency):
    """Return how sensors lag."""
    rate = 1.0 / latency.image_period if latency.image_period else None
    lag = latency.velocity_filter or None
    return aj.Sensing(x_rate=rate, x_delay=latency.image_age, velocity_filter=lag)


def watched(controller, plant, region, test, latency, rng):
    """Return the largest V(t)/V(0) − 1 of a run up to its first exit, and whether there is none."""
    q, target = start(plant, controller, region, test, rng, test.level)
    record = as_it_runs(controller, plant, q, target, latency)
    return rise(controller, plant, region, test, record, target)


def rise(controller, plant, region, test, record, target):
    """Return the largest V(t)/V(0) − 1 of a run up to its first exit, and whether there is none."""
    inside = np.array([region.contains(q) for q in record.q])
    kept = np.arange(len(inside) if inside.all() else int(inside.argmin()))
    V = along(controller, plant, region, test, record, target, kept)
    return float(V.max(initial=V[0]) / V[0] - 1.0), bool(inside.all())


def along(controller, plant, region, test, record, target, kept):
    """Return V at the recorded instants kept."""
    loop = ClosedLoop(controller, plant, region, target)
    seen = loop.samples_at(np.zeros(len(kept), dtype=int), record.q[kept])
    return lyapunov(loop, seen, loop.setting, test.weights, record, kept)


def on_its_own_clock(latency):
    """Return a latency whose frames of x never fall on samples, as where periods vary."""
    return replace(latency, image_period=(1.0 + 1e-4) * latency.image_period)


def moved(controller, plant, region, test, latency, rng, kicked):
    """Return what `rise` does of a run whose periods vary, and whose arm may move at the start."""
    level = test.level * rng.uniform(*MOVING)
    q, target = start(plant, controller, region, test, rng, 0.9 * level)
    v = rng.normal(size=plant.robot.nv) * kicked
    if kicked:
        v /= math.sqrt(v @ plant.dynamics.M(q) @ v)
        e = plant.sensor.error(plant.sensor.value(q), target)
        two = uneven.Run(np.zeros(2), np.array([q, q]), np.array([0.0 * v, v]), np.array([e, e]))
        rest, once = along(controller, plant, region, test, two, target, np.arange(2))
        b = once - rest - 0.5  # V = rest + b a + ½ a² at the velocity a v
        v = v * (math.sqrt(b * b + 2.0 * (level - rest)) - b)
    record = uneven.run(controller, plant, target, q, v, latency, STEPS, rng)
    return rise(controller, plant, region, test, record, target)


def as_it_runs(controller, plant, q, target, latency):
    """Return a recorded run at the loop's latency."""
    real = aj.Plant(
        plant.robot, plant.sensor, friction=plant.friction, sensing=as_sensed(latency),
        actuator_delay=latency.torque_delay,
    )  # fmt: skip
    return aj.simulate(
        real,
        controller,
        target,
        q,
        STEPS * latency.period,
        dt=latency.period,
        computation=aj.simulation.Computation("rk4"),
    )


def in_lanes(controller, errors, region, latency, runs, seed):
    """Return rollouts between configurations of the region."""
    steps = max(100, min(LONGEST, math.ceil(DURATION / latency.period)))
    study = aj.Study(
        controller, errors, region, latency=latency, sensing=as_sensed(latency), seed=seed,
        duration=steps * latency.period,
    )  # fmt: skip
    (setting,) = with_engine([study.setting()], None, runs)
    return setting.columns(range(runs))
