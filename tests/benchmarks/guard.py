"""What the guard costs a step, compiled and in Python, as ratios within one run.

OMP_NUM_THREADS=1 python tests/benchmarks/guard.py
"""

import time

import numpy as np
import turns

import approxjac as aj
from approxjac.codegen import compiled

ROBOTS, STEPS, ROUNDS, DT = ("panda", "ur5"), 200, 100, 1e-3
HEADS = ("robot", "law", "compiled, µs", "without", "ratio", "Python, µs", "without", "ratio")


def laws(robot):
    """The laws by name."""
    task = aj.PositionTask(robot)
    learnt = aj.SetpointController(task, gravity=aj.AdaptiveGravity(robot))
    return {
        "set-point": aj.SetpointController(task),
        "set-point, learnt gravity": learnt,
        "– within `TorqueLimited`": aj.TorqueLimited(learnt, aj.Limits.of(robot)),
        "tracking": aj.TrackingController(task),
    }


def samples(robot):
    """Measurements of a slow motion, a new x at each."""
    task, q0, way = aj.PositionTask(robot), aj.Plant(robot).ready_configuration(), np.ones(robot.nv)
    found = []
    for k in range(STEPS):
        t = k * DT
        q = q0 + 0.05 * np.sin(3.0 * t) * way
        v = 0.15 * np.cos(3.0 * t) * way
        found.append(aj.Measurement(t, q, v, task.value(q), t))
    return found, found[0].x + 0.002


def time_of(controller, inputs, target):
    """Time of a step [s], the state going on from step to step."""
    state = controller.initial_state(inputs[0])
    start = time.process_time()
    for measurement in inputs:
        state, answer = controller.step(state, measurement, target, DT)
        assert answer.status < aj.Status.JOINTS_UNKNOWN
    return (time.process_time() - start) / len(inputs)


def rows(name):
    """Return the rows of one robot."""
    robot = aj.load_robot(name)
    inputs, target = samples(robot)
    for law, controller in laws(robot).items():
        pair = [controller, controller.guarded(None)]
        four = [*map(compiled, pair), *pair]
        # in turns, so that what else the machine does hits all; what it takes away does not count
        times = [[time_of(each, inputs, target) for each in four] for _ in range(ROUNDS)]
        a, b, c, d = (1e6 * np.min(times, axis=0)).tolist()
        yield name, law, a, b, a / b, c, d, c / d


def main():
    """Print the table."""
    print(turns.table(HEADS, [row for name in ROBOTS for row in rows(name)]))


if __name__ == "__main__":
    main()
