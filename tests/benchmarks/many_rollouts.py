"""10⁵ rollouts of 5 s: a Panda with random tools, starts and targets, learnt gravity, motors with
their limits, joint stops and friction.

All is in the time that is told: drawing, compiling, and what is left to Python.

    OMP_NUM_THREADS=1 python tests/benchmarks/many_rollouts.py [RUNS [THREADS [TRACKING]]]

With TRACKING 1 it is the tracking law with all that it learns, without limits of motors.
"""

import hashlib
import resource
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

import approxjac as aj

POSTURE = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5])


def main(runs=100_000, threads=2, tracking=0):
    """Print what became of them, how long it took, and what it took."""
    arm = aj.load_robot("panda")
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), friction=0.1)
    task = errors.believed_task()
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot))
    law = aj.TorqueLimited(law, aj.Limits(effort=task.robot.effort_limits))
    if tracking:
        law = aj.TrackingController(task)
    region = aj.JointBox.around(task.robot, POSTURE, 0.5)
    start, spent = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(threads) as pool:
        done = aj.Study(law, errors, region, duration=5.0).rollouts(
            runs, execution=aj.stability.Execution(executor=pool)
        )
    took, spent = time.perf_counter() - start, time.process_time() - spent
    digest = hashlib.sha256(b"".join(column.tobytes() for column in done.columns.values()))
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(done)
    print(
        f"{took:.1f} s with {threads} threads ({spent:.1f} s of the processor), {megabytes:.0f} MB "
        f"at most, engine {done.setting.engine}, digest {digest.hexdigest()[:12]}"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
