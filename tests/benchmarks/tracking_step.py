"""Time of one control step of tracking law, as a ratio to the set-point law's in the same run.

Both learn: `TrackingController` kinematics and dynamics, `SetpointController` gravity. Control runs
at 1 kHz with frames at 60 Hz, so most steps have no new frame; of both kinds the median is told.
A learning frame is what a step of `AdaptiveKinematics` takes longer where there is a new one.
What is compiled is that of `codegen.compiled`, beside the set-point law in Python.

    OMP_NUM_THREADS=1 python tests/benchmarks/tracking_step.py > docs/tables/tracking_step.md
"""

import time

import numpy as np

import approxjac as aj
from approxjac.codegen.step import compiled
from approxjac.controllers import KnownKinematics

ROBOTS = ("panda", "ur5")
RATE, DT = 60.0, 1e-3
BEFORE, STEPS, ROUNDS = 3000, 600, 10  # that are not timed, that are, and how often
HEADS = ("robot", "law", "µs", "ratio", "with a frame, µs", "mean, µs", "ratio of it")


def motion(robot):
    """Measurements of slow motion about a configuration, and a target that moves."""
    rng = np.random.default_rng(0)
    middle, ways = robot.random_configuration(rng), rng.uniform(-0.3, 0.3, robot.nv)
    task, turn = aj.PositionTask(robot), 2.0 * np.pi / 4.0
    found, x, t_x, frame = [], None, 0.0, -1
    for step in range(BEFORE + STEPS):
        t = step * DT
        q, v = middle + ways * np.sin(turn * t), ways * turn * np.cos(turn * t)
        if int(t * RATE + 1e-6) != frame:
            frame, t_x = int(t * RATE + 1e-6), t
            x = task.value(q) + 0.1 + 2e-3 * rng.normal(size=3)
        found.append(aj.Measurement(t, q, v, x, t_x))
    return found, aj.Target(task.value(middle) + 0.1, np.full(3, 0.1), np.full(3, 0.1))


def laws(robot):
    """The laws by name, what they are compared with first."""
    task = aj.PositionTask(robot)
    learnt = aj.TrackingController(task, kinematics=aj.AdaptiveKinematics(task))
    return {
        "set-point, learnt gravity": aj.SetpointController(task, gravity=aj.AdaptiveGravity(robot)),
        "tracking law, learnt": learnt,
        "tracking law, learnt, compiled": compiled(learnt),
        "tracking law, the camera's axes known": aj.TrackingController(task),
        "tracking law, kinematics known": aj.TrackingController(
            task, kinematics=KnownKinematics(task)
        ),
        "tracking law, learnt, `TorqueLimited`": aj.TorqueLimited(learnt, aj.Limits.of(robot)),
        "– with it compiled": aj.TorqueLimited(compiled(learnt), aj.Limits.of(robot)),
        "– its kinematics alone": learnt.kinematics,
    }


def times_of(controller, state, inputs, target):
    """Return the time of each step [s] and the state; it goes on from step to step."""
    found, clock = [], time.perf_counter
    is_law = not isinstance(controller, aj.AdaptiveKinematics)
    for measurement in inputs:
        start = clock()
        if is_law:
            state, _ = controller.step(state, measurement, target, DT)
        else:
            state = controller.step(state, measurement, DT)
        found.append(clock() - start)
    return found, state


def rows(name):
    """Return the rows of one robot."""
    robot = aj.load_robot(name)
    inputs, target = motion(robot)
    before, inputs = inputs[:BEFORE], inputs[BEFORE:]
    t_x = np.array([before[-1].t_x, *(each.t_x for each in inputs)])
    is_new = np.diff(t_x) > 0.0
    controllers, taken, states = laws(robot), {}, {}
    for law, controller in controllers.items():
        _, states[law] = times_of(controller, controller.initial_state(before[0]), before, target)
    for _ in range(ROUNDS):  # all in turn, so that whatever slows the machine slows all
        for law, controller in controllers.items():
            times, _ = times_of(controller, states[law], inputs, target)
            taken.setdefault(law, []).append(times)
    found, base = [], None
    for law, times in taken.items():
        each = 1e6 * np.min(times, axis=0)  # what else ran on the machine takes nothing off it
        plain, framed, mean = np.median(each[~is_new]), np.median(each[is_new]), each.mean()
        base = (plain, mean) if base is None else base
        ratios = f"{plain / base[0]:.2f}", f"{mean / base[1]:.2f}"
        found.append(
            (name, law, f"{plain:.0f}", ratios[0], f"{framed:.0f}", f"{mean:.0f}", ratios[1])
        )
    return found


def main():
    """Print the table."""
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
    for name in ROBOTS:
        for row in rows(name):
            print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
