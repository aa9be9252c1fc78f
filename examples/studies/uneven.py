"""A run of law (6) whose periods vary, from a start that may move, from event to event.

`simulate` counts all times in periods that are equal. Here samples follow each other by any time up
to the longest, torques act later by any time, and a camera has a clock of its own.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac.simulation.plant import rk4

SHORTEST, AS_LONG = 0.1, 0.3  # of the longest period; share of the periods that are as long
TINY = 1e-9  # of a period


class Run(NamedTuple):
    """What happened, at all events."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    error: np.ndarray


def run(controller, plant, target, q, v, latency, steps, rng):
    """Return a run in which all was as at the start before it, q̇ and the torque, too.

    Args:
        controller: Of law (6), with gravity that is known.
        plant: Ideal.
        target: x_d.
        q: Configuration at the start.
        v: Velocity there.
        latency: Its period is the longest.
        steps: Number of periods.
        rng: Draws them.
    """
    h, model = latency.period, plant.robot.model
    gaps = np.where(rng.random(steps) < AS_LONG, h, h * rng.uniform(SHORTEST, 1.0, steps))
    ticks = np.append(0.0, np.cumsum(gaps))
    seen = when_seen(ticks, latency, rng)
    later = ticks + latency.torque_delay
    number = {t: k for k, t in enumerate(ticks)}
    acting = {t: k for k, t in enumerate(later)}
    events = np.unique(np.concatenate([ticks, later, seen]))
    events = events[events <= ticks[-1]]
    goal, state = aj.Target(np.asarray(target)), controller.begin(plant.measure(0.0, q, v))
    images, asked, seen_at = {}, [], set(seen)
    before, slope, records, tau = q, v, [], np.zeros_like(v)
    for start, end in pairwise(events):
        x = plant.sensor.value(q)
        if start in seen_at:
            images[start] = x
        if start in number:
            k = number[start]
            if latency.velocity_filter and k:
                moved = pin.difference(model, before, q) / gaps[k - 1]
                slope = slope + gaps[k - 1] / (latency.velocity_filter + gaps[k - 1]) * (
                    moved - slope
                )
            before, known = q, slope if latency.velocity_filter else v
            measured = aj.Measurement(start, q, known, images[seen[k]], seen[k])
            state, answer = controller.step(state, measured, goal, gaps[k])
            asked.append(np.array(answer.torque))
        if start in acting or start == 0.0:
            tau = asked[acting.get(start, 0)]
        records.append((start, q, v, plant.sensor.error(x, target)))
        pieces = max(1, int(np.ceil(2.0 * (end - start) / h - TINY)))
        for _ in range(pieces):
            q, v, _ = plant.advance(q, v, tau, (end - start) / pieces, rk4)
    return Run(*map(np.array, zip(*records, strict=True)))


def when_seen(ticks, latency, rng):
    """Return when the x was taken that each sample reads; at the start where none has arrived."""
    age, frame = latency.image_age, latency.image_period
    if not frame:
        return np.maximum(ticks - age, 0.0)
    frames = np.append(0.0, np.arange(rng.random() * frame, ticks[-1], frame))
    return frames[np.searchsorted(frames, ticks - age, side="right").clip(1) - 1]
