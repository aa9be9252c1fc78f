"""A limit of one's own: the wrist stays above a table, compiled, written as C and in many runs.

You will see: how high the wrist of a Panda is above a table while its hand is sent forwards and
down. Without the limit it goes 27 mm into the table. With it the wrist comes down to the table
and glides along it, in Python as in machine code, and the tip arrives all the same. Of a hundred
other tools about six in ten do.

You will learn: that a limit is one method that gives rows, low ≤ A q̈ ≤ high, and that a law
that keeps it is compiled, exported and run in lanes like any other.

    python examples/22_own_limit.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.codegen import compiled
from approxjac.controllers import Limit

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)


class HighWrist(Limit):
    """A ball [m] about the origin of a link stays above a table."""

    def __init__(self, frame, table, radius):
        self.frame, self.height = frame, table + radius
        self.point, self.normal = np.array([[0.0, 0.0, table], [0.0, 0.0, 1.0]])  # pages draw it

    def rows(self, terms, v, dt):
        """Return bounds of the acceleration with which it moves up."""
        above = terms.position(self.frame)[2:] - self.height
        J, drift = terms.jacobian(self.frame)[2:3], terms.drift(self.frame)[2:3]
        return terms.stay_above(above, J, drift)


arm = aj.load_robot("panda")
errors = aj.Uncertainty(arm, object_length=(0.0, 0.2))
law = aj.SetpointController(errors.believed_task())
start = np.array([0.0, 0.2, 0.0, -2.2, 0.0, 3.6, 0.7])  # reaching forwards, the hand turned up
wrist = aj.PositionTask(arm, frame="panda_link6")
table, radius = wrist.value(start)[2] - 0.11, 0.10  # 1 cm below the ball
high = HighWrist("panda_link6", table, radius)
limited = aj.TorqueLimited(law, [aj.Limits.of(arm), high], dt=2e-3)
quick = compiled(limited)

plant = aj.Plant(arm.with_object(0.15, axis="x"))
target = plant.sensor.value(start) + [0.15, 0.0, -0.1]
options = {
    "duration": 5.0,
    "dt": 2e-3,
    "computation": aj.simulation.Computation("semi_implicit_euler"),
}
laws = {"no limit": law, "in Python": limited, "machine code": quick}
runs = {name: aj.simulate(plant, each, target, start, **options) for name, each in laws.items()}
heights = {
    name: 1e3 * np.array([wrist.value(q)[2] - radius - table for q in run.q])
    for name, run in runs.items()
}
for name, run in runs.items():
    lowest = round(heights[name].min(), 1) + 0.0  # without the sign of a zero
    print(f"{name}: the wrist gets down to {lowest:.1f} mm above the table\n{run}")

region = aj.JointBox.around(arm, start, 0.05)
sampled = {"latency": aj.Latency(period=2e-3), "duration": 5.0}
many = aj.Study(limited, errors, region, target=target, **sampled).rollouts(100)
print(f"{many.share:.1%} of 100 runs arrive; engine: {many.setting.engine}")
print(aj.export_c(limited, out / "22_own_limit"))

figure, (left, right) = view.new_figure(2, title="A wrist above a table")
with view.style():
    for (name, height), width in zip(heights.items(), (2.0, 4.0, 1.5), strict=True):
        left.plot(runs[name].t, height, label=name, linewidth=width)
        right.semilogy(runs[name].t, runs[name].error_norm, label=name, linewidth=width)
    left.axhline(0.0, color=view.COLORS["neutral"], linestyle="--", label="table")
    left.set(xlabel="time [s]", ylabel="wrist above the table [mm]", title="The limit")
    right.set(xlabel="time [s]", ylabel="error [m]", title="The tip's error")
    view.legend_below(left)
    view.legend_below(right)
print(*view.save_figure(figure, out / "22_own_limit"), sep="\n")
title = "A limit of one's own: the wrist stays above a table"
print(view.save_page(runs["in Python"], out / "22_own_limit.html", title))
print(view.write_index(out))
