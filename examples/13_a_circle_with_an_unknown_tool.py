"""A UR5 follows a circle with a tool that it was not told of, and learns the tool on its way.

You will see: with the Jacobian of the bare flange the tip stays more than a centimetre off the
circle. The tracking law controls where it *predicts* the tip and learns from where the tip is
measured: the error is a millimetre after a few seconds, although the sensor has noise, frames and
delay.

You will learn: paths, `TrackingController`, what `AdaptiveKinematics` has to be told, and how to
read what was learnt.

    python examples/13_a_circle_with_an_unknown_tool.py --out results/examples
"""

import argparse
from pathlib import Path

import numpy as np

import approxjac as aj
from approxjac import view

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("--out", type=Path, default=Path("results/examples"))
out = arguments.parse_args().out
out.mkdir(parents=True, exist_ok=True)

belief = aj.load_robot("ur5")
truth = belief.with_object(length=0.20, mass=1.0, axis="y")
tracker = aj.Sensing(x_noise=2e-3, x_rate=60.0, x_delay=0.03)
plant = aj.Plant(truth, sensing=tracker, torque_limits=truth.effort_limits)

q0 = np.array([0.0, -1.2, 1.6, -1.9, -1.57, 0.0])
center = plant.sensor.value(q0) + [-0.10, 0.05, 0.05]
circle = aj.Circle(center, radius=0.10, period=4.0, normal=(0.0, -0.8, 0.6))

task, dt = aj.PositionTask(belief), 2e-3  # s
kinematics = aj.AdaptiveKinematics(task, unknown=("tool", "origins"), noise=2e-3, delay=0.03, dt=dt)
latency = aj.Latency(period=dt, image_period=1 / 60, image_age=0.03)
controllers = {
    "fixed Jacobian": aj.SetpointController(
        task, gravity=aj.AdaptiveGravity(belief), latency=latency
    ),
    "learnt kinematics": aj.TrackingController(task, kinematics=kinematics, dt=dt),
}

figure, axes = view.new_figure(3, title="A circle of 10 cm in 4 s, with a 20 cm tool unknown")
for ax, (name, controller) in zip(axes, controllers.items(), strict=False):
    run = aj.simulate(plant, controller, circle, q0, duration=8.0, dt=dt)
    late = run.error_norm[run.t > 6.0]
    rms = 1e3 * np.sqrt(np.mean(late**2))
    print(f"{name}: {rms:.2f} mm RMS from 6 to 8 s")
    view.plot_error(run, ax, title=f"{name}: {rms:.2g} mm RMS at the end")
names = ["tool.x", "tool.y", "tool.z"]
true = dict(zip(names, aj.robots.KinematicRegressor(truth).theta[-3:], strict=True))
view.plot_parameters(run, names, axes[2], truth=true, title="The tool, ± 2 sd")
print(*view.save_figure(figure, out / "13_circle_unknown_tool"), sep="\n")
title = "A circle of 10 cm in 4 s, with a 20 cm tool unknown"
print(view.save_page(run, out / "13_circle_unknown_tool.html", title))
print(view.write_index(out))

print(controller.kinematics_learnt(run.state[-1]))
