"""10⁵ rollouts of 5 s: a Panda with random tools, starts and targets, learnt gravity, motors with
their limits, joint stops and friction.

All is in the time that is told: drawing, compiling, and what is left to Python.

    OMP_NUM_THREADS=1 python tests/benchmarks/many_rollouts.py [RUNS [PROCESSES]]
"""

import hashlib
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

import approxjac as aj

POSTURE = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5])


def main(runs=100_000, processes=2):
    """Print what became of them, how long it took, and what it took."""
    arm = aj.load_robot("panda")
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), friction=0.1)
    task = errors.believed_task()
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot))
    law = aj.TorqueLimited(law, aj.Limits(effort=task.robot.effort_limits))
    region = aj.JointBox.around(task.robot, POSTURE, 0.5)
    start = time.perf_counter()
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=spawned) as pool:
        done = aj.rollouts(law, errors, region, runs=runs, duration=5.0, executor=pool)
    took = time.perf_counter() - start
    digest = hashlib.sha256(b"".join(column.tobytes() for column in done.columns.values()))
    own, theirs = (
        resource.getrusage(who).ru_maxrss / 1024
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    print(done)
    print(
        f"{took:.1f} s with {processes} processes, {own:.0f} MB here and up to {theirs:.0f} MB in "
        f"each of them, engine {done.study.engine}, digest {digest.hexdigest()[:12]}"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
