"""What a control step costs with images instead of a position, as ratios within one run.

python tests/benchmarks/image_step.py
"""

import time

import numpy as np

import approxjac as aj

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
        "two points, combined": aj.CombinedTask.balanced(
            aj.ImageTask(robot, camera, points=pair), x_d
        ),
        "camera on the arm, two points": aj.ImageTask(robot, carried, points=away, depth=0.5),
    }
    gains = aj.Gains(1e-3, 1e-3, 1.0)
    found = {name: aj.SetpointController(task, gains) for name, task in tasks.items()}
    found["one point, held"] = aj.HeldMeasurement(found["one point"], unseen=40.0)
    found["one point, at velocity level"] = aj.VelocityServo(tasks["one point"])
    return found


def seconds(controller, x):
    measurement = aj.Measurement(0.0, Q, np.full(7, 0.1), x)
    state, target = controller.initial_state(measurement), x + 0.0
    begin = time.perf_counter()
    for _ in range(STEPS):
        controller.evaluate(state, measurement, target)
    return (time.perf_counter() - begin) / STEPS


def main():
    found = controllers()
    values = {name: np.full(c.task.n_x, 200.0) for name, c in found.items()}
    times = {name: [] for name in found}
    for _ in range(ROUNDS):  # in turn, so that a slow moment hits all of them
        for name, controller in found.items():
            times[name].append(seconds(controller, values[name]))
    best = {name: min(each) for name, each in times.items()}
    print(f"{'law (6) on a Panda':34} us/step   / position")
    for name, value in best.items():
        print(f"{name:34} {1e6 * value:7.1f} {value / best['position']:10.2f}")


if __name__ == "__main__":
    main()
