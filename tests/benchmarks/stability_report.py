"""Time of a stability report and of a map, in seconds and as ratios to Pinocchio's own work.

A report over 10 000 Panda postures on one core, and a map of 40 x 40 points by test 3. The ratios
are to what Pinocchio alone takes, for 10 000 postures, for the terms that the conditions are made
of (M, n times C for its gradient, J, and n times dJ/dt).

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python tests/benchmarks/stability_report.py
"""

import time

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac.stability import stability_map

POSTURES, ROUNDS = 10_000, 3
CENTRE = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])


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


def seconds(work):
    """Processor time of this process, which other ones do not add to."""
    start = time.process_time()
    work()
    return time.process_time() - start


def measured(rounds=ROUNDS):
    """Seconds of a report, of a map, and of Pinocchio alone: medians."""
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
    controller = aj.SetpointController(errors.believed_task(), aj.Gains(400.0, 80.0, 10.0))
    region = aj.JointBox.around(arm, CENTRE, 0.3)
    truth = errors.plant([0.2, 0.5])
    drawn = region.sample(POSTURES, np.random.default_rng(0))
    aj.stability_report(controller, truth, region, configurations=100)  # imports SciPy
    axes = np.linspace(0.0, 3.0, 40), np.geomspace(0.5, 50.0, 40)
    return [
        float(np.median([seconds(work) for _ in range(rounds)]))
        for work in (
            lambda: aj.stability_report(controller, truth, region, configurations=POSTURES),
            lambda: stability_map(
                controller, errors, region, names=("error", "a"), x=axes[0], y=axes[1], coarse=0
            ),
            lambda: pinocchio_alone(truth.robot, drawn),
        )
    ]


def main():
    report, drawn_map, alone = measured()
    print(f"Pinocchio alone, {POSTURES} Panda postures: {alone:.2f} s")
    print(f"report over {POSTURES} postures: {report:.2f} s, ratio {report / alone:.1f}")
    print(f"map of 40 x 40 points by test 3: {drawn_map:.2f} s, ratio {drawn_map / alone:.1f}")


if __name__ == "__main__":
    main()
