"""Time of a stability report and of a map on one core, of this tree and of an older one in turns.

    git worktree add /tmp/before ce66a93
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tests/benchmarks/stability_report.py /tmp/before

Each tree has processes of its own, so that a first report is one. The last two rows are what one
call after the other takes for what the conditions are made of, M, J and their gradients, with this
library's `Dynamics` and tasks, and with Pinocchio alone (n times C, n times dJ/dt).

`--parts` tells what the two searches of a report take: for growth, and for a function.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import turns

import approxjac as aj
from approxjac.robots import Dynamics
from approxjac.tasks.analysis import jacobian_gradient

if importlib.util.find_spec("approxjac.stability.closed_loop"):  # of older trees
    from approxjac.stability.closed_loop import ClosedLoop
else:
    from approxjac.stability.loop.closed_loop import ClosedLoop

POSTURES, ROUNDS = 10_000, 3
CENTRE = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])
HERE = Path(__file__).parents[2]
OUT = HERE / "docs" / "tables" / "reports.md"


def pinocchio_alone(robot, postures):
    model, data, units = robot.model, robot.model.createData(), np.eye(robot.nv)
    frame = model.getFrameId(robot.tip)
    for q in postures:
        pin.crba(model, data, q)
        pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        for unit in units:
            pin.computeCoriolisMatrix(model, data, q, unit)
            pin.computeJointJacobiansTimeVariation(model, data, q, unit)
            pin.getFrameJacobianTimeVariation(model, data, frame, pin.LOCAL_WORLD_ALIGNED)


def one_after_the_other(plant, task, postures):
    dynamics = Dynamics(plant.robot)
    for q in postures:
        dynamics.M(q), dynamics.M_gradient(q)
        plant.sensor.value(q), plant.sensor.jacobian(q)
        task.jacobian(q), jacobian_gradient(task, q)


def seconds(work):
    """Processor time of this process, which other ones do not add to."""
    start = time.process_time()
    work()
    return time.process_time() - start


def measured():
    """Name → seconds, of the tree that is imported."""
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
    controller = aj.SetpointController(errors.believed_task(), aj.Gains(400.0, 80.0, 10.0))
    region = aj.JointBox.around(arm, CENTRE, 0.3)
    truth, task = errors.plant([0.2, 0.5]), controller.task
    drawn = region.sample(POSTURES, np.random.default_rng(0))
    axes = {"error": np.linspace(0.0, 2.0, 6), "a": np.geomspace(1.0, 20.0, 6)}
    loop, truths = ClosedLoop(controller, truth, region), np.zeros(POSTURES, dtype=int)
    x_d = np.zeros((POSTURES, 3))

    if hasattr(aj, "Study"):
        study = aj.Study(controller, truth, region)
        runs = aj.Study(controller, errors, region, duration=2.0)

        def report():
            study.report(POSTURES)

        def by_rollouts():
            runs.map(axes, 32)

    else:  # older trees

        def report():
            aj.stability_report(controller, truth, region, configurations=POSTURES)

        def by_rollouts():
            names, (x, y) = tuple(axes), axes.values()
            aj.stability.stability_map(
                controller, errors, region, names=names, x=x, y=y, by="rollouts", runs=32,
                duration=2.0,
            )  # fmt: skip

    return {
        f"a report of {POSTURES} Panda postures, the first": seconds(report),
        "the same again": seconds(report),
        "a map, 6 × 6 points of 32 runs of 2 s": seconds(by_rollouts),
        f"terms of {POSTURES} samples of a report": seconds(
            lambda: loop.samples_at(truths, drawn, x_d)
        ),
        "one posture after the other": seconds(lambda: one_after_the_other(truth, task, drawn)),
        "Pinocchio alone": seconds(lambda: pinocchio_alone(truth.robot, drawn)),
    }


def parts():
    """Print what a report takes, and its two searches."""
    latencies = (  # not of older trees
        aj.Latency(),
        aj.Latency(image_period=0.034, image_age=0.06),
        aj.Latency(velocity_filter=2e-4),
    )
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), object_axis="x")
    gains, believed = aj.Gains(400.0, 80.0, 5.0), errors.believed_task()
    controller = aj.SetpointController(believed, gains, gravity=aj.NoGravity(believed.robot))
    region = aj.JointBox.around(arm, [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], 0.15)
    from approxjac.stability.report import report as report_module

    taken = {}

    def timed(name):
        work = getattr(report_module, name)

        def of(*arguments):
            start = time.process_time()
            try:
                return work(*arguments)
            finally:
                taken[name] = time.process_time() - start

        return of

    for name in ("fastest_growth", "searched_test"):
        setattr(report_module, name, timed(name))
    for latency in latencies:
        for _ in range(2):  # the first imports SciPy
            whole = seconds(
                lambda latency=latency: aj.Study(
                    controller, errors, region, latency=latency
                ).report(POSTURES)
            )
        parts = ", ".join(f"{name} {each:.2f} s" for name, each in taken.items())
        print(f"{latency!r}: {whole:.2f} s, of it {parts}")


def of_tree(tree):
    environment = {**os.environ, "PYTHONPATH": str(tree / "src")}
    command = [sys.executable, __file__, "--measure"]
    said = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return json.loads(said.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path, nargs="?", help="folder of the older tree")
    parser.add_argument("--measure", action="store_true", help="the tree that is imported, as JSON")
    parser.add_argument("--parts", action="store_true", help="of a report, instead")
    parser.add_argument("--out", type=Path, default=OUT, help="Markdown file that is written")
    given = parser.parse_args()
    if given.measure:
        print(json.dumps(measured()))
        return
    if given.parts:
        parts()
        return
    trees = [HERE] if given.before is None else [given.before, HERE]
    rounds = [[of_tree(tree) for tree in trees] for _ in range(ROUNDS)]
    rows = []
    for name in rounds[0][0]:
        taken = np.median([[each[name] for each in one] for one in rounds], axis=0)
        rows.append((name, *map(float, taken), float(taken[0] / taken[-1])))
    heads = ("what", *(("before, s", "now, s", "before / now") if len(trees) == 2 else ("s", "")))
    table = turns.table(heads, rows)
    print(table)
    if len(trees) == 2:
        given.out.write_text(table + "\n")


if __name__ == "__main__":
    main()
