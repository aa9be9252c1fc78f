"""Wrong calls and what each error names, a line each in `error_texts.txt`.

A line is `call => error | argument | got value | what is valid | …`: parts that its message must
hold, in whatever words. A new case is a new line there.
"""

from pathlib import Path

import numpy as np

import approxjac as aj

FILE = Path(__file__).with_name("error_texts.txt")


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


def cases():
    """Return (call, name of the error, parts of its message) of each line."""
    lines = FILE.read_text(encoding="utf-8").splitlines()
    for line in lines:
        if line and not line.startswith("#"):
            call, _, told = line.partition(" => ")
            error, *parts = told.split(" | ")
            yield call, error, parts
