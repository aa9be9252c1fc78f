"""A Panda picks up a payload of unknown mass, and learns its weight while it moves.

You will see: without learning, the arm hangs 4 cm below its target, because the force that holds
the unknown payload has to come from an error: K_p times that error is about the payload's weight.
With the adaptive law (28), (29) the error goes away. The controller believes in no payload.

You will learn: how the controller is told of gravity, by a model that it believes or by learning.

    python examples/03_gravity_is_learnt.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view
from approxjac.robots import GravityRegressor

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

arm = aj.load_robot("panda")
truth = arm.with_object(length=0.15, mass=1.5)
belief = arm.with_object(length=0.0, mass=0.0)
weight = 9.81 * 1.5  # N
plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
task = aj.PositionTask(belief)
gains = aj.Gains(kp=400.0, kv=120.0, damping=2.0)

regressor = GravityRegressor(belief)
gravities = {
    "believed": aj.controllers.ModelGravity(belief),
    "learnt": aj.AdaptiveGravity(regressor, L=0.5, alpha=2.0),  # starts from the belief
}
q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
target = plant.sensor.value(q0) + [0.10, -0.10, 0.10]

figure, axes = view.new_figure(2, title="Task error of a Panda with 1.5 kg that it believes absent")
for ax, (name, gravity) in zip(axes, gravities.items(), strict=True):
    controller = aj.SetpointController(task, gains, gravity=gravity)
    run = aj.simulate(plant, controller, target, q0, duration=6.0, dt=2e-3)
    left = run.error_norm[-1]
    print(f"gravity {name}: {run}")
    print(f"  K_p |e| = {gains.kp * left:.1f} N at the end; the payload weighs {weight:.1f} N")
    view.plot_error(run, ax, title=f"Gravity {name}: {1e3 * left:.2g} mm after 6 s")

print(*view.save_figure(figure, out / "03_learnt_gravity"), sep="\n")
title = "A Panda learns the weight of 1.5 kg that it believes absent"
print(view.save_page(run, out / "03_learnt_gravity.html", title))
print(view.write_index(out))
