"""What a control step costs with images instead of a position, as ratios within one run.

python tests/benchmarks/image_step.py
"""

from functools import partial

import numpy as np
import turns

import approxjac as aj
from approxjac.tasks import CombinedTask

ROUNDS, STEPS = 15, 200
Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def controllers():
    robot = aj.load_robot("panda").with_object(0.15, 0.3)
    camera = aj.PinholeCamera.looking_at((0.5, 0.0, 0.4), (1.6, -0.8, 0.9), 600.0, (640, 480))
    carried = aj.PinholeCamera(600.0, (640, 480), mount="panda_hand")
    away = [[0.5, 0.0, -0.2], [0.6, 0.1, -0.2]]
    pair = ((0.0, 0.0, 0.0), (0.0, 0.2, 0.0))
    x_d = aj.ImageTask(robot, camera, points=pair).value(Q)
    tasks = {
        "position": aj.PositionTask(robot),
        "one point": aj.ImageTask(robot, camera),
        "one point, constant depth": aj.ImageTask(robot, camera, depth=1.0),
        "two points": aj.ImageTask(robot, camera, points=pair),
        "two points, combined": CombinedTask.balanced(
            aj.ImageTask(robot, camera, points=pair), x_d
        ),
        "camera on the arm, two points": aj.ImageTask(robot, carried, points=away, depth=0.5),
    }
    gains = aj.Gains(1e-3, 1e-3, 1.0)
    found = {name: aj.SetpointController(task, gains) for name, task in tasks.items()}
    found["one point, held"] = aj.HeldMeasurement(found["one point"], unseen=40.0)
    return found


def rows():
    """µs of a step with each task, and over that with a position."""
    found = controllers()
    steps = {}
    for name, controller in found.items():
        x = np.full(controller.task.n_x, 200.0)
        measurement = aj.Measurement(0.0, Q, np.full(7, 0.1), x)
        state = controller.begin(measurement)
        steps[name] = partial(controller.step, state, measurement, x.copy(), 1e-3)
    taken = turns.medians(steps, [()] * STEPS, ROUNDS)
    return [(name, 1e6 * each, each / taken["position"]) for name, each in taken.items()]


HEADS = ("law (6) on a Panda, measured", "µs", "of a position")


def main():
    print(turns.table(HEADS, rows()))


if __name__ == "__main__":
    main()
