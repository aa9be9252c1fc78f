"""Time to compile a step of laws for a Panda, each once [s].

OMP_NUM_THREADS=1 python tests/benchmarks/compile_time.py
"""

import time

import approxjac as aj


def laws(robot):
    """The laws by name."""
    task = aj.PositionTask(robot)
    limits = aj.Limits.of(robot)
    setpoint = aj.SetpointController(task, gravity=aj.AdaptiveGravity(robot))
    tracking = aj.TrackingController(task, kinematics=aj.AdaptiveKinematics(task))
    return {
        "set-point": setpoint,
        "set-point, limits of effort": aj.TorqueLimited(setpoint, aj.Limits(effort=limits.effort)),
        "set-point, all limits": aj.TorqueLimited(setpoint, limits),
        "tracking, learnt": tracking,
        "tracking, learnt, all limits": aj.TorqueLimited(tracking, limits),
    }


def main():
    """Print them."""
    for name, law in laws(aj.load_robot("panda")).items():
        start = time.perf_counter()
        aj.codegen.compiled(law)
        print(f"{name}: {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()
