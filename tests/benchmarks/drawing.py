"""What it costs to draw a truth of an uncertain robot, against building it from its URDF text.

    python tests/benchmarks/drawing.py

Both in one run, in turns: what counts is the ratio. The least of many is what a quiet machine does.
"""

import functools
import time
from collections.abc import Callable

import numpy as np

import approxjac as aj

ARMS = ("panda", "ur5", "pr2_left_arm")
ROUNDS, IN_A_ROW = 100, 10
PLACES = np.full(3, 0.01)


def least(programs: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Least time of each program [s]; in each round one after the other, some times in a row."""
    found = dict.fromkeys(programs, np.inf)
    for _ in range(ROUNDS):
        for name, program in programs.items():
            for _ in range(IN_A_ROW):
                start = time.perf_counter()
                program()
                found[name] = min(found[name], time.perf_counter() - start)
    return found


def rows(name: str) -> dict[str, float]:
    """What is timed of an arm, and the least time of each [s]."""
    arm, rng = aj.load_robot(name), np.random.default_rng(0)
    ranges = {"object_length": (0.0, 0.3), "object_mass": (0.0, 1.0)}
    joints = dict.fromkeys(arm.joint_names, PLACES)
    task = functools.partial(aj.PositionTask, axes="xyz")
    held = aj.Uncertainty(arm, task, **ranges)
    wrong = aj.Uncertainty(arm, task, **ranges, joint_shifts=joints, joint_rotations=joints)
    values = wrong.sample(rng)
    truth = wrong.plant(values).robot
    text, tip = truth.urdf, truth.tip
    return least(
        {
            "Pinocchio's model copied": arm.model.copy,
            "a truth: object": lambda: held.plant(held.sample(rng)),
            "a truth: object and all joints": lambda: wrong.plant(wrong.sample(rng)),
            "  of it the robot": lambda: wrong.robot(values),
            "the robot from its text": lambda: aj.Robot(text, tip=tip),
        }
    )


def main() -> None:
    """Print them."""
    for name in ARMS:
        found = rows(name)
        print(name)
        for what, seconds in found.items():
            ratio = seconds / found["the robot from its text"]
            print(f"  {what:32} {1e3 * seconds:8.3f} ms  {ratio:8.4f} of building it from text")


if __name__ == "__main__":
    main()
