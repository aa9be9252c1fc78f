"""Time of one limited control step on a Panda, as a ratio to the same step without limits.

The first table takes the limiters as they come: limits of effort alone, with the proof's row, and
all limits of the URDF, step by step sorted by what the limiter had to do. The second is of the
QPs of such steps. All take turns in one process.

    python tests/benchmarks/torque_limits.py
"""

import time
from collections import defaultdict

import numpy as np

import approxjac as aj
from approxjac.controllers.limits.quadratic_program import Solver

STATES, ROUNDS = 1500, 4
PROBLEMS = 300


class Watched(Solver):
    """DAQP that keeps the problems which it solves."""

    def __init__(self):
        super().__init__()
        self.problems = []

    def _solved(self, problem):
        self.problems.append(problem)
        return super()._solved(problem)


def states(robot, task, rng):
    """Postures of slow motion, with targets from close by to half a metre away."""
    found = []
    for _ in range(STATES):
        q, v = robot.random_configuration(rng), rng.uniform(-0.5, 0.5, robot.nv)
        x = task.value(q)
        target = x + rng.uniform(0.01, 0.5) * rng.normal(size=3)
        found.append((aj.Measurement(0.0, q, v, x), target))
    return found


def step_table(law, limits, inputs):
    """Print the median time of each kind of step over that of the law alone."""
    effort = aj.Limits(effort=limits.effort)
    limiters = {
        "effort only": aj.TorqueLimited(law, effort, proof=False),
        "effort, proof": aj.TorqueLimited(law, effort),
        "all of the URDF, proof": aj.TorqueLimited(law, limits),
    }
    for limiter in limiters.values():
        limiter._solver = Watched()
    alone, times = [], defaultdict(list)
    clock = time.perf_counter
    for _ in range(ROUNDS):
        for measurement, target in inputs:
            start = clock()
            law.step(np.zeros(0), measurement, target, 1e-3)
            alone.append(clock() - start)
        for name, limiter in limiters.items():
            problems, state = limiter._solver.problems, limiter.begin(inputs[0][0])
            for measurement, target in inputs:
                problems.clear()
                start = clock()
                _, answer = limiter.step(state, measurement, target, 1e-3)
                taken = clock() - start
                how = f"{len(problems)} QPs" if problems else "closed form"
                how = "free" if answer.limit_status is aj.LimitStatus.FREE else how
                times[name, how].append(taken)
    base = np.median(alone)
    print(f"the law alone: {1e6 * base:.1f} µs at the median of {len(inputs)} states\n")
    print(f"{'limits':26}{'step':14}{'share':>8}{'µs':>8}{'ratio':>8}{'/ free':>8}")
    for name in limiters:
        kinds = sorted(how for which, how in times if which == name)
        kinds = ["free", *(how for how in kinds if how != "free")]
        for how in kinds:
            taken = times[name, how]
            share, median = len(taken) / (ROUNDS * len(inputs)), np.median(taken)
            if taken:
                free = median / np.median(times[name, "free"])
                ratios = f"{median / base:8.2f}{free:8.2f}"
                print(f"{name:26}{how:14}{share:8.0%}{1e6 * median:8.1f}{ratios}")


def problems_of(law, limits, inputs):
    """QPs of a step each, with the limits of speeds and positions."""
    limiter = aj.TorqueLimited(law, limits)
    limiter._solver = watched = Watched()
    for measurement, target in inputs:
        limiter.step(limiter.begin(measurement), measurement, target, 1e-3)
    return watched.problems[:PROBLEMS]


def solver_table(problems):
    """Print time, violations of what comes out, and distance from DAQP's answer."""
    names, solvers = ["daqp"], [Solver()]
    times, worst, apart, lost = (np.zeros((len(problems), len(names))) for _ in range(4))
    references = [solvers[0].solve(problem)[0] for problem in problems]
    for j, solver in enumerate(solvers):
        for i, problem in enumerate(problems):
            start = time.perf_counter()
            z, _ = solver.solve(problem)
            times[i, j] = time.perf_counter() - start
            if z is None:
                lost[i, j] = 1.0
                continue
            rows = problem.A @ z
            worst[i, j] = max(
                (problem.lower - z).max(),
                (z - problem.upper).max(),
                (problem.row_lower - rows).max(initial=0.0),
                (rows - problem.row_upper).max(initial=0.0),
                0.0,
            )
            apart[i, j] = np.abs(z - references[i]).max()
    print(f"\n{len(problems)} QPs of 7 torques and {len(problems[0].A)} rows, in µs")
    print(f"{'solver':12}{'median':>9}{'99 %':>9}{'violation':>12}{'from DAQP':>12}{'none':>6}")
    for j, name in enumerate(names):
        median, slow = 1e6 * np.percentile(times[:, j], [50, 99])
        print(
            f"{name:12}{median:9.1f}{slow:9.1f}{worst[:, j].max():12.1e}{apart[:, j].max():12.1e}"
            f"{int(lost[:, j].sum()):6d}"
        )
    print("violation: of torques, or of accelerations of a row, the largest [N m, rad/s²]")


def main():
    robot = aj.load_robot("panda")
    task = aj.PositionTask(robot)
    law = aj.SetpointController(task)
    limits = aj.Limits.of(robot, scale=0.5)
    inputs = states(robot, task, np.random.default_rng(0))
    step_table(law, limits, inputs)
    solver_table(problems_of(law, limits, inputs))


if __name__ == "__main__":
    main()
