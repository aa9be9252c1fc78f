"""A stretched arm, whose Jacobian has lost the direction to the target, finds its way out.

You will see: with the Jacobian as it is, no joint torque acts along the error and the arm stands
still. With one that is designed to keep its rank (the paper's section 6) the elbow folds and the
tip of an unknown tool reaches its target; what the design adds to the Jacobian's error is printed.

You will learn: how to tell from a run's status that a pose was singular, and what helps.

    python examples/06_out_of_a_singular_pose.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity
from approxjac.robots import GravityRegressor
from approxjac.tasks import NonsingularTask

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("two_link")
truth = arm.with_object(length=0.5, mass=0.5, axis="x")
belief = arm.with_object(length=0.2, mass=0.2, axis="x")
plant = aj.Plant(truth, sensor=aj.PositionTask(truth, axes="xz"))
plain = aj.PositionTask(belief, axes="xz")
designed = NonsingularTask(plain, bend={"joint2": -0.4}, ratio=0.2)

stretched = np.array([np.radians(60.0), 0.0])
target = 0.6 * plant.sensor.value(stretched)  # straight towards the shoulder
regressor = GravityRegressor(belief)
gravity = RegressorGravity(regressor, regressor.fit(truth)[0])

runs = {}
for name, task in (("Ĵ as it is", plain), ("Ĵ designed", designed)):
    controller = aj.SetpointController(task, aj.default_gains(plain), gravity=gravity)
    runs[name] = run = aj.simulate(plant, controller, target, stretched, duration=4.0, dt=2e-3)
    statuses = ", ".join(f"{status.name} {n}" for status, n in run.status_counts().items())
    print(
        f"{name}: error {1e3 * run.error_norm[0]:.2f} -> {1e3 * run.error_norm[-1]:.2f} mm; "
        f"{statuses}"
    )
changes = [designed.design_error(q) for q in run.q[::10]]
print(
    f"the design changes Ĵ by up to {max(changes):.2f} m/rad, and by {changes[-1]:.2f} at the end"
)

figure, axes = view.new_figure(3, 2, title="Out of a singular pose, with an unknown object")
for row, (name, run) in enumerate(runs.items()):
    view.plot_error(run, axes[3 * row], title=f"Task error: {name}")
    view.plot_torque(run, axes[3 * row + 1], title=f"Torque of each joint: {name}")
    in_world = (target[0], 0.0, target[1])
    view.plot_path(
        run, truth, plane="xz", ax=axes[3 * row + 2], target=in_world, title=f"Path: {name}"
    )
print(*view.save_figure(figure, out / "06_singular_pose"), sep="\n")
title = "A stretched arm finds its way out: its Ĵ is designed to keep its rank"
print(view.save_page(run, out / "06_singular_pose.html", title))
print(view.write_index(out))
