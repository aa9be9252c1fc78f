"""A task of one's own, compiled, written as C and tried a thousand times.

You will see: a Panda with an unknown tool keeps a distance from a post and a height, which is all
that is measured. The same run in Python and as machine code, and where 1000 runs with other tools
end.

You will learn: how to write a task, and that whatever computes with NumPy and without a branch on a
value is compiled, exported and run in lanes like the tasks of the library.

    python examples/19_own_task.py --out results/examples
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.codegen import compiled
from approxjac.tasks import FrameKinematics

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
(out := arguments.parse_args().out).mkdir(parents=True, exist_ok=True)


class RangeTask(aj.Task):
    """X = distance of the tip from an upright post, and its height above the post's foot."""

    def __init__(self, robot, post):
        super().__init__(robot, labels=("distance", "height"), units=("m", "m"))
        self.post, self._tip = np.array(post), FrameKinematics(robot, robot.tip)

    def value(self, q):
        """Return distance and height at q [m]."""
        away = self._tip.position(q) - self.post
        return np.stack([np.hypot(away[0], away[1]), away[2]])

    def jacobian(self, q, x=None):
        """Return how they change with q."""
        away, J = self._tip.position(q) - self.post, self._tip.jacobian(q)[:3]
        return np.stack([away[:2] @ J[:2] / np.hypot(away[0], away[1]), J[2]])

    def on(self, robot):
        """Return the same of another robot, such as the true one."""
        return RangeTask(robot, self.post)


arm, ranged = aj.load_robot("panda"), partial(RangeTask, post=(0.9, 0.5, 0.0))
errors = aj.Uncertainty(arm, ranged, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
law = aj.SetpointController(errors.believed_task(), gravity=aj.AdaptiveGravity(arm))
quick = compiled(law)

start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
truth = arm.with_object(0.15, 0.4, axis="x")
plant = aj.Plant(truth, ranged(truth))
target = plant.sensor.value(start) + [-0.15, 0.10]
options = {
    "duration": 4.0,
    "dt": 1e-3,
    "computation": aj.simulation.Computation("semi_implicit_euler"),
}
runs = [aj.simulate(plant, each, target, start, **options) for each in (law, quick)]
apart = np.abs(runs[0].tau - runs[1].tau).max()
print(f"it ends {1e3 * runs[0].error_norm[-1]:.2f} mm away; torques of both differ by {apart:.0e}")

region = aj.JointBox.around(arm, start, 0.3)
many = aj.Study(law, errors, region, target=target, duration=4.0).rollouts(1000)
print(f"{many.share:.1%} of 1000 runs arrive; engine: {many.setting.engine}")
print(aj.export_c(law, out / "19_own_task"))

figure, (left, right) = view.new_figure(2, title="A task of one's own: range and height")
with view.style():
    for run, name, width in zip(runs, ("Python", "machine code"), (4.0, 1.5), strict=True):
        left.semilogy(run.t, run.error_norm, label=name, linewidth=width)
    left.set(xlabel="time [s]", ylabel="error [m]", title="One run, twice")
    view.legend_below(left)
    right.hist(np.log10(many.columns["final_error"]), bins=40)
    right.set(xlabel="log₁₀ of the final error [m]", ylabel="runs", title="1000 other tools")
print(*view.save_figure(figure, out / "19_own_task"), sep="\n")
print(view.save_page(run, out / "19_own_task.html", "A task of one's own: range and height"))
print(view.write_index(out))
