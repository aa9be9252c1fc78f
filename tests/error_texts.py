"""The texts of errors: what a wrong call is told. They stand in `error_texts.txt`, call by call.

A new case is a line `>>> call` there. `python tests/error_texts.py --write` makes all texts anew;
what changed is then to be read in the difference. Without `--write` it prints the differences.
"""

import argparse
import difflib
import sys
from pathlib import Path

import numpy as np

import approxjac as aj

FILE = Path(__file__).with_name("error_texts.txt")
PROMPT = ">>> "


def names():
    """What the calls may use: an arm, its truth and belief, and what is built of them."""
    arm, ur5, kinova = (aj.load_robot(name) for name in ("panda", "ur5", "kinova"))
    truth, belief = arm.with_object(0.2, 0.5, axis="x"), arm.with_object(0.0)
    plant, task = aj.Plant(truth), aj.PositionTask(belief)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    gains = aj.Gains(400.0, 80.0, 1.0)
    law = aj.SetpointController(task, gains)
    x = plant.sensor.value(q)
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    return {
        "aj": aj, "np": np, "nan": np.nan, "inf": np.inf,
        "arm": arm, "ur5": ur5, "kinova": kinova, "truth": truth, "belief": belief,
        "plant": plant, "task": task, "q": q, "x": x, "gains": gains, "law": law, "camera": camera,
        "learnt": aj.AdaptiveGravity(belief), "none": np.zeros(0), "image": np.zeros(2),
        "seen": aj.Measurement(0.0, q, np.zeros(7), x),
        "uncertainty": aj.Uncertainty(arm, object_length=(0.0, 0.1), object_axis="x"),
        "box": aj.JointBox.around(arm, q, 0.05),
    }  # fmt: skip


def calls():
    """Lines of the file that are calls or comments, in order."""
    lines = FILE.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.startswith((PROMPT, "# "))]


def told(call, namespace):
    """Return the name and the text of the error that a call raises, as they stand in the file."""
    try:
        answer = eval(call, dict(namespace))
    except aj.errors.ApproxJacError as error:
        return f"{type(error).__name__}: {error}"
    raise AssertionError(f"{call} raised nothing, and returned {answer!r}")


def text():
    """Return the whole file as it has to be."""
    namespace, parts = names(), []
    for line in calls():
        if line.startswith(PROMPT):
            parts.append(f"{line}\n{told(line.removeprefix(PROMPT), namespace)}\n")
        else:
            parts.append(f"\n{line}\n")
    return "\n".join(parts).lstrip("\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="make the file anew")
    made, before = text(), FILE.read_text(encoding="utf-8")
    sys.stdout.writelines(
        difflib.unified_diff(before.splitlines(True), made.splitlines(True), "before", "now", n=1)
    )
    if parser.parse_args().write:
        FILE.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main()
