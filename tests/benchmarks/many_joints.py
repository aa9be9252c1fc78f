"""What learnt gravity of a serial arm with many joints takes in C and in lanes.

Lines of controller.c, time of gcc -O2, and time to trace and to compile the closed loop.

    OMP_NUM_THREADS=1 python tests/benchmarks/many_joints.py [joints, 30 by default]
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from turns import table

import approxjac as aj
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.lanes import Lanes, LaneStart

OFF = ["-std=c99", "-O2", "-ffp-contract=off"]


def serial(n):
    """The URDF of a serial arm, all of whose numbers differ."""
    rng = np.random.default_rng(0)
    parts = ['<robot name="serial"><link name="base"/>']
    for i in range(n):
        x, y, z = rng.uniform(-0.02, 0.02, 3)
        parts.append(
            f'<link name="l{i}"><inertial><origin xyz="{x} {y} {z + 0.05}"/>'
            f'<mass value="{rng.uniform(0.3, 0.6)}"/><inertia ixx="0.002" iyy="0.0022" '
            'izz="0.001" ixy="1e-4" ixz="2e-4" iyz="1e-4"/></inertial></link>'
        )
        turn = " ".join(map(str, rng.uniform(-1.5, 1.5, 3)))
        axis = ("1 0 0", "0 1 0", "0 0 1")[i % 3]
        parts.append(
            f'<joint name="j{i}" type="revolute"><parent link="{f"l{i - 1}" if i else "base"}"/>'
            f'<child link="l{i}"/><origin xyz="0.01 0 0.1" rpy="{turn}"/><axis xyz="{axis}"/>'
            '<limit lower="-2.5" upper="2.5" effort="300" velocity="2"/></joint>'
        )
    parts.append(f'<link name="tip"/><joint name="t" type="fixed"><parent link="l{n - 1}"/>')
    return "".join([*parts, '<child link="tip"/><origin xyz="0 0 0.1"/></joint></robot>'])


def in_c(controller):
    """Lines of controller.c, and processor time of gcc [s]."""
    with tempfile.TemporaryDirectory() as folder:
        aj.export_c(controller, folder)
        lines = len((Path(folder) / "controller.c").read_text(encoding="utf-8").splitlines())
        subprocess.run(["gcc", *OFF, "-c", "controller.c"], cwd=folder, check=True)
    return lines, resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def in_lanes(errors, law):
    """Processor time to trace the closed loop and to compile it [s]."""
    rng = np.random.default_rng(0)
    robots = [
        errors.robot(values) for values in rng.uniform(errors.low, errors.high, (4, errors.d))
    ]
    plants = [aj.Plant(robot, aj.PositionTask(robot)) for robot in robots]
    q = np.zeros(law.task.robot.nv)
    x = law.task.value(q)
    begun = [LaneStart.of(law, plant, q, x) for plant in plants]
    box = aj.JointBox.around(law.task.robot, q, 1.0)
    start = time.process_time()
    lanes = Lanes(law, plants[0], begun, box, 1e-3, 100, 1e-3)
    traced = time.process_time()
    LlvmLanes(lanes.program)
    return traced - start, time.process_time() - traced


def main():
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    arm = aj.Robot(serial(n))
    errors = aj.stability.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
    task = errors.believed_task()
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot))
    heads = ["joints", "lines of C", "gcc -O2, s", "lanes: trace, s", "compile, s"]
    print(table(heads, [[str(n), *in_c(law), *in_lanes(errors, law)]]))


if __name__ == "__main__":
    main()
