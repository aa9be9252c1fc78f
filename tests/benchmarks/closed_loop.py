"""Steps per second of whole simulated runs at 1 kHz, with the plant in Pinocchio and in MuJoCo.

python tests/benchmarks/closed_loop.py
"""

import control_step
import turns

import approxjac as aj
from approxjac.robots import GravityRegressor
from approxjac.simulation import Computation

ROUNDS, DURATION, DT = 3, 5.0, 1e-3
COMPILED = "`Plant`, the loop compiled"
HEADS = ("robot", "plant", "law (6), steps/s", "law (28), (29), steps/s", "control's share of (6)")


def runs(name):
    """Functions that simulate a run each, of every plant and law, and the control step alone."""
    robot, q0, inputs = control_step.arm(name)
    axes = control_step.ROBOTS[name][0]
    task, gains = aj.PositionTask(robot, axes=axes), aj.Gains(400.0, 80.0, 10.0)
    learnt = aj.AdaptiveGravity(GravityRegressor(robot), L=0.5, alpha=2.0)
    controllers = {
        "known": aj.SetpointController(task, gains),
        "learnt": aj.SetpointController(task, gains, gravity=learnt),
    }
    plant = aj.Plant(robot, task)
    plants = {"`Plant`": plant, COMPILED: plant, "`MujocoPlant`": aj.MujocoPlant(robot, task)}
    target = task.value(q0) + 0.05

    def simulated(name, kind):
        engine = Computation(engine="compiled" if name == COMPILED else "python")
        given = plants[name], controllers[kind], target, q0, DURATION
        return lambda: aj.simulate(*given, dt=DT, computation=engine)

    found = {(plant, kind): simulated(plant, kind) for plant in plants for kind in controllers}
    step, steps = control_step.our_step(controllers["known"]), round(DURATION / DT)
    found["control"] = lambda: [step(*inputs[i % len(inputs)]) for i in range(steps)]
    return found


def rows():
    """Steps per second of every robot and plant, and what of a step is the control's."""
    found = []
    for name in control_step.ROBOTS:
        taken = turns.medians(runs(name), [()], ROUNDS)
        for plant in ("`Plant`", COMPILED, "`MujocoPlant`"):
            known, learnt = taken[plant, "known"], taken[plant, "learnt"]
            steps = DURATION / DT
            share = "–" if plant == COMPILED else taken["control"] / known
            found.append((name, plant, steps / known, steps / learnt, share))
    return found


def main():

    print(turns.table(HEADS, rows()))


if __name__ == "__main__":
    main()
